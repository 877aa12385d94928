"""A committed drive's files, brought to where a stage works."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import Row, select
from sqlalchemy.orm import Session

from schemas.file_names import MANIFEST_NAME
from service.database.connections import Transactions
from service.database.tables import Blob, Drive, DriveFile
from service.storage.artifacts import Fetch
from service.storage.on_demand import OnDemandFolder, RemoteFile
from service.storage.transfers import fetch_each


class DriveGoneError(Exception):
    """The drive was deleted."""


@dataclass(frozen=True, kw_only=True)
class DriveCheckout:
    """A drive's folder with its manifest, and the files that belong into it.

    Attributes
    ----------
    folder
        Holds `drive.json`.
    files
        Images under the names that the manifest gives them, in its order, and then masks.
    content_sha256
        SHA-256 of all the drive's files by name, also of those that are not needed.
    """

    folder: Path
    files: dict[str, RemoteFile]
    content_sha256: dict[str, str]

    @property
    def size_bytes(self) -> int:
        """Size of all the files."""
        return sum(file.size_bytes for file in self.files.values())

    def bring_all(self, fetch: Fetch, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Lay the drive out as a folder that the engine reads; `progress(done, total)` is called with each file.

        Raises
        ------
        Exception
            What `fetch` raises.
        """
        fetch_each(fetch, [(file.key, self.folder / name) for name, file in self.files.items()], progress=progress)

    def on_demand(self, fetch: Fetch, *, room_bytes: int) -> OnDemandFolder:
        """The files as they are asked for: a part of them at one time."""
        return OnDemandFolder(self.folder, self.files, fetch=fetch, room_bytes=room_bytes)


def check_out(
    records: Transactions, drive_id: str, folder: Path, *, fetch: Fetch, units: range | None = None
) -> DriveCheckout:
    """Begin a folder for a drive: its manifest comes, and it is known which files belong there.

    Parameters
    ----------
    fetch
        Brings one file, in any thread.
    units
        Indices of the frames whose files are needed; by default all are.

    Raises
    ------
    DriveGoneError
        Where the drive is not there any more.
    """
    manifest_key, rows = records.query(partial(_stored, drive_id=drive_id))
    folder.mkdir(parents=True, mode=0o700)
    fetch(manifest_key, folder / MANIFEST_NAME)
    # Paths were checked when the manifest came: relative, without '..'.
    files = {path: RemoteFile(key, size_bytes) for path, key, size_bytes, _ in rows}
    wanted = _files_of_units(folder / MANIFEST_NAME, units)
    return DriveCheckout(
        folder=folder,
        files={name: files[name] for name in wanted if name in files},
        content_sha256={path: sha256 for path, _, _, sha256 in rows},
    )


def _stored(session: Session, drive_id: str) -> tuple[str, Sequence[Row[str, str, int, str]]]:
    """Key of a drive's manifest, and path, key, size and SHA-256 of its files."""
    manifest = select(Blob.key).join(Drive, Drive.manifest_blob_id == Blob.id).where(Drive.id == drive_id)
    manifest_key = session.scalar(manifest)
    if manifest_key is None:
        raise DriveGoneError(drive_id)
    stored = select(DriveFile.path, Blob.key, Blob.size_bytes, Blob.sha256).join(Blob, DriveFile.blob_id == Blob.id)
    return manifest_key, session.execute(stored.where(DriveFile.drive_id == drive_id)).all()


def _files_of_units(manifest: Path, units: range | None) -> dict[str, None]:
    """Images of some frames, or all, in their order, and then their masks, each once.

    The manifest was checked when it came.
    """
    frames = json.loads(manifest.read_bytes())["frames"]
    frames = frames if units is None else frames[units.start : units.stop]
    images = [image for frame in frames for image in frame["images"].values()]
    names = [*(image["file"] for image in images), *(image.get("mask") for image in images)]
    return dict.fromkeys(name for name in names if name is not None)
