"""The bytes of resumable uploads: appended to a file that outlives requests, processes and, as far as told, power.

A killed process loses nothing that it wrote, so within one start of the machine the file's size says how far an upload
is; that is the upload's `tail_boot`. After another start only `kept_bytes` count, which were put on the disk before
they were recorded. Bytes that came with a checksum count once it was compared: until then `tail_boot` is None.
What is told to a client, in an answer to PATCH or HEAD, was put on the disk first.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import anyio

from service.errors import ServiceError, UploadLocked, require_size
from service.storage.spool import BATCH_BYTES, BatchWriter, DiskLimiter, Look, Part, full_disk_is_507, require_space

_FLAGS = os.O_NOFOLLOW | os.O_CLOEXEC
_OURS = re.compile(r"(upl_[0-9a-f]{30})\.bytes")


class Hash(Protocol):
    """Interface of a hash of hashlib."""

    def update(self, data: Part, /) -> None:
        """Take in bytes."""

    def digest(self) -> bytes:
        """Digest of all bytes so far."""


class PartialFile:
    """The bytes of an upload, held by one request: a lock of the kernel's, which ends with the process.

    Raises
    ------
    ServiceError
        423 where another request holds them.
    """

    def __init__(self, folder: Path, upload_id: str) -> None:
        self._folder = folder
        self.path = self._folder / f"{upload_id}.bytes"
        with full_disk_is_507():
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._descriptor = self._open(upload_id)

    def _open(self, upload_id: str) -> int:
        while True:
            try:
                descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | _FLAGS, 0o600)
            except PermissionError:  # its bytes are an object of the store already: nothing is written any more
                descriptor = os.open(self.path, os.O_RDONLY | _FLAGS)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with suppress(FileNotFoundError):  # removed between the two lines by who held it: made anew
                    if os.path.samestat(os.fstat(descriptor), os.stat(self.path)):
                        return descriptor
            except BlockingIOError:
                os.close(descriptor)
                raise _locked(upload_id) from None
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    def size(self) -> int:
        """Bytes in the file."""
        return os.fstat(self._descriptor).st_size

    def offset(self, kept_bytes: int, tail_boot: str | None, boot: str | None) -> int:
        """Number of bytes that count; none where the file is gone with its disk."""
        counts_all = tail_boot is not None and tail_boot == boot
        return self.size() if counts_all else min(kept_bytes, self.size())

    def truncate(self, size_bytes: int) -> None:
        """Drop all bytes from there on."""
        if self.size() > size_bytes:
            os.ftruncate(self._descriptor, size_bytes)

    def sync(self) -> None:
        """Return when the bytes, and the file's name, survive a power cut."""
        with full_disk_is_507():
            os.fdatasync(self._descriptor)
            folder = os.open(self._folder, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def append_at(self, offset: int, data: Part, *, min_free_bytes: int) -> None:
        """Write at the end, which is `offset`."""
        with full_disk_is_507():
            require_space(self._folder, len(data), min_free_bytes=min_free_bytes)
            rest = memoryview(data)
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                rest, offset = rest[written:], offset + written

    def remove(self) -> None:
        """Remove the file; the lock is held until `close`."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._descriptor)


class Appender:
    """Appends what one request brings. Its methods block; they may be called from several threads in turn.

    Parameters
    ----------
    offset
        Where the bytes go: the file's end.
    checksum
        Takes in what is appended, and so does `whole`, which is None where the file does not begin with it.
    look
        Called with the file's path after each write.
    """

    def __init__(
        self,
        file: PartialFile,
        *,
        offset: int,
        min_free_bytes: int,
        checksum: Hash | None,
        whole: Hash | None,
        look: Look | None = None,
    ) -> None:
        self._look = look
        self._file = file
        self._min_free_bytes = min_free_bytes
        self._hashes = [taken for taken in (checksum, whole) if taken is not None]
        self._lock = threading.Lock()  # a request that is cancelled leaves its thread writing
        self._ended = False
        self.offset = offset

    def write(self, *parts: Part) -> None:
        """Append; nothing happens after `discard`."""
        with self._lock:
            if self._ended:
                return
            data = parts[0] if len(parts) == 1 else b"".join(parts)
            self._file.append_at(self.offset, data, min_free_bytes=self._min_free_bytes)
            for taken in self._hashes:
                taken.update(data)
            self.offset += len(data)
            if self._look is not None:
                self._look(self._file.path)

    def finish(self, *parts: Part) -> int:
        """Append the last bytes; where the file then ends."""
        self.write(*parts)
        return self.offset

    def discard(self) -> None:
        """Write nothing any more. What was written stays: its owner knows whether it counts."""
        with self._lock:
            self._ended = True


async def append(stream: AsyncIterator[bytes], appender: Appender, *, max_bytes: int, on_disk: DiskLimiter) -> int:
    """Write a request's body to the end of an upload, in constant memory and off the event loop.

    Returns
    -------
    int
        Where the upload ends now.

    Raises
    ------
    ServiceError
        413 where there are more than `max_bytes`, 507 where the disk is full, and what the stream raises. What had
        come until then is written, but for the first; behind what could not be written, nothing is.
    """
    writer: BatchWriter[int] = BatchWriter(appender, on_disk)
    batch: list[bytes] = []
    received_bytes = batched_bytes = 0
    try:
        async for chunk in stream:
            received_bytes += len(chunk)
            if received_bytes > max_bytes:
                batch = []
            require_length(received_bytes, max_bytes)
            batch.append(chunk)
            batched_bytes += len(chunk)
            if batched_bytes >= BATCH_BYTES:
                await writer.write(batch)
                batch, batched_bytes = [], 0
        last, batch = batch, []  # handed over: where that fails, it may be in the file already
        return await writer.finish(last, _as_it_is)
    except BaseException:
        with anyio.CancelScope(shield=True):
            await _write_rest(writer, batch)
        raise


async def _write_rest(writer: BatchWriter[int], batch: list[bytes]) -> None:
    """Write what had come before a request broke, where that can be written, and nothing after it."""
    try:
        with suppress(Exception):  # the request ends with what broke it
            await writer.finish(batch, _as_it_is)
    finally:
        await writer.discard()


def _as_it_is(offset: int) -> int:
    return offset


def new_hash(algorithm: str) -> Hash:
    """Make a hash of an algorithm that tus names."""
    return hashlib.new(algorithm)


def sweep(folder: Path, alive: Callable[[Sequence[str]], set[str]]) -> int:
    """Remove the bytes of uploads that ended, expired, or whose drive was deleted.

    Parameters
    ----------
    alive
        Those of some uploads that need their bytes. A record is there before its bytes are.

    Returns
    -------
    int
        How many files were removed.
    """
    found = {match[1] for entry in _listed(folder) if (match := _OURS.fullmatch(entry))}
    removed = 0
    for upload_id in sorted(found - alive(sorted(found))):
        with suppress(ServiceError):  # a request holds it; the next sweep comes
            file = PartialFile(folder, upload_id)
            try:
                if not alive([upload_id]):  # a request that held it may just have gone on with it
                    file.remove()
                    removed += 1
            finally:
                file.close()
    return removed


def _listed(folder: Path) -> list[str]:
    return os.listdir(folder) if folder.is_dir() else []


def _locked(upload_id: str) -> ServiceError:
    return UploadLocked(
        f"another request is sending bytes of upload {upload_id}",
        remedy="Wait until it has ended, then ask for the offset and go on from there.",
        headers={"Retry-After": "1"},
    )


def require_length(size_bytes: int, missing_bytes: int) -> None:
    """Refuse a request with more bytes than the upload misses."""
    require_size(size_bytes, missing_bytes, what="request", remedy="Send no more than Upload-Length says.")
