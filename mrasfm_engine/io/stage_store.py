"""Finished stages on disk, so that a second run does not do them again."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mrasfm_engine
import schemas
from mrasfm_engine.errors import storage_error
from mrasfm_engine.scene.drive import Drive

NOT_IN_STAGES = ("ablation.py", "benchmark", "commands", "evaluation", "synthetic", "visualization")

Arrays = dict[str, NDArray[Any]]


def fingerprint(*parts: object) -> str:
    """SHA-256 over anything that JSON can write: what a stage's result depends on."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def drive_fingerprint(drive: Drive) -> str:
    """Of the manifest and of size and modification time of every image and mask."""
    files = []
    for image in drive.images:
        for name in (image.file, image.mask):
            if name is not None:
                status = (drive.root / name).stat()
                files.append((name, status.st_size, status.st_mtime_ns))
    return fingerprint(drive.manifest.model_dump(mode="json"), files)


@cache
def code_version() -> str:
    """Of the code that stages run: a stage that was finished by other code is done again."""
    digest = hashlib.sha256(mrasfm_engine.__version__.encode())
    for package in (Path(mrasfm_engine.__file__).parent, Path(schemas.__file__).parent):
        for path in sorted(package.rglob("*.py")):
            name = path.relative_to(package)
            if name.parts[0] not in NOT_IN_STAGES:
                digest.update(str(name).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class StageStore:
    """Arrays and a small report of every finished stage, in one folder.

    A result is found again only under the same name and fingerprint; writing replaces it in one step.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, name: str, key: str) -> bool:
        """Whether a stage has been finished with this fingerprint, without reading its arrays."""
        return self._read(name, key, arrays=False) is not None

    def load(self, name: str, key: str) -> tuple[Arrays, dict[str, Any]] | None:
        """Arrays and report of a stage, or None where it has not been finished with this fingerprint."""
        return self._read(name, key, arrays=True)

    def _read(self, name: str, key: str, *, arrays: bool) -> tuple[Arrays, dict[str, Any]] | None:
        path = self._folder / f"{name}.npz"
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
        path = self._folder / f"{name}.npz"
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
