"""Finished stages, so that another attempt or another job does not repeat them."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from schemas.artifacts import SCALES_CHECKPOINT, checkpoint_file, scenes_of_seam, seam_checkpoint, submap_number
from service.database.connections import Transactions
from service.database.tables import Blob, Checkpoint, Drive, Map, MapCheckpoint, now_us
from service.domain import jobs
from service.storage import blobs
from service.storage.artifacts import Fetch
from service.storage.blob_writer import StoredFile
from service.storage.transfers import fetch_each

Found = TypeVar("Found")

log = logging.getLogger("mrasfm.worker")


def settings_sha256(settings: Mapping[str, Any]) -> str:
    """Tells apart the settings under which stages were finished, and scenes made."""
    return hashlib.sha256(json.dumps(dict(settings), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class _Kept:
    """Location of a finished stage's bytes."""

    id: str
    key: str


@dataclass(frozen=True)
class DriveShelf:
    """Stages of one drive under certain settings."""

    drive_id: str
    settings_sha256: str


@dataclass(frozen=True)
class MapShelf:
    """Stages of an aggregation: of all its scenes, and of each pair, wherever in the project these were put together.

    Attributes
    ----------
    scenes
        Ids of the map's scenes, by name.
    """

    map_id: str
    project_id: str
    scenes: Mapping[str, str]
    settings_sha256: str

    def digest(self, file: str) -> str | None:
        """The digest of all that a stage is made of, by its file's name; None where the map has no such stage."""
        if file == checkpoint_file(SCALES_CHECKPOINT):
            return self._sha256(json.dumps(dict(self.scenes), sort_keys=True))
        first, second = (self.scenes.get(name) for name in scenes_of_seam(file) or ("", ""))
        return None if first is None or second is None or first == second else self._of_pair(first, second)

    def find(self, known: Mapping[str, Found]) -> dict[str, Found]:
        """Stages of the map that are known by their digest, by the names of their files."""
        if not known:
            return {}
        together = checkpoint_file(SCALES_CHECKPOINT)
        found = {together: known.get(self.digest(together) or "")}
        # One after the other: a thousand scenes have a million pairs, of which three thousand are seams.
        for (a, first), (b, second) in permutations(self.scenes.items(), 2):
            if (kept := known.get(self._of_pair(first, second))) is not None:
                found[checkpoint_file(seam_checkpoint(a, b))] = kept
        return {name: kept for name, kept in found.items() if kept is not None}

    def _of_pair(self, first: str, second: str) -> str:
        return self._sha256(f"{first} {second}")

    def _sha256(self, inputs: str) -> str:
        return hashlib.sha256(f"{inputs} {self.settings_sha256}".encode()).hexdigest()


Shelf = DriveShelf | MapShelf
_SEAM = "seam"
_SHELVES_A_DRIVE = 3
_KEPT = (Blob.id, Blob.key)


def restore(
    records: Transactions,
    shelf: Shelf,
    folder: Path,
    *,
    fetch: Fetch,
    is_wanted: Callable[[str], bool] = lambda name: True,
) -> list[str]:
    """Bring finished stages into a folder; the names of the files brought.

    They save time and nothing else: one whose bytes are lost is forgotten, and the stage is done again. Only the store
    tells that they are: an attempt that was stopped removes its folder while this may be under way still.
    """
    shelved = records.query(lambda session: _shelved(session, shelf))
    found = {name: kept for name, kept in shelved.items() if is_wanted(name)}
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    names, lost = list(found), list[str]()

    def forget(place: int) -> None:
        name = names[place]
        log.warning("a finished stage is lost from the artifact store", extra={"fields": {"stage": name}})
        records.transact(lambda session: _forget(session, found[name].id))
        lost.append(name)

    fetch_each(fetch, [(found[name].key, folder / name) for name in names], on_missing=forget)
    return [name for name in names if name not in lost]


def _forget(session: Session, blob_id: str) -> None:
    """Drop what refers to lost bytes, and their record: the same bytes are to be stored anew, not found in it."""
    for table in (Checkpoint, MapCheckpoint):
        session.execute(delete(table).where(table.blob_id == blob_id))
    blobs.lose(session, blob_id)


def _shelved(session: Session, shelf: Shelf) -> dict[str, _Kept]:
    """The finished stages, by name."""
    if isinstance(shelf, DriveShelf):
        mine = (Checkpoint.drive_id == shelf.drive_id) & (Checkpoint.settings_sha256 == shelf.settings_sha256)
        of_drive = select(Checkpoint.name, *_KEPT).join(Blob, Checkpoint.blob_id == Blob.id)
        return {name: _Kept(*kept) for name, *kept in session.execute(of_drive.where(mine))}
    of_maps = select(MapCheckpoint.inputs_sha256, *_KEPT).join(Blob, MapCheckpoint.blob_id == Blob.id)
    rows = session.execute(
        of_maps.where(MapCheckpoint.project_id == shelf.project_id).order_by(MapCheckpoint.created_us)
    )
    return shelf.find({inputs: _Kept(*kept) for inputs, *kept in rows})  # the newest


def keep(session: Session, shelf: Shelf, stored: Mapping[str, StoredFile]) -> bool:
    """Note checkpoints, by name, that were put into the artifact store; older ones of the same names are replaced.

    Nothing is kept where the drive or the map has been deleted.

    Returns
    -------
    bool
        Whether a later attempt will find any of them.
    """
    owner: Drive | Map | None
    match shelf:
        case DriveShelf():
            owner = session.get(Drive, shelf.drive_id)
        case MapShelf():
            owner = session.get(Map, shelf.map_id)
    if owner is None:
        return False
    kept = False
    for name, file in stored.items():
        if isinstance(shelf, MapShelf) and shelf.digest(name) is None:
            continue
        blob = blobs.record(session, project_id=owner.project_id, within_quota=False, **file.identity)
        checkpoint = _find(session, shelf, name)
        if checkpoint is None:
            session.add(_new(shelf, name, blob.id))
        else:
            checkpoint.blob_id = blob.id
            checkpoint.created_us = now_us()
        kept = True
    if isinstance(shelf, DriveShelf):
        _clear_old_shelves(session, shelf)
    return kept


def missing(session: Session, shelf: DriveShelf, names: Collection[str]) -> list[str]:
    """Names of checkpoints that a later attempt would not find."""
    return sorted(set(names) - _shelved(session, shelf).keys())


def drop_submaps(session: Session, shelf: DriveShelf, *, after: int) -> None:
    """Drop the stages of sub-maps with higher numbers: the drive was cut into more pieces once, which are large."""
    mine = (Checkpoint.drive_id == shelf.drive_id) & (Checkpoint.settings_sha256 == shelf.settings_sha256)
    names = session.scalars(select(Checkpoint.name).where(mine)).all()
    old = [name for name in names if (number := submap_number(name)) is not None and number > after]
    dropped = delete(Checkpoint).where(mine, Checkpoint.name.in_(old))
    session.execute(dropped.execution_options(synchronize_session=False))


def _clear_old_shelves(session: Session, shelf: DriveShelf) -> None:
    """Drop a drive's stages under settings other than the last few, but for those that a job may still need."""
    session.flush()
    newest = func.max(Checkpoint.created_us).desc()
    mine = select(Checkpoint.settings_sha256).where(Checkpoint.drive_id == shelf.drive_id)
    shelves = session.scalars(mine.group_by(Checkpoint.settings_sha256).order_by(newest)).all()
    old = set(shelves[_SHELVES_A_DRIVE:]) - {shelf.settings_sha256}
    if not old:
        return
    old -= {settings_sha256(job.settings) for job in session.scalars(jobs.active_of_drive(shelf.drive_id))}
    dropped = delete(Checkpoint).where(Checkpoint.drive_id == shelf.drive_id, Checkpoint.settings_sha256.in_(old))
    session.execute(dropped.execution_options(synchronize_session=False))


def _find(session: Session, shelf: Shelf, name: str) -> Checkpoint | MapCheckpoint | None:
    match shelf:
        case DriveShelf():
            return session.get(Checkpoint, (shelf.drive_id, shelf.settings_sha256, name))
        case MapShelf():
            return session.get(MapCheckpoint, (shelf.map_id, shelf.digest(name), _SEAM))


def _new(shelf: Shelf, name: str, blob_id: str) -> Checkpoint | MapCheckpoint:
    match shelf:
        case DriveShelf():
            return Checkpoint(
                drive_id=shelf.drive_id, settings_sha256=shelf.settings_sha256, name=name, blob_id=blob_id
            )
        case MapShelf():
            return MapCheckpoint(
                map_id=shelf.map_id,
                project_id=shelf.project_id,
                inputs_sha256=shelf.digest(name),
                name=_SEAM,
                blob_id=blob_id,
            )
