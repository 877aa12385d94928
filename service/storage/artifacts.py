"""The artifact store: bytes under keys, in a folder or in S3, GCS or Azure.

A stored object never changes. In a folder, objects come and go by rename and hard link, so that a drive of many
gigabytes is neither copied when it is accepted nor when a stage starts on it.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

import obstore
from obstore.store import from_url

from service.database.connections import Database
from service.settings import Settings
from service.storage import blobs

_CHUNK_BYTES = 1 << 20
_DELETE_BATCH = 500
_PREFIX = "blobs"  # of all keys that are listed
# A store that is silent must not hold the threads of all requests for minutes, as it does by default.
_TIMEOUTS = {
    "connect_timeout": timedelta(seconds=5),
    "read_timeout": timedelta(seconds=30),  # without a byte of the answer; no request sends more than some MiB
    "timeout": timedelta(minutes=15),  # to the last byte of a large object
}
_RETRIES = {"max_retries": 3, "retry_timeout": timedelta(seconds=15)}
# Whether the store can be used is asked often, and a late answer is of no use.
_PROBE_TIMEOUTS = {"connect_timeout": timedelta(seconds=3), "timeout": timedelta(seconds=3)}
_PROBE_RETRIES = {"max_retries": 0}
# Outside a folder each object takes a round trip or several. Of many files a process holds at most this many in memory,
# with the parts of each 160 MB.
_PUTS = 16
_PUTS_OF_REQUEST = 8
_PARTS_OF_PUT = 2  # of 5 MiB

Fetch = Callable[[str, Path], None]  # as `ArtifactStore.fetch`: key, target


class ObjectMissingError(FileNotFoundError):
    """The store has no such object. A folder of the caller's that is missing raises a plain FileNotFoundError."""

    def __init__(self, key: str) -> None:
        super().__init__(errno.ENOENT, "the artifact store has no such object", key)


class StoreAwayError(ConnectionError):
    """The store's folder is not there, or is empty: it was moved, or its disk is not mounted. It may come back."""

    def __init__(self) -> None:
        super().__init__(errno.ENOENT, "the folder of the artifact store is not there, or holds nothing of it")


@dataclass(frozen=True)
class StoredObject:
    """An object as the store lists it; `changed_us` is when it came."""

    key: str
    changed_us: int


class ArtifactStore:
    """Objects in a folder or in the cloud.

    Keys are made by us: relative, with forward slashes. All methods but `stream` block.

    Parameters
    ----------
    is_new
        Asked where the folder holds nothing of a store: whether nothing has been stored yet. Else it is away.
    """

    def __init__(self, settings: Settings, *, is_new: Callable[[], bool]) -> None:
        url = settings.resolved_artifacts_url
        self._root: Path | None = None
        self._store: Any = None
        self._probed: Any = None
        self._is_new = is_new
        self._safe_folders: set[Path] = set()
        self._putting = ThreadPoolExecutor(_PUTS, thread_name_prefix="put")  # has no thread before it is used
        if settings.stores_in_folder:
            self._root = Path(unquote(urlsplit(url).path))
        else:
            self._store = _open(url, settings, _TIMEOUTS, _RETRIES)
            self._probed = _open(url, settings, _PROBE_TIMEOUTS, _PROBE_RETRIES)

    @classmethod
    def open(cls, settings: Settings, database: Database) -> ArtifactStore:
        """The store that the settings name, which is new while the database names no blob."""
        return cls(settings, is_new=lambda: blobs.none_is_recorded(database))

    @property
    def folder(self) -> Path | None:
        """Folder of the objects on this machine, or None where they lie elsewhere."""
        return self._root

    def put_file(self, path: Path, key: str, *, durable: bool = True) -> None:
        """Make the file `path` the object `key`; the file is gone afterwards.

        Where it fails, the file is at `path` as before: it may be tried again, also under another key.

        Parameters
        ----------
        durable
            Whether the object survives a power cut when this returns. In a folder that can wait for `sync`; elsewhere
            it always does.
        """
        if self._root is None:
            self._put_in_parts(path, key)
            return
        os.chmod(path, 0o440)
        target = self._root / key
        self._make_parents(target)
        is_copy = _move_or_copy(path, target)
        try:
            if durable:
                self.sync(key)
        except BaseException:
            with contextlib.suppress(OSError):  # what the disk said first is what matters
                if is_copy:
                    target.unlink()
                else:
                    os.replace(target, path)
            raise
        if is_copy:
            path.unlink()

    def put_files(self, files: Iterable[tuple[Path, str]], *, durable: bool = True) -> None:
        """Make each file an object, several at one time where the store is not a folder; see `put_file`.

        Where one fails, this raises when none is under way any more; some of the objects are there then.
        """
        if self._root is not None:
            for path, key in files:
                self.put_file(path, key, durable=durable)
            return
        under_way: set[Future[None]] = set()
        try:
            for path, key in files:
                if len(under_way) == _PUTS_OF_REQUEST:
                    done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
                    _require_done(done)
                under_way.add(self._putting.submit(self._put_in_parts, path, key))
        finally:
            wait(under_way)
        _require_done(under_way)

    def _put_in_parts(self, path: Path, key: str) -> None:
        """Send a file; of a large one few parts at one time, each of which is in memory until the store has it."""
        obstore.put(self._store, key, path, max_concurrency=_PARTS_OF_PUT)
        path.unlink()

    def sync(self, key: str) -> None:
        """Return when the object survives a power cut.

        Raises
        ------
        FileNotFoundError
            Where the store has no such object.
        StoreAwayError
            Where the store's folder is not there.
        """
        if self._root is None:
            return
        self.require_folder()
        path = self._root / key
        _sync(path)
        _sync(path.parent)
        for folder in path.relative_to(self._root).parents[1:]:
            if folder not in self._safe_folders:  # folders stay: once is enough for each
                _sync(self._root / folder)
                self._safe_folders.add(folder)

    def sha256_of(self, key: str) -> str | None:
        """Digest of the bytes that are in the store now, in hexadecimal; None where there is no such object."""
        digest = hashlib.sha256()
        try:
            if self._root is not None:
                with self._missing_is_told(key), (self._root / key).open("rb") as file:
                    while piece := file.read(_CHUNK_BYTES):
                        digest.update(piece)
            else:
                for chunk in obstore.get(self._store, key).stream(min_chunk_size=_CHUNK_BYTES):
                    digest.update(chunk)
        except FileNotFoundError:
            return None
        return digest.hexdigest()

    def fetch(self, key: str, target: Path, *, check_stop: Callable[[], None] = lambda: None) -> None:
        """Put the object's bytes at `target`, read-only; without copying where the file system allows.

        It may be tried again: where it fails, nothing is left at `target`.

        Parameters
        ----------
        check_stop
            Called between pieces; what it raises ends the transfer.

        Raises
        ------
        ObjectMissingError
            Where the store has no such object.
        FileNotFoundError
            Where the target has no folder, which says nothing about the object.
        """
        if self._root is not None:
            try:
                _link_or_copy(self._root / key, target)
            except (FileNotFoundError, NotADirectoryError):  # the system's own does not tell which of the two it is
                with self._missing_is_told(key):
                    (self._root / key).stat()
                raise
            return
        check_stop()
        try:
            found = obstore.get(self._store, key)  # first: what is not there leaves no empty file
        except FileNotFoundError as error:
            raise ObjectMissingError(key) from error
        with _whole_or_gone(target):
            with target.open("xb") as file:
                for chunk in found.stream(min_chunk_size=_CHUNK_BYTES):
                    check_stop()
                    file.write(chunk)
            os.chmod(target, 0o440)

    @contextlib.contextmanager
    def _missing_is_told(self, key: str) -> Iterator[None]:
        """Tell an object that is missing from a folder that is away."""
        try:
            yield
        except (FileNotFoundError, NotADirectoryError):
            self.require_folder()
            raise ObjectMissingError(key) from None

    def require_folder(self) -> None:
        """Require that the folder of all objects is not away: what was stored meanwhile, nobody would find again.

        A new store gets one.

        Raises
        ------
        StoreAwayError
            Where it is away.
        OSError
            Where it cannot be made.
        """
        if self._root is None or (self._root / _PREFIX).is_dir():
            return
        if not self._is_new():
            raise StoreAwayError
        if not self._root.exists():
            self._root.mkdir(parents=True, exist_ok=True, mode=0o700)
        (self._root / _PREFIX).mkdir(exist_ok=True, mode=0o700)

    def _make_parents(self, target: Path) -> None:
        """Make the folders above an object, but not that of all objects."""
        assert self._root is not None
        if target.parent.is_dir():
            return
        self.require_folder()
        for folder in reversed(target.relative_to(self._root).parents[:-1]):
            if folder == Path(_PREFIX):
                continue
            try:
                (self._root / folder).mkdir(exist_ok=True, mode=0o700)
            except FileNotFoundError:  # it went away meanwhile
                self.require_folder()
                raise

    def read(self, key: str) -> bytes:
        """The whole object, for small ones.

        Raises
        ------
        FileNotFoundError
            Where the store has no such object.
        """
        if self._root is not None:
            with self._missing_is_told(key):
                return (self._root / key).read_bytes()
        return bytes(obstore.get(self._store, key).bytes())

    async def stream(self, key: str, *, start: int, stop: int) -> AsyncIterator[bytes]:
        """Bytes `start` up to, not including, `stop`, piece by piece.

        Raises
        ------
        FileNotFoundError
            Where the store has no such object; at the first piece.
        """
        if self._root is not None:
            file = await asyncio.to_thread(self._opened, key)
            try:
                await asyncio.to_thread(file.seek, start)
                while start < stop:
                    piece = await asyncio.to_thread(file.read, min(_CHUNK_BYTES, stop - start))
                    if not piece:
                        return
                    start += len(piece)
                    yield piece
            finally:
                file.close()
        else:
            while start < stop:
                end = min(start + 8 * _CHUNK_BYTES, stop)
                yield bytes(await obstore.get_range_async(self._store, key, start=start, end=end))
                start = end

    def _opened(self, key: str) -> BinaryIO:
        assert self._root is not None
        with self._missing_is_told(key):
            return (self._root / key).open("rb")

    def delete(self, keys: Iterable[str]) -> None:
        """Remove objects; what is not there is no error."""
        wanted = list(keys)
        if self._root is not None:
            for key in wanted:
                (self._root / key).unlink(missing_ok=True)
            return
        for i in range(0, len(wanted), _DELETE_BATCH):
            with contextlib.suppress(FileNotFoundError):
                obstore.delete(self._store, wanted[i : i + _DELETE_BATCH])

    def objects(self) -> Iterator[StoredObject]:
        """List the objects under the blobs' prefix, in no order; in a shared bucket not all of them are ours."""
        if self._root is not None:
            for path in (self._root / _PREFIX).rglob("*"):
                with contextlib.suppress(FileNotFoundError):
                    status = path.stat()
                    if path.is_file():  # its mtime is that of the file that was put here, its ctime is when it came
                        yield StoredObject(path.relative_to(self._root).as_posix(), status.st_ctime_ns // 1000)
            return
        for batch in obstore.list(self._store, prefix=_PREFIX):
            for item in batch:
                yield StoredObject(item["path"], int(item["last_modified"].timestamp() * 1e6))

    def require_writable(self) -> None:
        """Write and remove a small object, within seconds.

        Raises
        ------
        Exception
            Whatever the store raised; in a folder OSError.
        """
        key = f"probe/{secrets.token_hex(8)}"
        if self._root is not None:
            path = self._root / key
            self.require_folder()
            self._make_parents(path)
            try:
                path.write_bytes(b"probe")
            finally:
                path.unlink(missing_ok=True)
        else:
            obstore.put(self._probed, key, b"probe")
            obstore.delete(self._probed, key)


def _require_done(puts: Iterable[Future[None]]) -> None:
    """Raise what one of the puts that have ended has raised."""
    for put in puts:
        put.result()


def _open(url: str, settings: Settings, timeouts: Mapping[str, Any], retries: Mapping[str, Any]) -> Any:
    client = dict(timeouts)
    options: dict[str, Any] = {"client_options": client, "retry_config": dict(retries)}
    if url.startswith("s3"):
        options["region"] = settings.s3_region
        if settings.s3_endpoint:
            options["endpoint"] = settings.s3_endpoint
            client["allow_http"] = settings.s3_endpoint.startswith("http://")
    return from_url(url, **options)


@contextlib.contextmanager
def _whole_or_gone(target: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        target.unlink(missing_ok=True)
        raise


def _link_or_copy(path: Path, target: Path) -> None:
    try:
        os.link(path, target)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP):
            raise
        with _whole_or_gone(target):
            shutil.copy2(path, target)


def _move_or_copy(path: Path, target: Path) -> bool:
    """Move a file, or copy it where `target` is on another disk; whether it is a copy."""
    try:
        os.replace(path, target)
        return False
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
    partial = target.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        shutil.copy2(path, partial)
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return True


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
