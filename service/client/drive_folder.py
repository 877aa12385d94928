"""A drive in a folder: its manifest, and the files that this names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.drive import DriveManifest
from schemas.file_names import MANIFEST_NAME
from schemas.parsing import DocumentError, parse_new_manifest
from service.client.errors import DriveFolderError

PIECE_BYTES = 1 << 20
_SHOWN = 10


@dataclass(frozen=True)
class LocalFile:
    """A file of a drive: `path` is its name in the manifest, `source` where it lies here."""

    path: str
    source: Path
    size_bytes: int
    sha256: str

    def pieces(self, offset: int = 0) -> Iterator[bytes]:
        """The file's bytes from `offset` on.

        Raises
        ------
        DriveFolderError
            Where there are more or fewer than there were: half a request cannot be taken back otherwise.
        """
        left = self.size_bytes - offset
        for piece in _pieces(self.source, offset):
            left -= len(piece)
            if left < 0:
                raise self.changed()
            yield piece
        if left:
            raise self.changed()

    def changed(self) -> DriveFolderError:
        """The error that says so."""
        return DriveFolderError(
            f"{self.source} changed while it was being sent. Wait until nothing writes it, then give the same command "
            "again."
        )


@dataclass(frozen=True)
class DriveFolder:
    """A folder with a sound manifest, and every file that this names."""

    root: Path
    raw_manifest: bytes
    manifest: DriveManifest
    paths: tuple[str, ...]

    @staticmethod
    def read(root: Path) -> DriveFolder:
        """The drive in a folder.

        Raises
        ------
        DriveFolderError
            Where there is no manifest, it breaks its contract, or files that it names are not there.
        """
        raw = _read_manifest(root)
        try:
            manifest = parse_new_manifest(raw)
        except DocumentError as error:
            raise DriveFolderError(
                f"{root / MANIFEST_NAME}: {error}. Correct it; `mrasfm describe manifest` describes every field."
            ) from None
        images = [image for frame in manifest.frames for image in frame.images.values()]
        paths = tuple(sorted({name for image in images for name in (image.file, image.mask) if name is not None}))
        _require_files(root, paths)
        return DriveFolder(root, raw, manifest, paths)

    @property
    def manifest_sha256(self) -> str:
        """SHA-256 of the manifest's bytes."""
        return hashlib.sha256(self.raw_manifest).hexdigest()

    def size_bytes(self) -> int:
        """Size of all files but the manifest."""
        return sum((self.root / path).stat().st_size for path in self.paths)


def identify(root: Path, path: str) -> LocalFile:
    """A file of a drive with its size and SHA-256.

    Raises
    ------
    DriveFolderError
        Where it cannot be read.
    """
    source, digest, size_bytes = root / path, hashlib.sha256(), 0
    for piece in _pieces(source):
        digest.update(piece)
        size_bytes += len(piece)
    return LocalFile(path, source, size_bytes, digest.hexdigest())


def _pieces(source: Path, offset: int = 0) -> Iterator[bytes]:
    try:
        with source.open("rb", buffering=0) as file:
            file.seek(offset)
            while piece := file.read(PIECE_BYTES):
                yield piece
    except OSError as error:
        raise DriveFolderError(f"{source} cannot be read: {error.strerror}. Correct that, then try again.") from error


def _read_manifest(root: Path) -> bytes:
    try:
        return (root / MANIFEST_NAME).read_bytes()
    except OSError as error:
        raise DriveFolderError(
            f"{root / MANIFEST_NAME} cannot be read: {error.strerror}. Give the folder of a drive; 'mrasfm import' "
            "makes one of a recording."
        ) from error


def _require_files(root: Path, paths: tuple[str, ...]) -> None:
    missing = [path for path in paths if not (root / path).is_file() or not os.access(root / path, os.R_OK)]
    if missing:
        shown = "".join(f"\n  {path}" for path in missing[:_SHOWN])
        more = f"\n  and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise DriveFolderError(
            f"{root}: {len(missing)} of {len(paths)} files that {MANIFEST_NAME} names are not there or cannot be "
            f"read:{shown}{more}\nNothing was sent. Bring them, or take them out of {MANIFEST_NAME}."
        )
