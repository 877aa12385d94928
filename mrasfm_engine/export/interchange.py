"""The files of a scene or map in formats of other programs: what is written, and how it is read back.

Nothing of the scene rests on them. One that cannot be written, or does not read back, is withheld and named.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import StorageError
from mrasfm_engine.export import (
    autoware,
    autoware_readback,
    copc,
    copc_readback,
    geopackage,
    geopackage_readback,
    rig_files,
    rig_files_readback,
    view,
    view_readback,
)
from mrasfm_engine.export.check import Check, ReadBack
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import AUTOWARE_FOLDER, COPC_FILE, RIG_FOLDER, RIGS_FOLDER, TRAJECTORY_FILE, VIEW_FILE

OPTIONAL = (COPC_FILE, AUTOWARE_FOLDER, TRAJECTORY_FILE, VIEW_FILE, RIG_FOLDER, RIGS_FOLDER)  # not of every scene


Made = tuple[Sequence[str], Mapping[str, str]]


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A file or folder below the result's folder.

    Attributes
    ----------
    write
        Writes it; what it lacks, and why, and the SHA-256 of what was to be written, by file below the part's path
        (the empty name where that is the file).
    checks
        Checks of what was written.
    is_whole
        The files of a folder belong together: none is kept without the others.
    """

    path: str
    write: Callable[[Path], Made]
    checks: Callable[[], Iterable[Check]]
    is_whole: bool = True


@dataclass(frozen=True, kw_only=True)
class Interchange:
    """Content of the files."""

    scene: Scene
    scene_of_unit: Sequence[str]  # name of the scene that each unit is of
    rigs: Mapping[str, str]  # folders, and what the names of their cameras begin with
    map_document: Mapping[str, Any] | None = None  # `map.json` of a map

    def write(self, folder: Path, read_back: ReadBack) -> list[str]:
        """Write the files into a scene's or map's folder and read them back; which are withheld, and why.

        Raises
        ------
        OSError, StorageError
            Where the disk is full or cannot be written or read.
        """
        notes: list[str] = []
        for part in self._parts():
            try:
                lacks, digests = part.write(folder / part.path)
                notes += [f"{part.path}/{what}" for what in lacks]
                read_back.expect({f"{part.path}/{file}".removesuffix("/"): d for file, d in digests.items()})
                notes += _withheld(part, folder, read_back)
            except (OSError, StorageError):
                raise
            except Exception as error:
                _remove(folder / part.path, folder)
                notes.append(f"{part.path} is withheld: it cannot be written: {type(error).__name__}: {error}")
        if len(self.scene.points_m) and not copc.fits(self.scene):
            notes += [f"{COPC_FILE} is withheld: it holds points up to {copc.REACH_M / 1000:.0f} km from the origin"]
        return notes

    def _parts(self) -> Iterator[_Part]:
        """Files and folders that this scene has."""
        scene = self.scene
        yield _Part(path=TRAJECTORY_FILE, write=self._write_trajectory, checks=self._trajectory_checks)
        yield _Part(path=VIEW_FILE, write=self._write_view, checks=self._view_checks)
        for rig, prefix in self.rigs.items():
            write = partial(_write_rig, scene, prefix)
            yield _Part(path=rig, write=write, checks=partial(_rig_checks, scene, rig, prefix), is_whole=False)
        if autoware.fits(scene):
            yield _Part(
                path=AUTOWARE_FOLDER, write=partial(_write_autoware, scene), checks=partial(_autoware_checks, scene)
            )
        if copc.fits(scene):
            yield _Part(path=COPC_FILE, write=partial(_write_copc, scene), checks=partial(_copc_checks, scene))

    def _write_trajectory(self, path: Path) -> Made:
        return (), {"": geopackage.write_geopackage(self.scene, self.scene_of_unit, path)}

    def _trajectory_checks(self) -> Iterator[Check]:
        compare = partial(geopackage_readback.geopackage, self.scene, self.scene_of_unit)
        yield Check(TRAJECTORY_FILE, geopackage_readback.read_geopackage, compare)

    def _write_view(self, path: Path) -> Made:
        places = view.read_image_places(path.parent)
        document = view.view_document(self.scene, self.scene_of_unit, places, self.map_document)
        text = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
        return (), {"": write_content(path, text + "\n")}

    def _view_checks(self) -> Iterator[Check]:
        yield Check(VIEW_FILE, view_readback.read_view, partial(view_readback.view, self.scene))


def _withheld(part: _Part, folder: Path, read_back: ReadBack) -> Iterator[str]:
    """Remove what does not read back of a part; its names, and why."""
    for check in part.checks():
        fault = read_back.fault(check)
        if fault is None:
            continue
        path = part.path if part.is_whole else check.file
        _remove(folder / path, folder)
        which = "it" if path == check.file else Path(check.file).name
        yield f"{path} is withheld: {which} was written but does not read back: {fault}"
        if part.is_whole:
            return


def _remove(path: Path, folder: Path) -> None:
    """Remove a file or folder, and the folders below `folder` that are empty then."""
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    for parent in path.parents:
        if parent == folder or (parent.is_dir() and any(parent.iterdir())):
            return
        if parent.is_dir():
            parent.rmdir()


def _write_rig(scene: Scene, prefix: str, folder: Path) -> Made:
    # Its texts are compared as a whole.
    return rig_files.write_rig(rig_files.rig_cameras(scene, prefix), folder), {}


def _write_autoware(scene: Scene, folder: Path) -> Made:
    autoware.write_autoware(scene, folder)  # every bit of the two files is compared
    return (), {}


def _write_copc(scene: Scene, path: Path) -> Made:
    return (), {"": copc.write_copc(scene, path)}


def _copc_checks(scene: Scene) -> Iterator[Check]:
    yield Check(COPC_FILE, copc_readback.read_copc, partial(copc_readback.copc, scene))


def _rig_checks(scene: Scene, folder: str, prefix: str) -> Iterator[Check]:
    read, cameras = rig_files_readback.read_text, rig_files.rig_cameras(scene, prefix)
    if any(map(rig_files.known_to_kalibr, cameras)):
        yield Check(f"{folder}/{rig_files.CAMCHAIN}", read, partial(rig_files_readback.camchain, scene, prefix))
    yield Check(f"{folder}/{rig_files.DESCRIPTION}", read, partial(rig_files_readback.description, scene, prefix))
    for camera in filter(rig_files.known_to_ros, cameras):
        file = f"{folder}/{rig_files.CAMERA_INFO}/{camera.name}.yaml"
        yield Check(file, read, partial(rig_files_readback.camera_info, scene, prefix, camera.name))


def _autoware_checks(scene: Scene) -> Iterator[Check]:
    points, projection = (f"{AUTOWARE_FOLDER}/{name}" for name in (autoware.POINTS, autoware.PROJECTOR))
    yield Check(projection, rig_files_readback.read_text, partial(autoware_readback.projector, scene))
    yield Check(points, autoware_readback.read_pcd, partial(autoware_readback.pcd, scene))
