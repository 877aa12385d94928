"""Drives: created with a manifest, filled with files, frozen by a commit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from sqlalchemy import delete, func, insert, select, tuple_, update
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState, FileDeclaration, FileRole, PreflightState
from schemas.api.jobs import JobKind
from schemas.api.problems import ProblemItem
from schemas.drive import DriveManifest
from service.errors import ServiceError
from service.persistence import blobs, durability, jobs, slots
from service.persistence.drive_files import MANIFEST_NAME
from service.persistence.maps import require_unused
from service.persistence.owned import require
from service.persistence.storing import StoredFile
from service.persistence.tables import Blob, Drive, DriveFile, Job, Project, new_id, now_us

_SHOWN = 1000  # of missing files, in an answer
_BATCH = 500


@dataclass(frozen=True)
class Stored:
    """How much of a drive is here."""

    files: int
    size_bytes: int


def files_of(manifest: DriveManifest) -> dict[str, FileRole]:
    """Paths of all files that a manifest names. A mask may serve several images, and is one file."""
    roles: dict[str, FileRole] = {}
    for frame in manifest.frames:
        for image in frame.images.values():
            roles[image.file] = FileRole.IMAGE
            if image.mask is not None:
                roles.setdefault(image.mask, FileRole.MASK)
    return roles


def create(
    session: Session, *, project_id: str, manifest: DriveManifest, stored: StoredFile, expires_us: int | None
) -> Drive:
    """Record a drive whose manifest is in the artifact store.

    Raises
    ------
    ServiceError
        413 or 429 where a quota of the project is full, 422 where no folder can hold the files under their names.
    """
    _require_storable(manifest)
    project = session.get_one(Project, project_id, with_for_update=True)
    count = session.scalar(select(func.count()).select_from(Drive).where(Drive.project_id == project_id)) or 0
    if count >= project.max_drives:
        raise ServiceError(
            429,
            "too-many-drives",
            "Too many drives",
            f"the project has {count} drives, its quota is {project.max_drives}",
            remedy="Delete drives that are not needed any more, or ask the operator for a larger quota "
            "('mrasfm projects set').",
        )
    blob = blobs.record(session, project_id=project_id, **stored.identity)
    roles = files_of(manifest)
    drive = Drive(
        id=new_id("drv"),
        project_id=project_id,
        name=manifest.name,
        manifest_blob_id=blob.id,
        cameras=len(manifest.rig.cameras),
        frames=len(manifest.frames),
        files_expected=len(roles),
        has_gnss=manifest.gnss is not None,
        expires_us=expires_us,
    )
    session.add(drive)
    session.flush()
    rows = [{"drive_id": drive.id, "path": path, "role": role} for path, role in roles.items()]
    if rows:
        session.execute(insert(DriveFile), rows)
    return drive


def _require_storable(manifest: DriveManifest) -> None:
    """Refuse what a worker could not lay out as a folder, and what a database could not hold."""
    if not manifest.name.isprintable():
        raise _unusable("name", "holds control characters", "Give the drive a name that can be printed.")
    paths = set(files_of(manifest))
    for path in sorted(paths):
        if path == MANIFEST_NAME:
            raise _unusable(path, "is the manifest's own name", "Give the image or mask another name.")
        above = next((str(folder) for folder in PurePosixPath(path).parents if str(folder) in paths), None)
        if above is not None or path.startswith(MANIFEST_NAME + "/"):
            what = f"lies in a folder that has the name of the file {above or MANIFEST_NAME!r}"
            raise _unusable(path, what, "Give one of the two another name.")


def _unusable(field: str, what: str, remedy: str) -> ServiceError:
    return ServiceError(
        422,
        "invalid-document",
        "The document does not follow its contract",
        f"the manifest cannot be used: {field!r} {what}",
        remedy=remedy,
        errors=[ProblemItem(field=field, detail=what)],
    )


def get(session: Session, project_id: str, drive_id: str, *, lock: bool = False) -> Drive:
    """The project's drive.

    Parameters
    ----------
    lock
        Keep others from changing it until the session ends: a commit and an upload take turns.

    Raises
    ------
    ServiceError
        404 where the project has no such drive.
    """
    return require(session, Drive, project_id, drive_id, lock=lock)


def stored_of(session: Session, drive_ids: Sequence[str]) -> dict[str, Stored]:
    """How much of each drive is here."""
    statement = select(DriveFile.drive_id, func.count(), func.coalesce(func.sum(Blob.size_bytes), 0)).join(
        Blob, DriveFile.blob_id == Blob.id
    )
    rows = session.execute(statement.where(DriveFile.drive_id.in_(drive_ids)).group_by(DriveFile.drive_id))
    found = {drive_id: Stored(count, int(size)) for drive_id, count, size in rows}
    return {drive_id: found.get(drive_id, Stored(0, 0)) for drive_id in drive_ids}


def require_open(drive: Drive) -> None:
    """Refuse changes to a committed drive.

    Raises
    ------
    ServiceError
        409.
    """
    if drive.state != DriveState.OPEN:
        raise slots.drive_committed(drive.id)


def declare(session: Session, drive: Drive, files: Iterable[FileDeclaration]) -> tuple[list[str], list[str]]:
    """Use contents that drives of the project have already, for the files of an open drive.

    Returns
    -------
    stored, to_send
        Paths whose bytes are there, and paths whose bytes are not.

    Raises
    ------
    ServiceError
        409 where the drive is committed, 422 where the manifest does not name a file.
    """
    wanted = {file.path: file for file in files}
    present = _identities(session, drive, list(wanted))
    unknown = sorted(wanted.keys() - present.keys())
    if unknown:
        raise slots.not_in_manifest(drive.id, unknown[0])
    known = known_files(session, drive.project_id, sorted({file.sha256 for file in wanted.values()}))
    stored, to_send = [], []
    for path, file in wanted.items():
        blob = known.get(file.sha256)
        if present[path] == file.sha256:
            stored.append(path)
        elif present[path] is None and blob is not None and blob.size_bytes == file.size_bytes:
            require_open(drive)
            values = {"blob_id": blob.id, "stored_us": now_us()}
            mine = (DriveFile.drive_id == drive.id) & (DriveFile.path == path)
            session.execute(update(DriveFile).where(mine).values(**values))
            stored.append(path)
        else:
            to_send.append(path)
    return stored, to_send


def _identities(session: Session, drive: Drive, paths: Sequence[str]) -> dict[str, str | None]:
    """SHA-256 of the stored files among the paths, None for those that are named and not stored."""
    found: dict[str, str | None] = {}
    statement = select(DriveFile.path, Blob.sha256).outerjoin(Blob, DriveFile.blob_id == Blob.id)
    for i in range(0, len(paths), _BATCH):
        some = statement.where(DriveFile.drive_id == drive.id, DriveFile.path.in_(paths[i : i + _BATCH]))
        found.update((path, sha256) for path, sha256 in session.execute(some))
    return found


def known_files(session: Session, project_id: str, digests: Sequence[str]) -> dict[str, Blob]:
    """Files of the project's drives, by their contents; they are kept from being collected for a while."""
    found: dict[str, Blob] = {}
    for i in range(0, len(digests), _BATCH):
        some = (Blob.project_id == project_id) & Blob.sha256.in_(digests[i : i + _BATCH]) & blobs.is_drive_file()
        session.execute(update(Blob).where(some).values(touched_us=now_us()))
        found.update((blob.sha256, blob) for blob in session.scalars(select(Blob).where(some)))
    return found


def commit(
    session: Session, drive: Drive, findings: Sequence[dict[str, Any]], *, job_expires_us: int | None = None
) -> Job:
    """Freeze a complete drive, and ask for the check of its images.

    Parameters
    ----------
    findings
        Of the manifest's check, all of them warnings.
    job_expires_us
        When the record of the images' check is deleted.

    Raises
    ------
    ServiceError
        409 where files are missing or the drive is committed.
    """
    require_open(drive)
    missing_files = (DriveFile.drive_id == drive.id) & DriveFile.blob_id.is_(None)
    count = session.scalar(select(func.count()).select_from(DriveFile).where(missing_files)) or 0
    if count:
        paths = session.scalars(
            select(DriveFile.path).where(missing_files).order_by(DriveFile.path).limit(_SHOWN)
        ).all()
        more = f" and {count - 3} more" if count > 3 else ""
        raise ServiceError(
            409,
            "drive-incomplete",
            "The drive is not complete",
            f"{count} of {drive.files_expected} files have not been uploaded: {', '.join(paths[:3])}{more}",
            remedy="Upload them, then commit again.",
            errors=[ProblemItem(field=path, detail="has not been uploaded") for path in paths],
        )
    if durability.unsynced_of(session, drive.id, limit=1):
        raise ServiceError(
            409,
            "drive-changing",
            "The drive is being written",
            f"files of drive {drive.id} came while it was being committed",
            remedy="Wait until all uploads are done, then commit again.",
            headers={"Retry-After": "1"},
        )
    job = jobs.create(
        session,
        project_id=drive.project_id,
        kind=JobKind.PREFLIGHT,
        drive_id=drive.id,
        expires_us=job_expires_us,
    )
    drive.state, drive.committed_us = DriveState.COMMITTED, now_us()
    drive.findings = list(findings)
    drive.preflight_state, drive.preflight_job_id = PreflightState.PENDING, job.id
    session.flush()
    return job


def remove(session: Session, drive: Drive) -> None:
    """Delete a drive. Its scenes stay; bytes that nothing else needs are collected later.

    Raises
    ------
    ServiceError
        409 where a job or a map needs it.
    """
    active = session.scalars(jobs.active_of_drive(drive.id)).all()
    needing = [job.id for job in active if job.kind != JobKind.PREFLIGHT]
    if needing:
        raise ServiceError(
            409,
            "drive-in-use",
            "Jobs need the drive",
            f"drive {drive.id} is needed by {len(needing)} jobs: {', '.join(needing[:3])}",
            remedy="Wait for their end, or cancel them.",
        )
    require_unused(session, what=f"drive {drive.id}", drive_id=drive.id)
    for job in active:
        jobs.request_cancel(session, job.id)
    session.execute(delete(Drive).where(Drive.id == drive.id))


def page(session: Session, project_id: str, *, after: tuple[int, str] | None, limit: int) -> list[Drive]:
    """Drives of a project, newest first, after the one that (created_us, id) names."""
    statement = select(Drive).where(Drive.project_id == project_id)
    if after is not None:
        statement = statement.where(tuple_(Drive.created_us, Drive.id) < after)
    return list(session.scalars(statement.order_by(Drive.created_us.desc(), Drive.id.desc()).limit(limit)))
