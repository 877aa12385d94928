"""One file of a drive, from nothing to its bytes.

A long drive has a hundred thousand of these, so an upload's statements are few, and made once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import bindparam, select, update
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState
from service.database.tables import Blob, Drive, DriveFile, now_us
from service.domain.access import is_id
from service.errors import DriveCommitted, FileExists, NotInManifest, ServiceError, not_found
from service.storage import blobs
from service.storage.blob_writer import StoredFile


@dataclass(frozen=True, kw_only=True)
class Slot:
    """A file that a drive's manifest names; `blob_id` and what follows are None until it has bytes."""

    drive_id: str
    project_id: str
    is_open: bool
    path: str
    role: str
    blob_id: str | None
    sha256: str | None
    size_bytes: int | None


_FIND = (
    select(
        Drive.project_id,
        Drive.state,
        DriveFile.path,
        DriveFile.role,
        DriveFile.blob_id,
        Blob.sha256,
        Blob.size_bytes,
    )
    .select_from(Drive)
    .outerjoin(DriveFile, (DriveFile.drive_id == Drive.id) & (DriveFile.path == bindparam("path")))
    .outerjoin(Blob, DriveFile.blob_id == Blob.id)
    .where(Drive.id == bindparam("drive_id"))
)
# Shared: uploads into one drive go side by side, and its commit, which locks it for itself, waits for them.
_FIND_AND_LOCK = _FIND.with_for_update(read=True, of=Drive)

_SET = (
    update(DriveFile)
    .where(DriveFile.drive_id == bindparam("drive"), DriveFile.path == bindparam("name"))
    .values(blob_id=bindparam("after"), stored_us=bindparam("now"))
    .execution_options(synchronize_session=False)
)
_FILL = _SET.where(DriveFile.blob_id.is_not_distinct_from(bindparam("before")))
_BLOBS_OF = select(DriveFile.path, DriveFile.blob_id).where(DriveFile.drive_id == bindparam("drive"))


def find(session: Session, project_id: str, drive_id: str, path: str, *, lock: bool = False) -> Slot:
    """The slot of a file.

    Parameters
    ----------
    lock
        Keep the drive from being committed until the session ends.

    Raises
    ------
    ServiceError
        404 where the project has no such drive, 422 where its manifest names no such file.
    """
    row = None
    named = path if path.isprintable() else ""  # databases refuse NUL in a parameter; no manifest holds such a name
    if is_id(drive_id):
        statement = _FIND_AND_LOCK if lock else _FIND
        row = session.connection().execute(statement, {"drive_id": drive_id, "path": named}).first()
    if row is None or row.project_id != project_id:
        raise not_found("drive", drive_id)
    if row.path is None:
        raise not_in_manifest(drive_id, path)
    return Slot(
        drive_id=drive_id,
        project_id=project_id,
        is_open=row.state == DriveState.OPEN,
        path=path,
        role=row.role,
        blob_id=row.blob_id,
        sha256=row.sha256,
        size_bytes=row.size_bytes,
    )


def require_taken(slot: Slot, *, sha256: str | None, size_bytes: int | None) -> None:
    """Refuse bytes that have not come yet, where it is certain that `fill` will.

    Parameters
    ----------
    sha256, size_bytes
        What is known of them. A committed drive still takes what it has.

    Raises
    ------
    ServiceError
        409 where the drive is committed.
    """
    may_be_same = sha256 in (None, slot.sha256) and size_bytes in (None, slot.size_bytes)
    if not slot.is_open and not may_be_same:
        raise drive_committed(slot.drive_id)


def fill(session: Session, slot: Slot, stored: StoredFile, *, replace: bool) -> blobs.Recorded | None:
    """Give a slot its bytes.

    Returns
    -------
    Recorded or None
        The blob; None where the slot had these bytes already.

    Raises
    ------
    ServiceError
        409 where the drive is committed or another content is stored under the name; 413 where the quota is full.
    """
    if slot.sha256 == stored.sha256:
        return None
    if not slot.is_open:
        raise drive_committed(slot.drive_id)
    _require_free(slot, stored, replace=replace)
    blob = blobs.record(session, project_id=slot.project_id, **stored.identity)
    while not _put(session, slot, blob.id):
        # Another upload was here since the slot was looked at. PostgreSQL lets both look before one of them writes.
        slot = find(session, slot.project_id, slot.drive_id, slot.path)
        if slot.sha256 == stored.sha256:
            return None
        _require_free(slot, stored, replace=replace)
    return blob


def fill_all(session: Session, drive: Drive, blob_ids: Mapping[str, str], *, replace: bool) -> None:
    """Give many slots of a drive, which the session has locked, their bytes: all of them, or none.

    Parameters
    ----------
    blob_ids
        By the names that the manifest gives.

    Raises
    ------
    ServiceError
        409 where the drive is committed or another content is stored under one of the names.
    """
    # Of the whole drive: PostgreSQL, which does not know yet how large a new drive is, would go through it for each
    # batch of names.
    rows = session.connection().execute(_BLOBS_OF, {"drive": drive.id})
    before = {path: blob_id for path, blob_id in rows if path in blob_ids}
    changed = {path: blob_id for path, blob_id in blob_ids.items() if before[path] != blob_id}
    if changed and drive.state != DriveState.OPEN:
        raise drive_committed(drive.id)
    occupied = None if replace else next((path for path in changed if before[path] is not None), None)
    if occupied is not None:
        others, given = (session.get_one(Blob, blob_id) for blob_id in (before[occupied], blob_ids[occupied]))
        raise _occupied(occupied, before=others.sha256, given=given.sha256)
    set_all(session, drive.id, changed)


def set_all(session: Session, drive_id: str, blob_ids: Mapping[str, str]) -> None:
    """Give many slots their bytes, by name, whatever they have."""
    if blob_ids:
        now = now_us()
        values = [{"drive": drive_id, "name": path, "after": blob_id, "now": now} for path, blob_id in blob_ids.items()]
        session.connection().execute(_SET, values)


def empty(session: Session, slot: Slot) -> None:
    """Forget a slot's bytes.

    Raises
    ------
    ServiceError
        409 where the drive is committed.
    """
    if not slot.is_open:
        raise drive_committed(slot.drive_id)
    while not _put(session, slot, None):
        slot = find(session, slot.project_id, slot.drive_id, slot.path)


def _put(session: Session, slot: Slot, blob_id: str | None) -> bool:
    """Write the bytes of a file if it is still as it was found, and return whether it was."""
    values = {"drive": slot.drive_id, "name": slot.path, "before": slot.blob_id, "after": blob_id}
    values["now"] = None if blob_id is None else now_us()  # type: ignore[assignment]
    return bool(session.connection().execute(_FILL, values).rowcount)


def _require_free(slot: Slot, stored: StoredFile, *, replace: bool) -> None:
    if slot.sha256 is not None and not replace:
        raise _occupied(slot.path, before=slot.sha256, given=stored.sha256)


def not_in_manifest(drive_id: str, path: str) -> ServiceError:
    """422: the manifest names no such file."""
    return NotInManifest(
        f"the manifest of drive {drive_id} names no file {path!r}",
        remedy="Upload under exactly the names that the manifest gives, or create a drive with another manifest.",
    )


def drive_committed(drive_id: str) -> ServiceError:
    """409: a committed drive does not change."""
    return DriveCommitted(
        f"drive {drive_id} was committed and does not change any more",
        remedy="Reconstruct it as it is, or create a new drive: files that are stored need not be sent again.",
    )


def _occupied(path: str, *, before: str, given: str) -> ServiceError:
    return FileExists(
        f"{path!r} is stored with SHA-256 {before}, these bytes have {given}",
        remedy="If these are the right ones, send them again with ?replace=true; if not, see who else writes this "
        "drive.",
    )
