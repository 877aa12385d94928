"""Durability of uploaded bytes: they are safe from a power cut at the latest when their drive is committed.

A killed process loses nothing that it wrote to a file; a machine that loses power does. To put every file on the disk
for good before its upload is answered would make uploads several times slower. So files of open drives may still be on
their way to the disk; a commit waits for them. A blob remembers under which start of the machine it was written: after
another start its bytes are compared with its digest, and where they did not survive the file counts as not uploaded.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from service.database.connections import Database
from service.database.tables import Blob, DriveFile
from service.storage import blobs
from service.storage.artifacts import ArtifactStore

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_BATCH = 500
_AT_ONE_TIME = 8  # a disk does several flushes together


@functools.cache
def boot_id() -> str | None:
    """Names this start of the machine; None where the system has no name for it."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or None
    except OSError:
        return None


def unsynced_of(session: Session, drive_id: str, *, limit: int = _BATCH) -> Sequence[Blob]:
    """Blobs of a drive's files that a power cut could still take."""
    mine = select(DriveFile.blob_id).where(DriveFile.drive_id == drive_id)
    return session.scalars(select(Blob).where(Blob.id.in_(mine), Blob.written_in_boot.is_not(None)).limit(limit)).all()


def secure_drive(database: Database, artifacts: ArtifactStore, drive_id: str) -> None:
    """Wait until all bytes of a drive are on the disk; files whose bytes did not survive count as not uploaded."""
    with ThreadPoolExecutor(_AT_ONE_TIME, thread_name_prefix="secure") as pool:
        while True:
            with database.read() as session:
                found = unsynced_of(session, drive_id)
            if not found:
                return
            survived = list(pool.map(lambda blob: _secure(artifacts, blob), found))
            with database.write() as session:
                blobs.lock_project(session, found[0].project_id)
                safe = [blob.id for blob, there in zip(found, survived, strict=True) if there]
                session.execute(update(Blob).where(Blob.id.in_(safe)).values(written_in_boot=None))
                for blob, there in zip(found, survived, strict=True):
                    if not there:
                        blobs.lose(session, blob.id)


def _secure(artifacts: ArtifactStore, blob: Blob) -> bool:
    """Put a blob's bytes on the disk; whether they are still the right ones."""
    if blob.written_in_boot != boot_id() and artifacts.sha256_of(blob.key) != blob.sha256:
        return False
    try:
        artifacts.sync(blob.key)
    except FileNotFoundError:
        return False
    return True
