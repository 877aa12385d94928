"""Resumable uploads on record: what was announced, and how far it is for certain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Select, delete, func, select
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState
from service.database.tables import Drive, Project, Upload, new_id, now_us
from service.domain import drive_files, drives
from service.domain.access import require
from service.errors import EmptyArchive, ImageRefused, TooManyUploads, UploadExpired, not_found
from service.storage import blobs
from service.storage.blob_writer import StoredFile

MAX_OPEN = 1000  # of a project: each is a file in the spool


@dataclass(frozen=True, kw_only=True)
class Announced:
    """Announcement of an upload.

    Attributes
    ----------
    path
        As the manifest names it; None for an archive.
    metadata
        As it came, to be given back.
    """

    path: str | None
    size_bytes: int
    sha256: str | None
    replace: bool
    metadata: str


def create(session: Session, *, project_id: str, drive_id: str, announced: Announced, expires_us: int) -> Upload:
    """Record an upload. One whose content a drive of the project has already is done at once.

    Raises
    ------
    ServiceError
        404, 409 and 422 as for a PUT of the file; 413 where the quota has no room for it; 429 where too many are open.
    """
    drive = drives.get(session, project_id, drive_id, lock=True)
    drives.require_open(drive)
    _require_bytes(announced)
    known = None
    if announced.path is not None:
        slot = drive_files.find(session, project_id, drive_id, announced.path)
        digests = [] if announced.sha256 is None else [announced.sha256]
        known = drives.known_files(session, project_id, digests).get(announced.sha256 or "")
        if known is not None and known.size_bytes == announced.size_bytes:
            there = StoredFile(sha256=known.sha256, size_bytes=known.size_bytes, key=known.key, is_new=False)
            drive_files.fill(session, slot, there, replace=announced.replace)
        else:
            known = None
    if known is None:
        _require_room(session, project_id, announced.size_bytes)
    upload = Upload(
        id=new_id("upl"),
        project_id=project_id,
        drive_id=drive_id,
        path=announced.path,
        size_bytes=announced.size_bytes,
        sha256=announced.sha256,
        given_metadata=announced.metadata,
        replace=announced.replace,
        kept_bytes=0 if known is None else announced.size_bytes,
        is_done=known is not None,
        expires_us=expires_us,
    )
    session.add(upload)
    session.flush()
    return upload


def _require_bytes(announced: Announced) -> None:
    """Refuse an upload of nothing: no request would end it, because none would have bytes to append."""
    if announced.size_bytes > 0:
        return
    if announced.path is None:
        raise EmptyArchive("the archive is empty (0 bytes)", remedy="Make it again, with the drive's images in it.")
    what, remedy = f"image {announced.path} is empty (0 bytes)", "Copy it again from its source."
    raise ImageRefused(what, remedy=remedy, code="empty-file")


def _require_room(session: Session, project_id: str, size_bytes: int) -> None:
    """Count announced bytes as if they were here: many uploads cannot share the last free bytes.

    Uploads into a drive that was committed meanwhile come to nothing, and count nothing.
    """
    project = session.get_one(Project, project_id, with_for_update={"key_share": True})
    still_open = (Upload.project_id == project_id) & ~Upload.is_done & (Upload.expires_us > now_us())
    announced = select(func.count(), func.coalesce(func.sum(Upload.size_bytes), 0)).select_from(Upload)
    announced = announced.join(Drive, Drive.id == Upload.drive_id).where(still_open, Drive.state == DriveState.OPEN)
    count, coming_bytes = session.execute(announced).one()
    if count >= MAX_OPEN:
        raise TooManyUploads(
            f"the project has {count} uploads that are not complete, the bound is {MAX_OPEN}",
            remedy="Finish some, or end them with DELETE.",
        )
    if project.used_bytes + int(coming_bytes) + size_bytes > project.max_bytes:
        raise blobs.quota_full(project, size_bytes, coming_bytes=int(coming_bytes))


def get(session: Session, project_id: str, drive_id: str, upload_id: str) -> Upload:
    """The drive's upload.

    Raises
    ------
    ServiceError
        404; 410 where its time is over.
    """
    upload = require(session, Upload, project_id, upload_id)
    if upload.drive_id != drive_id:
        raise not_found("upload", upload_id)
    if upload.expires_us < now_us() and not upload.is_done:
        raise UploadExpired(
            f"upload {upload_id} was not gone on with in time, and its bytes were dropped",
            remedy="Create a new upload and send the file from its beginning.",
        )
    return upload


def unfinished(drive_id: str, *, sha256: str | None) -> Select[Upload]:
    """Statement for the uploads of a drive that take bytes still, of one digest or of any."""
    statement = select(Upload).where(Upload.drive_id == drive_id, ~Upload.is_done, Upload.expires_us > now_us())
    return statement if sha256 is None else statement.where(Upload.sha256 == sha256)


def forget(session: Session, upload_id: str) -> None:
    """Delete an upload's record."""
    session.execute(delete(Upload).where(Upload.id == upload_id))


def forget_expired(session: Session, *, before_us: int) -> None:
    """Delete the records of uploads whose time was over at some moment."""
    session.execute(delete(Upload).where(Upload.expires_us < before_us))


def alive(session: Session, upload_ids: Sequence[str]) -> set[str]:
    """The uploads that still need their bytes."""
    needed = (Upload.id.in_(upload_ids)) & ~Upload.is_done & (Upload.expires_us > now_us())
    return set(session.scalars(select(Upload.id).where(needed)))
