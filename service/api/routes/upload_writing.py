"""Requests on a resumable upload: query its offset, append to it, end it."""

from __future__ import annotations

import os
import secrets
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import anyio.to_thread
from sqlalchemy import update

from service.api.context import Context
from service.api.http.tus import Checksum
from service.api.routes.file_ingest import archive_watch, keep_archive, keep_file, require_open, require_wanted
from service.database.tables import Upload, now_us
from service.domain import uploads
from service.errors import ChecksumMismatch, ServiceError, WrongDigest, WrongOffset
from service.storage.blob_writer import file_sha256
from service.storage.durability import boot_id
from service.storage.spool import Spooled, require_space
from service.storage.uploads.archive_watch import ArchiveWatch
from service.storage.uploads.resumable import Appender, Hash, PartialFile, append, new_hash, require_length

# What may pass, or be made room for: the bytes wait. Anything else would be answered the same way again.
_MAY_PASS = frozenset({408, 413, 423, 429, 500, 503, 507})
# How long a request waits for another to let go of an upload: somebody may just have looked how far it is, and a
# client that comes back is sooner here than the end of its broken connection.
_LOCK_TIMEOUT_S = 1.0
_POLL_S = 0.05


async def current_offset(context: Context, project_id: str, drive_id: str, upload_id: str) -> tuple[Upload, int]:
    """An upload and how far it is for good.

    One that was killed between its last byte and its end is ended now: a client that sees all bytes there will not
    come back.

    Raises
    ------
    ServiceError
        404, 410, 423, and what its end may raise.
    """
    found = await anyio.to_thread.run_sync(_secured, context, project_id, drive_id, upload_id)
    if isinstance(found, Upload):
        return found, found.size_bytes
    try:
        await found.complete(None)
        return found.upload, found.offset
    finally:
        found.file.close()


def _secured(context: Context, project_id: str, drive_id: str, upload_id: str) -> Upload | _Held:
    """An upload that is done, or one that is held and whose bytes are on the disk."""
    with context.database.read() as session:
        upload = uploads.get(session, project_id, drive_id, upload_id)
    if upload.is_done:
        return upload
    file = PartialFile(context.settings.uploads_dir, upload_id)
    try:
        held = _Held(context, project_id, drive_id, upload_id, file)
        held.require_wanted()
        held.secure()
        held.renew()
    except BaseException:
        file.close()
        raise
    return held


def discard(context: Context, project_id: str, drive_id: str, upload_id: str) -> None:
    """End an upload, and drop its bytes."""
    with context.database.read() as session:
        uploads.get(session, project_id, drive_id, upload_id)
    file = PartialFile(context.settings.uploads_dir, upload_id)
    try:
        with context.database.write() as session:
            uploads.forget(session, upload_id)
        file.remove()
    finally:
        file.close()


class UploadWriting:
    """One request that appends."""

    def __init__(self, context: Context, project_id: str, drive_id: str, upload_id: str) -> None:
        self._context = context
        self._of = (project_id, drive_id, upload_id)

    async def run(
        self, stream: AsyncIterator[bytes], *, offset: int, length: int | None, checksum: Checksum | None
    ) -> tuple[Upload, int]:
        """Append a body, and make the whole the drive's where it is complete.

        Raises
        ------
        ServiceError
            404, 408, 409, 410, 413, 423, 460, 507, and what a PUT of the file may raise.
        """
        held = await self._begun(offset, length, checksum)
        settings = self._context.settings
        compared: Hash | None = None if checksum is None else new_hash(checksum.algorithm)
        whole: Hash | None = new_hash("sha256") if offset == 0 else None
        watch = held.watch
        appender = Appender(
            held.file,
            offset=offset,
            min_free_bytes=settings.min_free_disk_bytes,
            checksum=compared,
            whole=whole,
            look=None if checksum is not None else held.look,  # a byte that was sent wrong must not end the upload
        )
        try:
            try:
                await append(
                    stream,
                    appender,
                    max_bytes=held.upload.size_bytes - offset,
                    on_disk=self._context.disk,
                )
            except BaseException as error:
                drop = checksum is not None or (isinstance(error, ServiceError) and error.status == 413)
                with anyio.CancelScope(shield=True):
                    await anyio.to_thread.run_sync(partial(held.keep, offset if drop else appender.offset))
                raise
            with anyio.CancelScope(shield=True):  # also for a client that does not wait for the answer
                taking = partial(held.take, offset, appender.offset, checksum, compared)
                await anyio.to_thread.run_sync(taking)
                await anyio.to_thread.run_sync(held.look)
                await held.complete(None if whole is None else whole.digest().hex())
            if watch is not None and not held.upload.is_done:
                self._context.archive_watches.put(held.upload.id, watch)
            return held.upload, held.offset
        finally:
            held.file.close()

    async def _begun(self, offset: int, length: int | None, checksum: Checksum | None) -> _Held:
        end_s = anyio.current_time() + _LOCK_TIMEOUT_S
        while True:
            try:
                return await anyio.to_thread.run_sync(partial(self._begin, offset, length, checksum))
            except ServiceError as error:
                if error.status != 423 or anyio.current_time() > end_s:
                    raise
            await anyio.sleep(_POLL_S)

    def _begin(self, offset: int, length: int | None, checksum: Checksum | None) -> _Held:
        context = self._context
        with context.database.read() as session:  # a file is only made for an upload that is
            uploads.get(session, *self._of)
        file = PartialFile(context.settings.uploads_dir, self._of[2])
        try:
            held = _Held(context, *self._of, file)
            held.require_wanted()
            held.begin(offset, length, counts_at_once=checksum is None)
            held.watch_names()
        except BaseException:
            file.close()
            raise
        return held


class _Held:
    """An upload whose bytes this request holds."""

    def __init__(self, context: Context, project_id: str, drive_id: str, upload_id: str, file: PartialFile) -> None:
        self._context = context
        self.file = file
        self.watch: ArchiveWatch | None = None
        with context.database.read() as session:  # after the lock: another request may just have ended
            self.upload = uploads.get(session, project_id, drive_id, upload_id)
        kept_bytes, tail_boot = self.upload.kept_bytes, self.upload.tail_boot
        is_done = self.upload.is_done
        self.offset = self.upload.size_bytes if is_done else file.offset(kept_bytes, tail_boot, boot_id())

    def begin(self, offset: int, length: int | None, *, counts_at_once: bool) -> None:
        """Make ready to append at an offset."""
        if offset != self.offset:
            raise WrongOffset(
                f"upload {self.upload.id} goes on at byte {self.offset}, the request begins at {offset}",
                remedy="Ask for the offset with HEAD and go on from there.",
                headers={"Upload-Offset": str(self.offset)},
            )
        missing_bytes = self.upload.size_bytes - offset
        require_length(length or 0, missing_bytes)
        settings = self._context.settings
        require_space(
            settings.spool_dir, missing_bytes if length is None else length, min_free_bytes=settings.min_free_disk_bytes
        )
        self.file.truncate(offset)
        if counts_at_once:
            self._record(durable=False, tail_boot=boot_id())
        else:  # bytes that were not compared must not count where this process is killed
            self.secure()
            self._record(durable=False, tail_boot=None)

    def watch_names(self) -> None:
        """Watch the names of an archive that comes: with what the request before this one knew of them, or anew."""
        upload, context = self.upload, self._context
        if upload.path is None and not upload.is_done:
            kept = context.archive_watches.take(upload.id)
            self.watch = kept or archive_watch(context, upload.project_id, upload.drive_id)

    def look(self, path: Path | None = None) -> None:
        """Refuse an archive whose names are wrong as far as it has come. At its end all of it is checked."""
        path = path or self.file.path
        if self.watch is not None and self.file.size() < self.upload.size_bytes:
            with self._dropped_where_refused():
                self.watch.look(path)

    def secure(self) -> None:
        """Put all bytes that count on the disk, and record so."""
        if not self.upload.is_done and self.offset > self.upload.kept_bytes:
            self.keep(self.offset)

    def renew(self) -> None:
        """Let the upload live on from now: a client that asks how far it is wants to go on."""
        if not self.upload.is_done:
            self._record(durable=False)

    def keep(self, offset: int) -> None:
        """End the upload here."""
        if self.upload.is_done:
            return
        self.file.truncate(offset)
        self.file.sync()
        self.offset = offset
        # The record must not be lost by what its bytes survive: it waits for the disk, too.
        self._record(durable=True, kept_bytes=offset)

    def require_wanted(self) -> None:
        """Refuse bytes that are to come for nothing: the drive may have been committed since."""
        upload = self.upload
        if upload.is_done or self.offset == upload.size_bytes:
            return
        of = (self._context, upload.project_id, upload.drive_id)
        with self._dropped_where_refused():
            if upload.path is None:
                require_open(*of)
            else:
                require_wanted(*of, upload.path, sha256=upload.sha256, size_bytes=upload.size_bytes)

    def take(self, begin: int, offset: int, checksum: Checksum | None, compared: Hash | None) -> None:
        """Take what was appended, where it is right."""
        if checksum is not None and compared is not None and compared.digest() != checksum.digest:
            self.keep(begin)
            raise ChecksumMismatch(
                f"the bytes from {begin} to {offset} have another {checksum.algorithm} than Upload-Checksum says",
                remedy="They were dropped; send them again.",
                headers={"Upload-Offset": str(begin)},
            )
        self.keep(offset)

    async def complete(self, sha256: str | None) -> None:
        """Make the bytes the drive's once all are there; `sha256` of all of them, where it is known.

        Only what unpacks takes a place of those that may. A file takes a place on the disk, as the end of a PUT does:
        the thread that has it takes no other place, and needs none of those who wait.
        """
        if self.offset == self.upload.size_bytes and not self.upload.is_done:
            if self.upload.path is None:
                await self._context.unpacking.run(self.upload.project_id, self._complete, sha256)
            else:
                await anyio.to_thread.run_sync(self._complete, sha256, limiter=self._context.disk)

    def _complete(self, sha256: str | None) -> None:
        upload = self.upload
        with self._dropped_where_refused():
            sha256 = sha256 or file_sha256(self.file.path)
            if upload.sha256 is not None and sha256 != upload.sha256:
                raise _wrong_digest(upload, sha256)
            self._hand_over(sha256)
        self._record(durable=True, is_done=True)
        self.file.remove()

    @contextmanager
    def _dropped_where_refused(self) -> Iterator[None]:
        try:
            yield
        except ServiceError as error:
            if error.status not in _MAY_PASS:
                self._drop()
            raise

    def _hand_over(self, sha256: str) -> None:
        """Hand the file over as a PUT does.

        The file itself stays until that is recorded: a process that is killed here does it again.
        """
        upload, context = self.upload, self._context
        if upload.path is None:
            whole = Spooled(self.file.path, upload.size_bytes, sha256)
            keep_archive(context, upload.project_id, upload.drive_id, whole, upload.replace)
            return
        link = context.settings.spool_dir / f"{secrets.token_hex(16)}.part"  # swept where it is left behind
        os.link(self.file.path, link)
        with Spooled(link, upload.size_bytes, sha256) as spooled:
            keep_file(context, upload.project_id, upload.drive_id, upload.path, spooled, upload.replace)

    def _drop(self) -> None:
        with self._context.database.write() as session:
            uploads.forget(session, self.upload.id)
        self.file.remove()

    def _record(self, *, durable: bool, **values: object) -> None:
        expires_us = now_us() + int(self._context.settings.upload_hours * 3600e6)
        with self._context.database.write(durable=durable) as session:
            mine = update(Upload).where(Upload.id == self.upload.id)
            session.execute(mine.values(**values, expires_us=expires_us))
        for name, value in {**values, "expires_us": expires_us}.items():
            setattr(self.upload, name, value)


def _wrong_digest(upload: Upload, sha256: str) -> ServiceError:
    return WrongDigest(
        f"the bytes received have the SHA-256 {sha256}, announced is {upload.sha256}",
        remedy="They were dropped: create a new upload. If the file was changed since its digest was taken, take it "
        "anew.",
    )
