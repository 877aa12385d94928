"""Finished stages on disk, so that a second run does not do them again.

A stage's file is an archive of arrays as numpy writes it, uncompressed. Large arrays can be written in parts while the
stage goes on, and read in parts after: neither has to stand in memory.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import secrets
import weakref
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import storage_error
from mrasfm_engine.io.plain_json import plain
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import checkpoint_file

Arrays = dict[str, NDArray[Any]]


def fingerprint(*parts: object) -> str:
    """SHA-256 over anything that JSON can write: what a stage's result depends on."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def content_sha256_of(drive: Drive, *, threads: int) -> dict[str, str]:
    """Read all images and masks of a drive: their SHA-256 by their names in the manifest."""
    return sha256_of_files(drive.root, _files(drive), threads=threads)


def sha256_of_files(folder: Path, names: Sequence[str], *, threads: int) -> dict[str, str]:
    """Read files of a folder: their SHA-256 by their names."""
    with ThreadPoolExecutor(threads) as pool:
        return dict(zip(names, pool.map(lambda name: _content_sha256(folder / name), names), strict=True))


def fingerprints_of_images(scene: Scene, content_sha256: Mapping[str, str]) -> dict[str, str]:
    """Hash the names and contents of the registered images of each camera, by its name.

    Parameters
    ----------
    content_sha256
        SHA-256 of the files of all registered images by their names in the manifest.
    """
    files: dict[str, list[str]] = {}
    for i in np.flatnonzero(scene.image_registered):
        image = scene.drive.images[i]
        files.setdefault(scene.drive.cameras[image.camera].name, []).append(image.file)
    return {camera: fingerprint([(file, content_sha256[file]) for file in of]) for camera, of in files.items()}


def drive_fingerprint(drive: Drive, content_sha256: Mapping[str, str]) -> str:
    """Hash the manifest and the contents of all images and masks, given by their SHA-256 by name."""
    contents = [(name, content_sha256[name]) for name in _files(drive)]
    return fingerprint(drive.manifest.model_dump(mode="json"), contents)


def _files(drive: Drive) -> list[str]:
    return [name for image in drive.images for name in (image.file, image.mask) if name is not None]


def _content_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class StageWriter:
    """The file of a stage that is being done. It counts for nothing until `finish`."""

    def __init__(self, folder: Path, name: str, key: str) -> None:
        self._path = folder / checkpoint_file(name)
        self._partial = folder / f".{name}.{secrets.token_hex(4)}.partial"
        self._key = key
        self._names: list[str] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _remove_orphans(folder, name)
            self._file = self._partial.open("wb")
            with suppress(OSError):  # some network file systems have no locks: there an orphan stays
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise storage_error(self._path, error) from error
        self._archive = zipfile.ZipFile(self._file, "w")

    def add(self, name: str, array: NDArray[Any]) -> None:
        """Write one array.

        Raises
        ------
        StorageError
            Where the disk is full or cannot be written.
        """
        self._write(name, array)
        self._names.append(name)

    def finish(self, report: Mapping[str, Any]) -> None:
        """Put the stage in the place of an earlier one, in one step; raises as `add` does."""
        header = {"key": self._key, "report": report, "arrays": self._names}
        self._write("header", np.array(json.dumps(header, default=plain)))
        try:
            self._archive.close()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._partial.replace(self._path)
        except OSError as error:
            raise storage_error(self._path, error) from error

    def discard(self) -> None:
        """Remove what has not been finished."""
        with suppress(OSError, ValueError):  # a full disk takes no directory either
            self._archive.close()
        with suppress(OSError):
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def _write(self, name: str, array: NDArray[Any]) -> None:
        try:
            with self._archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
        except OSError as error:
            raise storage_error(self._path, error) from error


def _remove_orphans(folder: Path, name: str) -> None:
    """Remove what killed runs left half-written of a stage: no process has a lock on it any more."""
    for path in folder.glob(f".{name}.*.partial"):
        with suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)


@dataclass(frozen=True, kw_only=True)
class _Member:
    """An array inside a stage's file."""

    offset: int  # of its first number in the file
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


class StoredStage:
    """A finished stage in its file, of whose arrays parts are read.

    The file stays open, and what is read is that file even where another has taken its place. All bytes were compared
    with their checksums when it was opened.
    """

    def __init__(self, path: Path, file: BinaryIO, members: Mapping[str, _Member], report: dict[str, Any]) -> None:
        self.report = report
        self._path = path
        self._members = members
        self._descriptor = os.dup(file.fileno())
        weakref.finalize(self, os.close, self._descriptor)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def read(self, name: str) -> NDArray[Any]:
        """A whole array, as `rows` reads it."""
        shape = self._members[name].shape
        return self.rows(name, 0, None) if shape else self._read_at(name, shape, 0)

    def rows(self, name: str, first: int, stop: int | None) -> NDArray[Any]:
        """Rows of an array, read anew at every call and from any thread.

        Raises
        ------
        StorageError
            Where they cannot be read.
        """
        shape = self._members[name].shape
        return self._read_at(name, ((shape[0] if stop is None else stop) - first, *shape[1:]), first)

    def _read_at(self, name: str, shape: tuple[int, ...], first: int) -> NDArray[Any]:
        member = self._members[name]
        result = np.empty(shape, member.dtype)
        row_bytes = member.dtype.itemsize * int(np.prod(shape[1:], dtype=np.int64))
        into, at = result.reshape(-1).view(np.uint8).data, member.offset + first * row_bytes
        try:
            while len(into):
                count = os.preadv(self._descriptor, [into], at)
                if not count:
                    raise OSError(errno.EIO, "the file has become shorter")
                into, at = into[count:], at + count
        except OSError as error:
            raise storage_error(self._path, error) from error
        return result


class StageStore:
    """Arrays and a small report of every finished stage, in one folder.

    A result is found again only under the same name and fingerprint; writing replaces it in one step.

    Parameters
    ----------
    prefix
        Begins the names of all files, and tells those of several stores in one folder apart.
    """

    def __init__(self, folder: Path, prefix: str = "") -> None:
        self._folder = folder
        self._prefix = prefix

    def with_prefix(self, prefix: str) -> StageStore:
        """The store of other stages in the same folder."""
        return StageStore(self._folder, prefix)

    def remove(self, pattern: str) -> None:
        """Remove finished stages by a pattern of their names, as the shell's."""
        for path in self._folder.glob(checkpoint_file(self._prefix + pattern)):
            with suppress(OSError):  # what stays is found under no fingerprint any more
                path.unlink()

    def forget(self, names: Iterable[str]) -> None:
        """Remove finished stages of a run that came to nothing, and the folders that hold nothing else."""
        for name in names:
            self.remove(name)
        with suppress(OSError):  # something else is in them
            self._folder.rmdir()
            self._folder.parent.rmdir()

    def has(self, name: str, key: str) -> bool:
        """Return whether a stage has been finished with this fingerprint, without reading its arrays."""
        return self._read(name, key, arrays=False) is not None

    def load(self, name: str, key: str) -> tuple[Arrays, dict[str, Any]] | None:
        """Arrays and report of a stage, or None where it has not been finished with this fingerprint."""
        return self._read(name, key, arrays=True)

    def open(self, name: str, key: str) -> StoredStage | None:
        """The file of a stage, to read parts of its arrays, or None where `load` finds none."""
        path = self._folder / checkpoint_file(self._prefix + name)
        try:
            with path.open("rb") as file, zipfile.ZipFile(file) as archive:
                header = _header(archive)
                if header["key"] != key or archive.testzip() is not None:
                    return None
                members = {name: _member(archive, file, f"{name}.npy") for name in header["arrays"]}
                return StoredStage(path, file, members, header["report"])
        except MemoryError:
            raise
        except Exception:
            # On a damaged file zipfile and numpy raise a dozen kinds.
            return None

    def _read(self, name: str, key: str, *, arrays: bool) -> tuple[Arrays, dict[str, Any]] | None:
        path = self._folder / checkpoint_file(self._prefix + name)
        try:
            with path.open("rb") as file, zipfile.ZipFile(file) as archive:
                header = _header(archive)
                if header["key"] != key:
                    return None
                # By name: a damaged directory can hide arrays.
                wanted = header["arrays"] if arrays else ()
                return {name: _array(archive, name) for name in wanted}, header["report"]
        except MemoryError:
            raise
        except Exception:
            # On a damaged file zipfile and numpy raise a dozen kinds.
            return None

    @contextmanager
    def writing(self, name: str, key: str) -> Iterator[StageWriter]:
        """A stage that is written in parts, and kept where it is finished before the block ends."""
        writer = StageWriter(self._folder, self._prefix + name, key)
        try:
            yield writer
        finally:
            writer.discard()

    def save(self, name: str, key: str, arrays: Mapping[str, NDArray[Any]], report: Mapping[str, Any]) -> None:
        """Keep a finished stage.

        Raises
        ------
        StorageError
            Where the disk is full or cannot be written.
        """
        with self.writing(name, key) as writer:
            for array_name, array in arrays.items():
                writer.add(array_name, array)
            writer.finish(report)


def _header(archive: zipfile.ZipFile) -> dict[str, Any]:
    header: dict[str, Any] = json.loads(str(_array(archive, "header")))
    return header


def _array(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """Read a whole array, up to the last byte of its file: there its checksum is compared.

    Raises
    ------
    Exception
        Of a dozen kinds, where the file is damaged.
    """
    with archive.open(f"{name}.npy") as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        if member.read(1):  # a damaged shape asks for less
            raise ValueError(name)
        return array


def _member(archive: zipfile.ZipFile, file: BinaryIO, name: str) -> _Member:
    """Find an uncompressed array in the file. The lengths of name and extra field stand at bytes 26 and 28 of what the
    archive keeps in front of a member, 30 bytes and these two (section 4.3.7 of the format's description).
    """
    info = archive.getinfo(name)
    with archive.open(info) as member:
        if np.lib.format.read_magic(member) != (1, 0) or info.compress_type != zipfile.ZIP_STORED:
            raise ValueError(name)
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(member)
        within = member.tell()
    if is_fortran or dtype.hasobject:
        raise ValueError(name)
    lengths = os.pread(file.fileno(), 4, info.header_offset + 26)
    before = 30 + int.from_bytes(lengths[:2], "little") + int.from_bytes(lengths[2:], "little")
    return _Member(offset=info.header_offset + before + within, shape=shape, dtype=dtype)
