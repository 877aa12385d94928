"""A committed drive's files, brought to where a stage works."""

from __future__ import annotations

import json
from collections.abc import Callable, Container
from pathlib import Path

from sqlalchemy import select

from schemas.file_names import MANIFEST_NAME
from service.database.connections import Database
from service.database.tables import Blob, Drive, DriveFile
from service.storage.artifacts import Fetch
from service.storage.transfers import fetch_each


class DriveGoneError(Exception):
    """The drive was deleted."""


def materialise(
    database: Database,
    drive_id: str,
    folder: Path,
    *,
    fetch: Fetch,
    progress: Callable[[int, int], None] = lambda done, total: None,
    units: range | None = None,
) -> dict[str, str]:
    """Lay a drive out as a folder that the engine reads: `drive.json` and the files under the names it gives them.

    Parameters
    ----------
    fetch
        Brings one file, in any thread.
    progress
        Called as progress(done, total) with each file.
    units
        Indices of the frames whose files are brought; by default all are.

    Returns
    -------
    dict
        SHA-256 of all the drive's files by their names in the manifest.

    Raises
    ------
    DriveGoneError
        Where the drive is not there any more.
    """
    with database.read() as session:
        manifest = session.scalar(
            select(Blob).join(Drive, Drive.manifest_blob_id == Blob.id).where(Drive.id == drive_id)
        )
        if manifest is None:
            raise DriveGoneError(drive_id)
        stored = select(DriveFile.path, Blob.key, Blob.sha256).join(Blob, DriveFile.blob_id == Blob.id)
        files = session.execute(stored.where(DriveFile.drive_id == drive_id)).all()
    folder.mkdir(parents=True, mode=0o700)
    fetch(manifest.key, folder / MANIFEST_NAME)
    wanted = None if units is None else _files_of_units(folder / MANIFEST_NAME, units)
    brought = [(path, key) for path, key, _ in files if wanted is None or path in wanted]
    # Paths were checked when the manifest came: relative, without '..'.
    fetch_each(fetch, [(key, folder / path) for path, key in brought], progress=progress)
    return {path: sha256 for path, _, sha256 in files}


def _files_of_units(manifest: Path, units: range) -> Container[str]:
    """Images and masks of some frames. The manifest was checked when it came."""
    frames = json.loads(manifest.read_bytes())["frames"][units.start : units.stop]
    images = [image for frame in frames for image in frame["images"].values()]
    return {name for image in images for name in (image["file"], image.get("mask")) if name is not None}
