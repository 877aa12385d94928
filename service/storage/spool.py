"""Writes bytes from outside to files of ours, hashed and bounded: the whole file is there, or nothing."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import re
import secrets
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Generic, Protocol, TypeVar

import anyio

from service.errors import DiskFull, ServiceError, WrongDigest, WrongLength, require_size

Result = TypeVar("Result")
Written = TypeVar("Written", covariant=True)
Part = bytes | bytearray | memoryview
Look = Callable[[Path], None]
DiskLimiter = asyncio.Semaphore | anyio.CapacityLimiter

BATCH_BYTES = 1 << 20  # written and hashed at a time: large enough that the switch to a thread costs nothing

_SUFFIX = ".part"
_OURS = re.compile(r"[0-9a-f]{32}\.part")
# EFBIG is a file system's or a resource limit's bound on one file: to the client it is the same.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


@dataclass(frozen=True)
class Spooled:
    """A file that was received whole and is on the disk. As a context manager it removes the file at the end.

    Parameters
    ----------
    path
        Of a name of ours. Who wants to keep the file moves it away.
    sha256
        Hexadecimal, in lower case.
    """

    path: Path
    size_bytes: int
    sha256: str

    def discard(self) -> None:
        """Remove the file, if it was not moved away."""
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> Spooled:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()


class SpoolWriter:
    """One file being written. Its methods block; they may be called from several threads, one after the other.

    Parameters
    ----------
    folder
        Made, for us alone, where it is missing.
    min_free_bytes
        How much of the disk must stay free.
    look
        Called with the file's path after each write.

    Raises
    ------
    ServiceError
        507 `disk-full`, here or while writing; what `look` raises.
    """

    def __init__(self, folder: Path, *, min_free_bytes: int, look: Look | None = None) -> None:
        self._folder = folder
        self._look = look
        self._min_free_bytes = min_free_bytes
        self._hash = hashlib.sha256()
        self._size_bytes = 0
        # An upload that is cancelled leaves its thread writing: discard() has to wait for it, else it would write to
        # whatever file is opened next under the same descriptor.
        self._lock = threading.Lock()
        self.path = folder / (secrets.token_hex(16) + _SUFFIX)
        with full_disk_is_507():
            self._descriptor: int | None = self._open()

    def _open(self) -> int:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            return os.open(self.path, flags, 0o600)
        except FileNotFoundError:  # the first of all
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.open(self.path, flags, 0o600)

    def write(self, *parts: Part) -> None:
        """Append; nothing happens after `discard`."""
        with self._lock:
            if self._descriptor is None:
                return
            self._append(self._descriptor, parts)
            if self._look is not None:
                self._look(self.path)

    def _append(self, descriptor: int, parts: Sequence[Part]) -> None:
        with full_disk_is_507():
            # In one piece: each call to write and hash hands Python's lock over and has to get it back.
            data = parts[0] if len(parts) == 1 else b"".join(parts)
            require_space(self._folder, len(data), min_free_bytes=self._min_free_bytes)
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            self._hash.update(data)
            self._size_bytes += len(data)

    def finish(self, *parts: Part) -> Spooled:
        """Append the last bytes. Whoever keeps the file for good sees to it that it survives a power cut."""
        with self._lock, full_disk_is_507():
            if self._descriptor is not None:
                self._append(self._descriptor, parts)
            self._close()
        return Spooled(self.path, self._size_bytes, self._hash.hexdigest())

    def discard(self) -> None:
        """Close and remove the file, finished or not."""
        with self._lock:
            self._close()
            self.path.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)


async def receive(
    stream: AsyncIterator[bytes],
    folder: Path,
    *,
    max_bytes: int,
    expected_bytes: int | None,
    expected_sha256: str | None,
    min_free_bytes: int,
    on_disk: DiskLimiter,
    look: Look | None = None,
) -> Spooled:
    """As `receive_into`; the file itself."""
    return await receive_into(
        lambda spooled: spooled,
        stream,
        folder,
        max_bytes=max_bytes,
        expected_bytes=expected_bytes,
        expected_sha256=expected_sha256,
        min_free_bytes=min_free_bytes,
        on_disk=on_disk,
        look=look,
    )


async def receive_into(
    keep: Callable[[Spooled], Result],
    stream: AsyncIterator[bytes],
    folder: Path,
    *,
    max_bytes: int,
    expected_bytes: int | None,
    expected_sha256: str | None,
    min_free_bytes: int,
    on_disk: DiskLimiter,
    look: Look | None = None,
) -> Result:
    """Write a request's body to a file of the spool folder, in constant memory and off the event loop.

    Whatever goes wrong, also a client that goes away and a cancelled task, nothing stays behind.

    Parameters
    ----------
    keep
        What becomes of the file. Called in the thread that wrote its last bytes, while it holds its place on the disk.
        Where it raises, the file is removed.
    stream
        The body's chunks.
    expected_bytes, expected_sha256
        What the client announced, if it did; the digest is hexadecimal.
    on_disk
        Bounds how many uploads write at one time. It is held for each batch, not for the whole upload: slow clients
        hold nobody up.
    look
        Called with the file's path after each batch but the last; it may raise to refuse the rest.

    Raises
    ------
    ServiceError
        413 `too-large`, 400 `wrong-length`, 422 `wrong-digest` or 507 `disk-full`.
    """
    require_size(expected_bytes or 0, max_bytes)
    writer = BatchWriter(SpoolWriter(folder, min_free_bytes=min_free_bytes, look=look), on_disk)
    try:
        if expected_bytes is not None:
            require_space(folder, expected_bytes, min_free_bytes=min_free_bytes)
        received_bytes = batched_bytes = 0
        batch: list[bytes] = []
        async for chunk in stream:
            received_bytes += len(chunk)
            if expected_bytes is not None and received_bytes > expected_bytes:
                raise _wrong_length("more than", expected_bytes)
            require_size(received_bytes, max_bytes)
            batch.append(chunk)
            batched_bytes += len(chunk)
            if batched_bytes >= BATCH_BYTES:
                await writer.write(batch)
                batch, batched_bytes = [], 0
        if expected_bytes is not None and received_bytes < expected_bytes:
            raise _wrong_length(f"{received_bytes} of", expected_bytes)
        return await writer.finish(batch, lambda spooled: keep(_checked(spooled, expected_sha256)))
    except BaseException:
        with anyio.CancelScope(shield=True):
            await writer.discard()
        raise


def sweep(folder: Path, *, older_than_s: float) -> int:
    """Remove what a killed process left in the spool folder.

    Parameters
    ----------
    older_than_s
        Since the last write. Longer than any upload is worked on after its last byte, an archive's unpacking included.

    Returns
    -------
    int
        How many files were removed.
    """
    removed, now_s = 0, time.time()
    if not folder.is_dir():
        return removed
    for entry in os.scandir(folder):
        if not _OURS.fullmatch(entry.name):
            continue
        try:
            if now_s - entry.stat(follow_symlinks=False).st_mtime > older_than_s:
                os.unlink(entry.path)
                removed += 1
        except FileNotFoundError:  # its upload ended at this moment
            continue
    return removed


def require_space(folder: Path, size_bytes: int, *, min_free_bytes: int) -> None:
    """Refuse bytes for which the disk has no room.

    Raises
    ------
    ServiceError
        507 `disk-full`, if fewer than `min_free_bytes` would stay free.
    """
    disk = os.statvfs(folder)
    free_bytes = disk.f_bavail * disk.f_frsize
    if free_bytes - size_bytes < min_free_bytes:
        raise _disk_full(f"{free_bytes} bytes are free, {min_free_bytes} must stay free")


class Writer(Protocol[Written]):
    """Writer of batches, one after the other."""

    def write(self, *parts: Part) -> None:
        """Append."""

    def finish(self, *parts: Part) -> Written:
        """Append the last; what was written."""

    def discard(self) -> None:
        """End it without."""


class BatchWriter(Generic[Written]):
    """Writes one batch in a thread while the next one is being received.

    A batch that could not be written ends it: every later call raises the same again, so that nothing is written in
    the place of what is missing.
    """

    def __init__(self, writer: Writer[Written], on_disk: DiskLimiter) -> None:
        self._writer = writer
        self._on_disk = on_disk
        self._writing: asyncio.Task[None] | None = None

    async def write(self, batch: list[bytes]) -> None:
        """Begin to write a batch, once the one before is written."""
        await self._written()
        self._writing = asyncio.create_task(self._off_the_loop(self._writer.write, batch))

    async def finish(self, batch: list[bytes], keep: Callable[[Written], Result]) -> Result:
        """Write the last batch, and do in the same thread what is to be done with all of it."""
        await self._written()
        return await self._off_the_loop(lambda *parts: keep(self._writer.finish(*parts)), batch)

    async def discard(self) -> None:
        """Write nothing any more."""
        if self._writing is not None:
            self._writing.cancel()
            await asyncio.gather(self._writing, return_exceptions=True)
        await asyncio.to_thread(self._writer.discard)

    async def _written(self) -> None:
        if self._writing is not None:
            # A request that is cancelled must not take the batch along: the next one would be written in its place.
            await asyncio.shield(self._writing)
            self._writing = None

    async def _off_the_loop(self, function: Callable[..., Result], batch: list[bytes]) -> Result:
        async with self._on_disk:
            return await asyncio.to_thread(function, *batch)


@contextmanager
def full_disk_is_507() -> Iterator[None]:
    """Make a full disk what the client is told."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise _disk_full(os.strerror(error.errno)) from error
        raise


def _checked(spooled: Spooled, expected_sha256: str | None) -> Spooled:
    if expected_sha256 is not None and spooled.sha256 != expected_sha256.lower():
        raise WrongDigest(
            f"the bytes received have the SHA-256 {spooled.sha256}, announced is {expected_sha256.lower()}",
            remedy="Send the file again; if it was changed since the digest was taken, take it anew.",
        )
    return spooled


def _wrong_length(received: str, expected_bytes: int) -> ServiceError:
    return WrongLength(
        f"{received} the {expected_bytes} bytes announced were received",
        remedy="Send the whole file again, with its size as it is now.",
    )


def _disk_full(why: str) -> ServiceError:
    return DiskFull(
        f"the service has no room for these bytes: {why}",
        remedy="Try again later; who runs the service has to free space on the disk of its data folder.",
    )
