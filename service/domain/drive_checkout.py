"""A committed drive's files, brought to where a stage works."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sqlalchemy import select

from schemas.file_names import MANIFEST_NAME
from service.database.connections import Database
from service.database.tables import Blob, Drive, DriveFile
from service.storage.artifacts import Fetch


class DriveGoneError(Exception):
    """The drive was deleted."""


def materialise(
    database: Database,
    drive_id: str,
    folder: Path,
    *,
    fetch: Fetch,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, str]:
    """Lay a drive out as a folder that the engine reads: `drive.json` and the files under the names it gives them.

    Parameters
    ----------
    fetch
        Brings one file.
    progress
        Called as progress(done, total) with each file.

    Returns
    -------
    dict
        SHA-256 of the files by their names in the manifest.

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
    for i, (path, key, _) in enumerate(files):
        target = folder / path  # checked when the manifest came: relative, without '..'
        target.parent.mkdir(parents=True, exist_ok=True)
        fetch(key, target)
        progress(i + 1, len(files))
    return {path: sha256 for path, _, sha256 in files}
