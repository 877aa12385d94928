"""One file of a drive, from nothing to its bytes.

A long drive has a hundred thousand of these, so an upload's statements are few, and made once.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import bindparam, select, update
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState
from service.errors import ServiceError, not_found
from service.persistence import blobs
from service.persistence.owned import is_id
from service.persistence.storing import StoredFile
from service.persistence.tables import Blob, Drive, DriveFile, now_us


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

_FILL = (
    update(DriveFile)
    .where(
        DriveFile.drive_id == bindparam("drive"),
        DriveFile.path == bindparam("name"),
        DriveFile.blob_id.is_not_distinct_from(bindparam("before")),
    )
    .values(blob_id=bindparam("after"), stored_us=bindparam("now"))
    .execution_options(synchronize_session=False)
)


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
    if slot.sha256 is not None and not replace:
        raise _occupied(slot, f"is stored with SHA-256 {slot.sha256}, these bytes have {stored.sha256}")
    blob = blobs.record(session, project_id=slot.project_id, **stored.identity)
    _put(session, slot, blob.id)
    return blob


def empty(session: Session, slot: Slot) -> None:
    """Forget a slot's bytes.

    Raises
    ------
    ServiceError
        409 where the drive is committed.
    """
    if not slot.is_open:
        raise drive_committed(slot.drive_id)
    _put(session, slot, None)


def _put(session: Session, slot: Slot, blob_id: str | None) -> None:
    values = {"drive": slot.drive_id, "name": slot.path, "before": slot.blob_id, "after": blob_id}
    values["now"] = None if blob_id is None else now_us()  # type: ignore[assignment]
    if not session.connection().execute(_FILL, values).rowcount:
        raise _occupied(slot, "was stored by another upload at this moment")


def not_in_manifest(drive_id: str, path: str) -> ServiceError:
    """422: the manifest names no such file."""
    return ServiceError(
        422,
        "not-in-manifest",
        "The manifest does not name the file",
        f"the manifest of drive {drive_id} names no file {path!r}",
        remedy="Upload under exactly the names that the manifest gives, or create a drive with another manifest.",
    )


def drive_committed(drive_id: str) -> ServiceError:
    """409: a committed drive does not change."""
    return ServiceError(
        409,
        "drive-committed",
        "The drive is committed",
        f"drive {drive_id} was committed and does not change any more",
        remedy="Reconstruct it as it is, or create a new drive: files that are stored need not be sent again.",
    )


def _occupied(slot: Slot, what: str) -> ServiceError:
    return ServiceError(
        409,
        "file-exists",
        "Another content is stored under this name",
        f"{slot.path!r} {what}",
        remedy="If these are the right ones, send them again with ?replace=true; if not, see who else writes this "
        "drive.",
    )
