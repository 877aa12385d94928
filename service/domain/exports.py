"""Exports: asked for, published whole or not at all, found again where the same is asked for, deleted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, or_, select
from sqlalchemy.orm import Session

from schemas.api.exports import ExportRequest
from schemas.api.jobs import JobKind
from schemas.artifacts import EXPORTED_OF_MAP, EXPORTED_OF_SCENE, component_folder, is_read_by_export
from schemas.exports import EXPORT_FORMATS
from service.database.tables import (
    TERMINAL,
    Blob,
    Drive,
    Export,
    ExportFile,
    Job,
    JobState,
    MapFile,
    MapScene,
    MapVersion,
    Scene,
    SceneFile,
    new_id,
    now_us,
)
from service.domain import jobs
from service.domain.map_inputs import StoredArtifact
from service.domain.scenes import media_type
from service.errors import (
    ComponentUnknown,
    CrsNotTaken,
    DriveDeleted,
    ExportActive,
    ExportDeleted,
    FilesMissing,
    NotGeoreferenced,
    UsedByJob,
)
from service.storage import blobs
from service.storage.blob_writer import StoredFile


class ExportGoneError(Exception):
    """The export was deleted."""


@dataclass(frozen=True, kw_only=True)
class ExportInputs:
    """Inputs of an export.

    Attributes
    ----------
    files
        Of the scene, component or version, those that exports read.
    drives
        Ids of drives by the names of scenes; of a scene that is no map, by the empty name. None where no format has
        images.
    """

    files: Sequence[StoredArtifact]
    drives: Mapping[str, str]
    formats: Sequence[str]
    options: Mapping[str, Any]


def create(
    session: Session,
    *,
    project_id: str,
    subject: Scene | MapVersion,
    asked: ExportRequest,
    job_expires_us: int | None,
) -> tuple[Export, Job | None]:
    """Record an export of a scene or version, which the caller has locked, and its job.

    Returns
    -------
    export, job
        The job is None where the same is there, or under way, already.

    Raises
    ------
    ServiceError
        409 where a drive whose images are needed was deleted; 422 where the scene or map has no such component, or
        lacks what a format needs; 413 and 429 as for all jobs.
    """
    formats = sorted(set(asked.formats))
    options = {"image_size_px": asked.image_size_px, "crs": asked.crs}
    if asked.component is not None:
        options["component"] = asked.component
    _require_needs(subject, formats, options)
    _require_files(session, subject, options)
    drives = _require_drives(session, subject) if _needs_images(formats) else {}
    inputs = _inputs_sha256(subject, formats, options)
    known = _same(session, project_id, inputs)
    if known is not None:
        return known, None
    export_id = new_id("exp")
    job = jobs.create(
        session,
        project_id=project_id,
        kind=JobKind.EXPORT,
        # A drive that a job names is not deleted meanwhile; those of a map are not, anyway.
        drive_id=drives.get("") if isinstance(subject, Scene) else None,
        expires_us=job_expires_us,
        request={"export_id": export_id},
    )
    export = Export(
        id=export_id,
        project_id=project_id,
        job_id=job.id,
        inputs_sha256=inputs,
        formats=formats,
        options=options,
        **_source(subject),
    )
    session.add(export)
    session.flush()
    return export, job


def retry(session: Session, job: Job, *, expires_us: int | None) -> Job:
    """A new job for an export whose job failed or was cancelled.

    Raises
    ------
    ServiceError
        409 where the export or a drive was deleted, another job makes it, or the job did not fail; 413 and 429.
    """
    jobs.require_failed(job)
    export = session.get(Export, _export_id(job.request), with_for_update=True, populate_existing=True)
    if export is None:
        raise ExportDeleted(f"the export of job {job.id} was deleted", remedy="Ask for it anew.")
    if export.job_id != job.id:
        raise ExportActive(f"job {export.job_id} makes export {export.id}", remedy="Look at that job.")
    if job.drive_id is not None and session.get(Drive, job.drive_id, with_for_update=True) is None:
        raise _drive_deleted(job.drive_id)
    new = jobs.create(
        session,
        project_id=job.project_id,
        kind=JobKind.EXPORT,
        drive_id=job.drive_id,
        retry_of=job.id,
        expires_us=expires_us,
        request=dict(job.request or {}),
    )
    export.job_id = new.id
    return new


def inputs_of(session: Session, held: jobs.Claim) -> ExportInputs:
    """The inputs of an export that is being made.

    Raises
    ------
    ExportGoneError
        Where it was deleted.
    """
    export = session.get(Export, _export_id(held.request))
    if export is None:
        raise ExportGoneError(_export_id(held.request))
    subject: Scene | MapVersion
    if export.scene_id is not None:
        subject = session.get_one(Scene, export.scene_id)
    else:
        subject = session.get_one(MapVersion, (export.map_id, export.map_version))
    return ExportInputs(
        files=_files(session, subject, export.options),
        drives=_drives(session, subject) if _needs_images(export.formats) else {},
        formats=export.formats,
        options={name: value for name, value in export.options.items() if name != "component"},
    )


def _files(session: Session, subject: Scene | MapVersion, options: Mapping[str, Any]) -> list[StoredArtifact]:
    """What is read of a scene, component or version, by its path in the folder that is exported."""
    table: type[SceneFile] | type[MapFile] = SceneFile
    if isinstance(subject, Scene):
        mine = SceneFile.scene_id == subject.id
    else:
        table, mine = MapFile, (MapFile.map_id == subject.map_id) & (MapFile.number == subject.number)
    number = options.get("component")
    prefix = "" if number is None else f"{component_folder(number)}/"
    statement = select(table.path, Blob.key).join(Blob, table.blob_id == Blob.id).where(mine).order_by(table.path)
    found = session.execute(statement.where(table.path.startswith(prefix, autoescape=True))).all()
    return [
        StoredArtifact(path.removeprefix(prefix), key)
        for path, key in found
        if is_read_by_export(path.removeprefix(prefix))
    ]


def publish(
    session: Session,
    held: jobs.Claim,
    *,
    files: Mapping[str, StoredFile],
    results: Sequence[Mapping[str, Any]],
    expires_us: int | None,
) -> str:
    """Put stored files, by path, into the job's export, and end the job; the export's id.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    export_id = _export_id(held.request)
    jobs.succeed(session, held)  # first: it sees whether the job is still held
    export = session.get_one(Export, export_id, with_for_update=True, populate_existing=True)
    export.fence, export.results, export.expires_us = held.fence, [dict(result) for result in results], expires_us
    session.flush()
    for path, file in files.items():
        blob = blobs.record(session, project_id=held.project_id, within_quota=False, **file.identity)
        session.add(ExportFile(export_id=export_id, path=path, blob_id=blob.id, media_type=media_type(path)))
    return export_id


def remove(session: Session, export: Export) -> None:
    """Delete an export, which the caller has locked.

    Raises
    ------
    ServiceError
        409 while it is being made.
    """
    job = session.get(Job, export.job_id)
    if job is not None and job.state not in TERMINAL:
        raise ExportActive(
            f"job {job.id} is making export {export.id}",
            remedy="Wait for its end, or cancel it.",
        )
    session.execute(delete(Export).where(Export.id == export.id))


def require_none_active(session: Session, *, what: str, mine: ColumnElement[bool]) -> None:
    """Refuse to delete what is being exported.

    Parameters
    ----------
    mine
        Selects the exports of what is to be deleted.

    Raises
    ------
    ServiceError
        409 with the job's id.
    """
    job_id = session.scalar(_active().where(mine).limit(1))
    if job_id is not None:
        raise UsedByJob(f"{what} is being exported by job {job_id}", remedy="Wait for its end, or cancel it.")


def is_exported(mine: ColumnElement[bool]) -> ColumnElement[bool]:
    """The condition that a job exports what `mine` selects the exports of."""
    return _active().where(mine).exists()


def forget_expired(session: Session, now: int, *, limit: int = 20) -> int:
    """Delete exports that have passed their retention dates, and those that were never made and have no job any more.

    Returns
    -------
    int
        How many were deleted; 0 where none is left.
    """
    of_job = select(Job.id).where(Job.id == Export.job_id)
    active = of_job.where(Job.state.not_in(TERMINAL)).exists()
    ripe = or_((Export.expires_us < now) & ~active, Export.results.is_(None) & ~of_job.exists())
    found = session.scalars(select(Export.id).where(ripe).order_by(Export.id).limit(limit).with_for_update()).all()
    # Asked again under the locks: one that is retried at this moment has a job by now.
    dropped = delete(Export).where(Export.id.in_(found), ripe).execution_options(synchronize_session=False)
    return int(session.execute(dropped).rowcount)  # type: ignore[attr-defined]


def _active() -> Select[str]:
    return select(Job.id).join(Export, Export.job_id == Job.id).where(Job.state.not_in(TERMINAL))


def _export_id(request: Mapping[str, Any] | None) -> str:
    return str((request or {})["export_id"])


def _needs_images(formats: Sequence[str]) -> bool:
    return any(EXPORT_FORMATS[name].needs_images for name in formats)


def _require_needs(subject: Scene | MapVersion, formats: Sequence[str], options: Mapping[str, Any]) -> None:
    component = options.get("component")
    figures = subject.summary if component is None else _component(subject, component)
    needing = [name for name in formats if EXPORT_FORMATS[name].needs_place]
    if needing and not figures["georeferenced"]:
        raise NotGeoreferenced(
            f"format {needing[0]} needs a place on the earth, and {_named(subject, options)} has none",
            remedy="Leave the format out, or reconstruct the drive with GNSS.",
        )
    taking = [known.name for known in EXPORT_FORMATS.values() if known.takes_crs]
    if options["crs"] is not None and not set(taking) & set(formats):
        raise CrsNotTaken(
            f"crs is given, and no format of {', '.join(formats)} takes one",
            remedy=f"Leave it out; formats that take one: {', '.join(taking) or 'none'}.",
        )


def _component(subject: Scene | MapVersion, number: int) -> Mapping[str, Any]:
    """The figures of a component that has a folder of its own."""
    listed = subject.summary.get("components") or () if isinstance(subject, Scene) else ()
    own = {each["component"]: each for each in listed if each["folder"] == component_folder(each["component"])}
    if number not in own:
        raise ComponentUnknown(
            f"{_named(subject, {})} has no component {number} with files of its own",
            remedy=f"Leave it out, or give one that has: {', '.join(map(str, sorted(own))) or 'there is none'}.",
        )
    found: Mapping[str, Any] = own[number]
    return found


def _require_files(session: Session, subject: Scene | MapVersion, options: Mapping[str, Any]) -> None:
    read = EXPORTED_OF_SCENE if isinstance(subject, Scene) else EXPORTED_OF_MAP
    missing = sorted(read - {file.path for file in _files(session, subject, options)})
    if missing:
        raise FilesMissing(
            f"{_named(subject, options)} has no {missing[0]}, which exports read",
            remedy="Another version of the service made it: make it again with this one.",
        )


def _require_drives(session: Session, subject: Scene | MapVersion) -> dict[str, str]:
    drives = _drives(session, subject)
    there = set(session.scalars(select(Drive.id).where(Drive.id.in_(drives.values())).with_for_update(read=True)))
    for drive_id in drives.values():
        if drive_id not in there:
            raise _drive_deleted(drive_id)
    return drives


def _drive_deleted(drive_id: str) -> DriveDeleted:
    return DriveDeleted(
        f"drive {drive_id}, whose images are needed, was deleted", remedy="Ask for formats without images alone."
    )


def _drives(session: Session, subject: Scene | MapVersion) -> dict[str, str]:
    """Ids of drives by the names of their scenes."""
    if isinstance(subject, Scene):
        return {"": subject.drive_id}
    mine = (MapScene.map_id == subject.map_id) & (MapScene.number == subject.number)
    return {scene.name: scene.drive_id for scene in session.scalars(select(MapScene).where(mine))}


def _source(subject: Scene | MapVersion) -> dict[str, Any]:
    if isinstance(subject, Scene):
        return {"scene_id": subject.id}
    return {"map_id": subject.map_id, "map_version": subject.number}


def _named(subject: Scene | MapVersion, options: Mapping[str, Any]) -> str:
    if not isinstance(subject, Scene):
        return f"version {subject.number} of map {subject.map_id}"
    return (
        f"component {options['component']} of scene {subject.id}" if "component" in options else f"scene {subject.id}"
    )


def _inputs_sha256(subject: Scene | MapVersion, formats: Sequence[str], options: Mapping[str, Any]) -> str:
    """Digest of all that the files are made of: scenes and versions never change, nor do committed drives."""
    made_of = {**_source(subject), "formats": list(formats), **options, "version": version("mrasfm")}
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def _same(session: Session, project_id: str, inputs: str) -> Export | None:
    """An export of the same that is there with all formats, or will be; not one that is deleted at any moment."""
    same = (Export.project_id == project_id) & (Export.inputs_sha256 == inputs)
    same &= Export.expires_us.is_(None) | (Export.expires_us > now_us())
    for export in session.scalars(select(Export).where(same).order_by(Export.created_us.desc())):
        if export.results is not None:
            if not any(result.get("withheld") for result in export.results):
                return export
            continue
        job = session.get(Job, export.job_id)
        if job is not None and job.state in (JobState.QUEUED, JobState.RUNNING) and job.cancel_requested_us is None:
            return export
    return None
