"""Drives: created with a manifest, filled with files, frozen by a commit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import bindparam, delete, func, insert, select, update
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState, FileDeclaration, PreflightState
from schemas.api.jobs import JobKind
from schemas.api.problems import ProblemItem
from schemas.file_names import MANIFEST_NAME, composed
from service.database import bulk
from service.database.connections import clock_expression
from service.database.tables import Blob, Drive, DriveFile, Job, Project, new_id, now_us
from service.domain import drive_files, jobs
from service.domain.access import require
from service.domain.manifest_facts import ManifestFacts
from service.domain.maps import require_unused
from service.errors import DriveChanging, DriveIncomplete, DriveInUse, TooManyDrives
from service.storage import blobs, durability, named_blobs
from service.storage.blob_writer import StoredFile
from service.storage.named_blobs import Named

_SHOWN = 1000  # of missing files, in an answer
_BATCH = 500


@dataclass(frozen=True)
class Stored:
    """Number and size of a drive's stored files."""

    files: int
    size_bytes: int


def rows_of(manifest: ManifestFacts) -> list[str]:
    """Make the rows that `create` writes for the files: before its transaction, for which all other writers wait."""
    return list(bulk.batches(manifest.files))


def create(
    session: Session,
    *,
    project_id: str,
    manifest: ManifestFacts,
    rows: Sequence[str],
    stored: StoredFile,
    expires_us: int | None,
) -> Drive:
    """Record a drive whose manifest is in the artifact store.

    Parameters
    ----------
    rows
        The `rows_of` the manifest.

    Raises
    ------
    ServiceError
        413 or 429 where a quota of the project is full.
    """
    project = session.get_one(Project, project_id, with_for_update={"key_share": True})
    count = session.scalar(select(func.count()).select_from(Drive).where(Drive.project_id == project_id)) or 0
    if count >= project.max_drives:
        raise TooManyDrives(
            f"the project has {count} drives, its quota is {project.max_drives}",
            remedy="Delete drives that are not needed any more, or ask the operator for a larger quota "
            "('mrasfm projects set').",
        )
    blob = blobs.record(session, project_id=project_id, **stored.identity)
    drive = Drive(
        id=new_id("drv"),
        project_id=project_id,
        name=manifest.name,
        vehicle=manifest.vehicle,
        manifest_blob_id=blob.id,
        cameras=manifest.cameras,
        frames=manifest.frames,
        files_expected=manifest.files_expected,
        has_gnss=manifest.has_gnss,
        expires_us=expires_us,
    )
    session.add(drive)
    session.flush()
    given = bulk.given(session, "path", "role")
    files = select(bindparam("drive", drive.id), given.c.path, given.c.role)
    files_of_drive = insert(DriveFile).from_select(["drive_id", "path", "role"], files)
    for batch in rows:
        session.connection().execute(files_of_drive, {"rows": batch})
    return drive


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


def stored_of(session: Session, found: Sequence[Drive]) -> dict[str, Stored]:
    """Number and size of the stored files of each drive, by its id. Only those of open drives are counted."""
    stored = {
        drive.id: Stored(drive.files_stored, drive.bytes_stored)
        for drive in found
        if drive.files_stored is not None and drive.bytes_stored is not None
    }
    counted = _count(session, [drive.id for drive in found if drive.id not in stored])
    return {drive.id: stored.get(drive.id) or counted[drive.id] for drive in found}


def _count(session: Session, drive_ids: Sequence[str]) -> dict[str, Stored]:
    if not drive_ids:
        return {}
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
        raise drive_files.drive_committed(drive.id)


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
        raise drive_files.not_in_manifest(drive.id, unknown[0])
    known = known_files(session, drive.project_id, sorted({file.sha256 for file in wanted.values()}))
    stored, to_send, taken = [], [], {}
    for path, file in wanted.items():
        blob = known.get(file.sha256)
        if present[path] == file.sha256:
            stored.append(path)
        elif present[path] is None and blob is not None and blob.size_bytes == file.size_bytes:
            require_open(drive)
            taken[path] = blob.id
            stored.append(path)
        else:
            to_send.append(path)
    drive_files.set_all(session, drive.id, taken)
    return stored, to_send


def named_files(session: Session, drive_id: str, paths: Sequence[str]) -> set[str]:
    """Select the paths that the drive's manifest names, however the characters of a path are composed."""
    found = {MANIFEST_NAME} & set(paths)
    mine = select(DriveFile.path).where(DriveFile.drive_id == drive_id)
    for i in range(0, len(paths), _BATCH):
        found.update(session.scalars(mine.where(DriveFile.path.in_(paths[i : i + _BATCH]))))
    accented = [path for path in paths if path not in found and not path.isascii()]
    if accented:  # macOS stores 'ü' as two characters, and which the manifest has no query says
        named = {composed(path) for path in session.scalars(mine)}
        found.update(path for path in accented if composed(path) in named)
    return found


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
    if digests:
        blobs.lock_project(session, project_id)
    for i in range(0, len(digests), _BATCH):
        some = (Blob.project_id == project_id) & Blob.sha256.in_(digests[i : i + _BATCH]) & blobs.is_drive_file()
        session.execute(update(Blob).where(some).values(touched_us=clock_expression(session)))
        found.update((blob.sha256, blob) for blob in session.scalars(select(Blob).where(some)))
    return found


def require_complete(session: Session, drive: Drive) -> None:
    """Refuse to freeze a drive whose files are not all here.

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
        raise DriveIncomplete(
            f"{count} of {drive.files_expected} files have not been uploaded: {', '.join(paths[:3])}{more}",
            remedy="Upload them, then commit again.",
            errors=[ProblemItem(field=path, detail="has not been uploaded") for path in paths],
        )


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
        409 where files are missing or still being written, or the drive is committed.
    """
    require_complete(session, drive)
    if durability.unsynced_of(session, drive.id, limit=1):
        raise DriveChanging(
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
    stored = _count(session, [drive.id])[drive.id]
    drive.files_stored, drive.bytes_stored = stored.files, stored.size_bytes
    drive.state, drive.committed_us = DriveState.COMMITTED, now_us()
    drive.findings = list(findings)
    drive.preflight_state, drive.preflight_job_id = PreflightState.PENDING, job.id
    session.flush()
    return job


def remove(session: Session, project_id: str, drive_id: str) -> Named:
    """Delete a drive. Its scenes stay; bytes that nothing else needs are collected later.

    Returns
    -------
    Named
        Blobs that it named.

    Raises
    ------
    ServiceError
        404 where the project has no such drive; 409 where a job or a map needs it.
    """
    drive = get(session, project_id, drive_id)
    # The check's job before the drive, as where a check ends: each would else hold what the other waits for.
    checks = jobs.active_of_drive(drive.id).where(Job.kind == JobKind.PREFLIGHT).order_by(Job.id)
    session.scalars(checks.with_for_update()).all()
    drive = get(session, project_id, drive_id, lock=True)
    active = session.scalars(jobs.active_of_drive(drive.id)).all()
    # Sub-maps end with their reconstruction, or have nobody any more who waits for them.
    needing = [job.id for job in active if job.kind not in (JobKind.PREFLIGHT, JobKind.SUBMAP)]
    if needing:
        by = f"{len(needing)} jobs: {', '.join(needing[:3])}" if len(needing) > 1 else f"job {needing[0]}"
        remedy = "Wait until nothing needs it, or cancel what does."
        raise DriveInUse(f"drive {drive.id} is needed by {by}", remedy=remedy)
    require_unused(session, what=f"drive {drive.id}", drive_id=drive.id)
    for job in active:
        jobs.request_cancel(session, job.id)
    named = named_blobs.of_drive(session, drive.id)
    session.execute(delete(Drive).where(Drive.id == drive.id))
    return named
