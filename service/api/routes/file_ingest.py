"""Bytes in the spool become files of a drive, however they came."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

import anyio.from_thread
from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.drives import DriveFileResource, StoredFiles
from schemas.parsing import DocumentError, parse_json
from service.api.context import DOCUMENT_WITHIN_S, Context
from service.api.manifests.bounded_process import LARGE_BYTES
from service.api.manifests.manifest_check import stored_manifest
from service.database.tables import Blob, DriveFile, Project
from service.domain import drive_files, drives
from service.errors import ServiceError
from service.storage import blobs
from service.storage.blob_writer import BlobWriter
from service.storage.spool import Spooled
from service.storage.uploads.archive import unpack
from service.storage.uploads.archive_limits import ArchiveLimits
from service.storage.uploads.archive_watch import ArchiveWatch
from service.storage.uploads.images import check_image

_ENTRY_BYTES = 4096  # of an archive, around each file: headers, names twice, padding


def require_wanted(
    context: Context,
    project_id: str,
    drive_id: str,
    path: str,
    *,
    sha256: str | None = None,
    size_bytes: int | None = None,
) -> None:
    """Refuse a file that would not be taken, before its bytes are; with what is known of them."""
    with context.database.read() as session:
        slot = drive_files.find(session, project_id, drive_id, path)
    drive_files.require_taken(slot, sha256=sha256, size_bytes=size_bytes)


def require_open(context: Context, project_id: str, drive_id: str) -> None:
    """Refuse an archive that comes too late, before its bytes do."""
    with context.database.read() as session:
        drives.require_open(drives.get(session, project_id, drive_id))


def require_room(context: Context, project_id: str, drive_id: str, size_bytes: int | None) -> int:
    """Return the largest size of an archive; refuse one that comes too late, or is too large for the project's quota.

    What the drive has already may come once more: a client that got no answer repeats its request.

    Parameters
    ----------
    size_bytes
        That it is announced to have, if it is.
    """
    bound = context.settings.max_archive_bytes
    with context.database.read() as session:
        drive = drives.get(session, project_id, drive_id)
        drives.require_open(drive)
        project = session.get_one(Project, project_id)
        there = drives.stored_of(session, [drive])[drive_id]
    left_bytes = max(0, project.max_bytes - project.used_bytes) + there.size_bytes
    left_bytes += _ENTRY_BYTES * (drive.files_expected + 1)
    if size_bytes is not None and left_bytes < size_bytes <= bound:
        raise blobs.quota_full(project, size_bytes)
    return min(bound, left_bytes)


def archive_watch(context: Context, project_id: str, drive_id: str) -> ArchiveWatch:
    """Watch over the names of an archive of a drive's files, to refuse a wrong one before all bytes came."""
    with context.database.read() as session:
        drive = drives.get(session, project_id, drive_id)
        files_expected = drive.files_expected

    def known(paths: Sequence[str]) -> set[str]:
        with context.database.read() as session:
            return drives.named_files(session, drive_id, paths)

    return ArchiveWatch(known, files_expected, max_ratio=context.settings.max_compression_ratio)


def keep_file(
    context: Context, project_id: str, drive_id: str, path: str, spooled: Spooled, replace: bool
) -> tuple[bool, DriveFileResource]:
    """Make spooled bytes a file of an open drive.

    Returns
    -------
    new, file
        Whether they were not there before.

    Raises
    ------
    ServiceError
        415 or 422 where they are no image, 404, 409, 413 as in `drive_files`.
    """
    try:
        check_image(spooled.path, path)
    except ServiceError:
        require_wanted(context, project_id, drive_id, path)  # that there is no such drive matters more
        raise
    with BlobWriter(context.database, context.artifacts, project_id=project_id, durable=False) as store:
        stored = store(spooled.path, sha256=spooled.sha256, size_bytes=spooled.size_bytes)

        def record(session: Session) -> tuple[drive_files.Slot, blobs.Recorded | None]:
            slot = drive_files.find(session, project_id, drive_id, path, lock=True)
            return slot, drive_files.fill(session, slot, stored, replace=replace)

        slot, blob = context.database.transact(record, durable=False)  # the drive's commit makes it so
        if blob is not None:
            store.recorded(blob.key)
    return blob is not None, DriveFileResource.model_validate(
        {"path": path, "role": slot.role, "stored": True, "size_bytes": stored.size_bytes, "sha256": stored.sha256}
    )


def keep_archive(context: Context, project_id: str, drive_id: str, archive: Spooled, replace: bool) -> StoredFiles:
    """Store all files of an archive in an open drive, or none of them."""
    with context.database.read() as session:
        drive = drives.get(session, project_id, drive_id)
        expected = set(session.scalars(select(DriveFile.path).where(DriveFile.drive_id == drive.id)))
        manifest_key = session.get_one(Blob, drive.manifest_blob_id).key
        project = session.get_one(Project, project_id)
        # Each file is new, and fits what is left of the quota, or one of those that the project has.
        max_stored_bytes = max(project.max_bytes, project.used_bytes)
    settings = context.settings
    unpacked = unpack(
        archive.path,
        expected,
        same_manifest=lambda raw: _same_manifest(context, project_id, raw, stored_manifest(context, manifest_key)),
        folder=settings.spool_dir,
        limits=ArchiveLimits(
            max_entries=3 * len(expected) + 1000,
            max_bytes=settings.max_archive_bytes,
            max_ratio=settings.max_compression_ratio,
            max_file_bytes=settings.max_file_bytes,
            min_free_bytes=settings.min_free_disk_bytes,
            max_stored_bytes=max_stored_bytes,
        ),
    )
    try:
        return _keep_all(context, project_id, drive_id, unpacked, replace)
    finally:
        for _, spooled in unpacked:
            spooled.discard()


def _keep_all(
    context: Context, project_id: str, drive_id: str, unpacked: list[tuple[str, Spooled]], replace: bool
) -> StoredFiles:
    with BlobWriter(context.database, context.artifacts, project_id=project_id, durable=False) as store:
        contents = {spooled.sha256: spooled for _, spooled in unpacked}
        stored = store.store_all(list(contents.values()))
        # An archive may hold a hundred thousand files, and in SQLite all others who write wait for each transaction:
        # what takes long comes before the one that lets all files appear together.
        recorded = store.record(stored)
        blob_ids = {name: recorded[spooled.sha256].id for name, spooled in unpacked}

        def fill(session: Session) -> None:
            drive = drives.get(session, project_id, drive_id, lock=True)
            drive_files.fill_all(session, drive, blob_ids, replace=replace)

        context.database.transact(fill)
        store.used()
    with context.database.read() as session:
        drive = drives.get(session, project_id, drive_id)
        count = drives.stored_of(session, [drive])[drive_id].files
    return StoredFiles(stored=len(unpacked), files_stored=count, files_expected=drive.files_expected)


def _same_manifest(context: Context, project_id: str, raw: bytes, stored: bytes) -> bool:
    """Return whether a file is the drive's manifest, perhaps written in another way.

    A large one takes ten times its size while it is parsed, and here there are two: beyond a bound they have to be the
    same bytes.
    """
    if raw == stored:
        return True
    bound = context.settings.max_json_bytes
    try:
        with _in_turn(context, project_id) if max(len(raw), len(stored)) > LARGE_BYTES else nullcontext():
            return bool(parse_json(raw, max_bytes=bound) == parse_json(stored, max_bytes=bound))
    except (DocumentError, RecursionError):
        return False


@contextmanager
def _in_turn(context: Context, project_id: str) -> Iterator[None]:
    """Take turns with large bodies, from a thread of `anyio.to_thread`."""
    place = context.large_documents.place(project_id, within_s=DOCUMENT_WITHIN_S)
    anyio.from_thread.run(place.__aenter__)
    try:
        yield
    finally:
        anyio.from_thread.run(place.__aexit__, None, None, None)
