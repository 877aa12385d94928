"""Inputs of exports: a scene, one of its components or a version of a map, in formats, with options."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.exports import ExportRequest
from schemas.artifacts import REPORT_FILE, ROAD_TIFF_FILE, component_folder
from schemas.exports import EXPORT_FORMATS, EXPORTED_OF_MAP, EXPORTED_OF_SCENE, is_read_by_export
from service.database.tables import Blob, Drive, Export, MapFile, MapScene, MapVersion, Scene, SceneFile
from service.domain.map_inputs import StoredArtifact
from service.errors import BadCrs, ComponentUnknown, CrsNotTaken, DriveDeleted, FilesMissing, NotGeoreferenced

_COMPONENT = "component"  # among the options of an export; the engine does not know it


@dataclass(frozen=True, kw_only=True)
class ExportInputs:
    """Inputs of an export.

    Attributes
    ----------
    subject
        A scene, of which `component` may be wanted in its place, or a version of a map.
    formats
        Sorted, each once.
    options
        As `Export.options` has them.
    """

    subject: Scene | MapVersion
    formats: Sequence[str]
    options: Mapping[str, Any]

    @classmethod
    def from_request(cls, subject: Scene | MapVersion, asked: ExportRequest) -> ExportInputs:
        """Inputs of a request."""
        options: dict[str, Any] = {"image_size_px": asked.image_size_px, "crs": asked.crs}
        if asked.component is not None:
            options[_COMPONENT] = asked.component
        return cls(subject=subject, formats=sorted(set(asked.formats)), options=options)

    @classmethod
    def from_export(cls, session: Session, export: Export) -> ExportInputs:
        """Inputs of an export that is recorded; its scene or version is there as long as it is."""
        subject: Scene | MapVersion
        if export.scene_id is not None:
            subject = session.get_one(Scene, export.scene_id)
        else:
            subject = session.get_one(MapVersion, (export.map_id, export.map_version))
        return cls(subject=subject, formats=export.formats, options=export.options)

    @property
    def component(self) -> int | None:
        """Number of the component that is wanted in place of its scene."""
        return self.options.get(_COMPONENT)

    @property
    def engine_options(self) -> dict[str, Any]:
        """The options that the engine takes."""
        return {name: value for name, value in self.options.items() if name != _COMPONENT}

    @property
    def needs_images(self) -> bool:
        """Return whether a format has the images of the drives."""
        return any(EXPORT_FORMATS[name].needs_images for name in self.formats)

    @property
    def source(self) -> dict[str, Any]:
        """The columns of an export that name its subject."""
        if isinstance(self.subject, Scene):
            return {"scene_id": self.subject.id}
        return {"map_id": self.subject.map_id, "map_version": self.subject.number}

    @property
    def name(self) -> str:
        """The name of what is exported, for people."""
        if not isinstance(self.subject, Scene):
            return f"version {self.subject.number} of map {self.subject.map_id}"
        of_scene = f"scene {self.subject.id}"
        return of_scene if self.component is None else f"component {self.component} of {of_scene}"

    @property
    def sha256(self) -> str:
        """Digest of all that the files are made of: scenes and versions never change, nor do committed drives."""
        made_of = {**self.source, "formats": list(self.formats), **self.options, "version": version("mrasfm")}
        return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()

    def files(self, session: Session) -> list[StoredArtifact]:
        """Files that exports read, by their paths in the folder that is exported."""
        table: type[SceneFile] | type[MapFile] = SceneFile
        if isinstance(self.subject, Scene):
            mine = SceneFile.scene_id == self.subject.id
        else:
            table, mine = MapFile, (MapFile.map_id == self.subject.map_id) & (MapFile.number == self.subject.number)
        folder = "" if self.component is None else f"{component_folder(self.component)}/"
        statement = select(table.path, Blob.key).join(Blob, table.blob_id == Blob.id).where(mine).order_by(table.path)
        found = session.execute(statement.where(table.path.startswith(folder, autoescape=True)))
        files = [StoredArtifact(path.removeprefix(folder), key) for path, key in found]
        return [file for file in files if is_read_by_export(file.path, self.formats)]

    def drives(self, session: Session) -> dict[str, str]:
        """Ids of drives by the names of scenes; of a scene by the empty name. None where no format has images."""
        if not self.needs_images:
            return {}
        if isinstance(self.subject, Scene):
            return {"": self.subject.drive_id}
        mine = (MapScene.map_id == self.subject.map_id) & (MapScene.number == self.subject.number)
        return {scene.name: scene.drive_id for scene in session.scalars(select(MapScene).where(mine))}

    def require(self, session: Session) -> None:
        """Refuse what cannot be made; the drives stay until the session ends.

        Raises
        ------
        ServiceError
            409 where a drive whose images are needed was deleted; 422 where there is no such component, or something
            that a format needs.
        """
        self._require_place()
        self._require_crs()
        self._require_files(session)
        drives = self.drives(session)
        there = set(session.scalars(select(Drive.id).where(Drive.id.in_(drives.values())).with_for_update(read=True)))
        for drive_id in drives.values():
            if drive_id not in there:
                raise drive_deleted(drive_id)

    def _require_place(self) -> None:
        figures = self.subject.summary if self.component is None else self._own_component(self.component)
        needing = [name for name in self.formats if EXPORT_FORMATS[name].needs_place]
        if needing and not figures["georeferenced"]:
            raise NotGeoreferenced(
                f"format {needing[0]} needs a place on the earth, and {self.name} has none",
                remedy="Leave the format out, or reconstruct the drive with GNSS.",
            )

    def _own_component(self, number: int) -> Mapping[str, Any]:
        """The figures of a component that has a folder of its own."""
        listed = self.subject.summary.get("components") or () if isinstance(self.subject, Scene) else ()
        own = {each["component"]: each for each in listed if each["folder"] == component_folder(each["component"])}
        if number not in own:
            raise ComponentUnknown(
                f"there is no {self.name} with files of its own"
                if isinstance(self.subject, Scene)
                else f"{self.name} has no component {number}: its components are scenes of it",
                remedy=f"Leave it out, or give one that has: {', '.join(map(str, sorted(own))) or 'there is none'}.",
            )
        found: Mapping[str, Any] = own[number]
        return found

    def _require_crs(self) -> None:
        crs = self.options["crs"]
        if crs is None:
            return
        taking = [known.name for known in EXPORT_FORMATS.values() if known.takes_crs]
        if not set(taking) & set(self.formats):
            raise CrsNotTaken(
                f"crs is given, and no format of {', '.join(self.formats)} takes one",
                remedy=f"Leave it out; formats that take one: {', '.join(taking) or 'none'}.",
            )
        from schemas.earth_systems import REMEDY, EarthSystemError, parse_system  # its library, of few requests

        try:
            parse_system(crs)
        except EarthSystemError as error:
            raise BadCrs(str(error), remedy=REMEDY) from None

    def _require_files(self, session: Session) -> None:
        read = EXPORTED_OF_SCENE if isinstance(self.subject, Scene) else EXPORTED_OF_MAP
        there = {file.path: file.key for file in self.files(session)}
        missing = sorted(read - there.keys())
        if missing:
            raise FilesMissing(
                f"{self.name} has no {missing[0]}, which exports read",
                remedy="Another version of the service made it: make it again with this one.",
            )
        needing = [name for name in self.formats if EXPORT_FORMATS[name].needs_picture]
        if needing and ROAD_TIFF_FILE not in there:
            whole = isinstance(self.subject, Scene) and self.component is None
            refusal = FilesMissing(
                f"{self.name} has no picture of the road, which format {needing[0]} is made of",
                remedy="Leave the format out; a scene has the picture where the setting output.pictures is on."
                if whole
                else "Leave the format out: maps and smaller components of a scene never have the picture.",
            )
            refusal.report_key = there[REPORT_FILE] if whole else None
            raise refusal


def drive_deleted(drive_id: str) -> DriveDeleted:
    """The refusal of an export with the images of a drive that is not there any more."""
    return DriveDeleted(
        f"drive {drive_id}, whose images are needed, was deleted", remedy="Ask for formats without images alone."
    )
