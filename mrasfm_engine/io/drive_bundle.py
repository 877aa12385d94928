"""The drive bundle: a folder with `drive.json` and the files it names."""

from __future__ import annotations

import errno
import os
import uuid
from pathlib import Path

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.io.axes import manifest_in_flu
from mrasfm_engine.io.documents import read_document
from mrasfm_engine.io.findings import Finding, Severity
from mrasfm_engine.io.images import read_image_gray, read_image_rgb, read_mask
from mrasfm_engine.io.preflight import check_drive, require_sound
from mrasfm_engine.scene.drive import Drive
from schemas import DriveManifest

MANIFEST_NAME = "drive.json"

__all__ = [
    "MANIFEST_NAME",
    "Finding",
    "Severity",
    "check_drive",
    "read_drive",
    "read_image_gray",
    "read_image_rgb",
    "read_mask",
    "require_sound",
    "write_manifest",
]


def read_drive(folder: Path) -> Drive:
    """Load a drive and convert it to the engine's axes (x forward, y left, z up).

    Only the manifest is read; `check_drive` looks at the files.

    Raises
    ------
    InputError
        If the folder or its manifest is missing, or the manifest does not follow its contract.
    """
    folder = Path(folder)
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"drive {folder} {state}", remedy=f"Give the folder that holds {MANIFEST_NAME}.")
    if not (folder / MANIFEST_NAME).exists():
        raise InputError(
            f"drive {folder} has no {MANIFEST_NAME}",
            remedy="Give the folder of a drive, or make one of a recording with 'mrasfm import'.",
            code="no-manifest",
        )
    manifest = read_document(
        folder / MANIFEST_NAME, DriveManifest, what="drive manifest", help_page="schemas/README.md"
    )
    return Drive(root=folder.resolve(), manifest=manifest_in_flu(manifest))


def write_manifest(manifest: DriveManifest, folder: Path) -> Path:
    """Write `drive.json` into an existing folder, whole or not at all.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    StorageError
        If the folder cannot be written or the disk is full.
    """
    target = Path(folder) / MANIFEST_NAME
    partial = target.with_name(f".{MANIFEST_NAME}.{uuid.uuid4().hex[:8]}.partial")
    text = manifest.model_dump_json(indent=1, exclude_none=True) + "\n"
    try:
        try:
            with partial.open("x", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise storage_error(target, error) from error
    return target


def storage_error(path: Path, error: OSError) -> StorageError:
    """The error to raise when writing `path` failed."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(f"no space left to write {path}", remedy="Free disk space, then run it again.")
    return StorageError(
        f"cannot write {path}: {error.strerror or error}", remedy="Check that the folder exists and may be written."
    )
