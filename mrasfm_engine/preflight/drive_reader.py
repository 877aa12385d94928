"""The drive bundle: a folder with `drive.json` and the files it names."""

from __future__ import annotations

import os
import uuid
from pathlib import Path

from mrasfm_engine.errors import InputError, storage_error
from mrasfm_engine.io.axes import manifest_in_flu
from mrasfm_engine.io.documents import read_parsed
from mrasfm_engine.io.images import read_image_gray, read_image_rgb, read_mask
from mrasfm_engine.preflight.drive_check import check_drive, require_sound
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import BringFile
from schemas import DriveManifest, parse_manifest, parse_new_manifest
from schemas.file_names import MANIFEST_NAME, is_beside_manifest, is_ignored
from schemas.findings import Finding, Severity

__all__ = [
    "MANIFEST_NAME",
    "Finding",
    "Severity",
    "check_drive",
    "foreign_file",
    "read_drive",
    "read_image_gray",
    "read_image_rgb",
    "read_mask",
    "require_sound",
    "write_manifest",
]


def read_drive(folder: Path, *, is_new: bool = False, bring: BringFile | None = None) -> Drive:
    """Load a drive and convert it to the engine's axes (x forward, y left, z up).

    Only the manifest is read; `check_drive` looks at the files.

    Parameters
    ----------
    is_new
        Whether rules hold that came after drives had been accepted: for folders of users, and not for stored drives.
    bring
        For a folder that has the manifest alone: puts there whatever else is read, see `Drive.path_of`.

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
    manifest = read_manifest(folder / MANIFEST_NAME, is_new=is_new)
    return Drive(root=folder.resolve(), manifest=manifest_in_flu(manifest), bring=bring)


def foreign_file(folder: Path) -> Path | None:
    """The first file or folder in a drive's folder that no import, rendering or upload makes; None if there is none."""
    made = (MANIFEST_NAME, "images", "masks")
    others = (path for path in folder.iterdir() if not is_beside_manifest(path.name) and not is_ignored(path.name))
    return min((path for path in others if path.name not in made), default=None)


def read_manifest(path: Path, *, is_new: bool) -> DriveManifest:
    """The manifest in a file, in its own axes; see `read_drive`.

    Raises
    ------
    InputError
        If it is missing or does not follow its contract.
    """
    parse = parse_new_manifest if is_new else parse_manifest
    return read_parsed(path, parse, what="drive manifest", help_page="`mrasfm describe manifest`")


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
