"""A committed drive's files, and checkpoints of its finished stages, brought to where a stage works."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.persistence import blobs
from service.persistence.artifacts import ArtifactStore
from service.persistence.database import Database
from service.persistence.storing import StoredFile
from service.persistence.tables import Blob, Checkpoint, Drive, DriveFile, now_us

MANIFEST_NAME = "drive.json"


class DriveGoneError(Exception):
    """The drive was deleted."""


def materialise(
    database: Database,
    artifacts: ArtifactStore,
    drive_id: str,
    folder: Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Lay a drive out as a folder that the engine reads: `drive.json` and the files under the names it gives them.

    Parameters
    ----------
    progress
        Called as progress(done, total) with each file.

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
    artifacts.fetch(manifest.key, folder / MANIFEST_NAME, manifest.sha256)
    for i, (path, key, sha256) in enumerate(files):
        target = folder / path  # checked when the manifest came: relative, without '..'
        target.parent.mkdir(parents=True, exist_ok=True)
        artifacts.fetch(key, target, sha256)
        progress(i + 1, len(files))


def restore_checkpoints(
    database: Database, artifacts: ArtifactStore, drive_id: str, settings_sha256: str, folder: Path
) -> list[str]:
    """Bring finished stages of a drive under some settings into a folder.

    Returns
    -------
    list of str
        Names of the files brought.
    """
    mine = (Checkpoint.drive_id == drive_id) & (Checkpoint.settings_sha256 == settings_sha256)
    with database.read() as session:
        found = session.execute(
            select(Checkpoint.name, Blob.key, Blob.sha256).join(Blob, Checkpoint.blob_id == Blob.id).where(mine)
        ).all()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name, key, sha256 in found:
        artifacts.fetch(key, folder / name, sha256)
    return [name for name, _, _ in found]


def keep_checkpoints(
    session: Session, *, drive_id: str, settings_sha256: str, stored: Mapping[str, StoredFile]
) -> None:
    """Note checkpoints, by name, that were put into the artifact store; older ones of the same names are replaced."""
    drive = session.get(Drive, drive_id)
    if drive is None:
        return
    for name, file in stored.items():
        blob = blobs.record(session, project_id=drive.project_id, within_quota=False, **file.identity)
        checkpoint = session.get(Checkpoint, (drive_id, settings_sha256, name))
        if checkpoint is None:
            session.add(Checkpoint(drive_id=drive_id, settings_sha256=settings_sha256, name=name, blob_id=blob.id))
        else:
            checkpoint.blob_id = blob.id
            checkpoint.created_us = now_us()
