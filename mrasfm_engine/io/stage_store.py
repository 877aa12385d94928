"""Finished stages on disk, so that a second run does not do them again."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import storage_error
from mrasfm_engine.scene.drive import Drive
from schemas.artifacts import checkpoint_file

Arrays = dict[str, NDArray[Any]]


def fingerprint(*parts: object) -> str:
    """SHA-256 over anything that JSON can write: what a stage's result depends on."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def drive_fingerprint(drive: Drive, content_sha256: Mapping[str, str] | None, *, threads: int) -> str:
    """Hash the manifest and the contents of all images and masks.

    Parameters
    ----------
    content_sha256
        SHA-256 of the files by their names in the manifest, where the caller knows them; else the files are read.
    """
    names = [name for image in drive.images for name in (image.file, image.mask) if name is not None]
    if content_sha256 is None:
        with ThreadPoolExecutor(threads) as pool:
            digests = list(pool.map(lambda name: _content_sha256(drive.root / name), names))
    else:
        digests = [content_sha256[name] for name in names]
    return fingerprint(drive.manifest.model_dump(mode="json"), list(zip(names, digests, strict=True)))


def _content_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class StageStore:
    """Arrays and a small report of every finished stage, in one folder.

    A result is found again only under the same name and fingerprint; writing replaces it in one step.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, name: str, key: str) -> bool:
        """Return whether a stage has been finished with this fingerprint, without reading its arrays."""
        return self._read(name, key, arrays=False) is not None

    def load(self, name: str, key: str) -> tuple[Arrays, dict[str, Any]] | None:
        """Arrays and report of a stage, or None where it has not been finished with this fingerprint."""
        return self._read(name, key, arrays=True)

    def _read(self, name: str, key: str, *, arrays: bool) -> tuple[Arrays, dict[str, Any]] | None:
        path = self._folder / checkpoint_file(name)
        try:
            # Opened here: np.load leaves a file open that turns out not to be an archive.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                header = json.loads(str(archive["header"]))
                if header["key"] != key:
                    return None
                # By name: a damaged directory can hide arrays.
                wanted = header["arrays"] if arrays else ()
                return {name: archive[name] for name in wanted}, header["report"]
        except MemoryError:
            raise
        except Exception:
            # On a damaged file zipfile and numpy raise a dozen kinds.
            return None

    def save(self, name: str, key: str, arrays: Mapping[str, NDArray[Any]], report: Mapping[str, Any]) -> None:
        """Keep a finished stage.

        Raises
        ------
        StorageError
            Where the disk is full or cannot be written.
        """
        path = self._folder / checkpoint_file(name)
        partial = self._folder / f".{name}.{secrets.token_hex(4)}.partial"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                with partial.open("wb") as file:
                    header = json.dumps({"key": key, "report": report, "arrays": list(arrays)})
                    named: dict[str, Any] = {"header": np.array(header), **arrays}
                    np.savez(file, **named)
                    file.flush()
                    os.fsync(file.fileno())
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            raise storage_error(path, error) from error
