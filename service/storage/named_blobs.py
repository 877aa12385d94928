"""Blobs that records name which are about to be deleted: after that, nothing else may refer to them.

Each function is called within the transaction that deletes, and follows the references that the database deletes along.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Select, select, union
from sqlalchemy.orm import Session

from service.database.tables import Checkpoint, Drive, DriveFile, Export, ExportFile, MapCheckpoint, MapFile, SceneFile

# Ids of blobs; None where they are more than are kept in memory for it.
Named = frozenset[str] | None
MAX_NAMED = 20_000
_EXPORTED = select(ExportFile.blob_id).join(Export, Export.id == ExportFile.export_id)


def of_drive(session: Session, drive_id: str) -> Named:
    """Blobs that a drive names: its manifest, its files and its finished stages."""
    return _named(
        session,
        select(Drive.manifest_blob_id).where(Drive.id == drive_id),
        select(Checkpoint.blob_id).where(Checkpoint.drive_id == drive_id),
        select(DriveFile.blob_id).where(DriveFile.drive_id == drive_id, DriveFile.blob_id.is_not(None)),
    )


def of_scene(session: Session, scene_id: str) -> Named:
    """Blobs that a scene and its exports name."""
    return _named(
        session,
        select(SceneFile.blob_id).where(SceneFile.scene_id == scene_id),
        _EXPORTED.where(Export.scene_id == scene_id),
    )


def of_map(session: Session, map_id: str) -> Named:
    """Blobs that the versions of a map, their exports and its finished stages name."""
    return _named(
        session,
        select(MapCheckpoint.blob_id).where(MapCheckpoint.map_id == map_id),
        select(MapFile.blob_id).where(MapFile.map_id == map_id),
        _EXPORTED.where(Export.map_id == map_id),
    )


def of_version(session: Session, map_id: str, number: int) -> Named:
    """Blobs that a version of a map and its exports name."""
    return _named(
        session,
        select(MapFile.blob_id).where(MapFile.map_id == map_id, MapFile.number == number),
        _EXPORTED.where(Export.map_id == map_id, Export.map_version == number),
    )


def of_export(session: Session, export_id: str) -> Named:
    """Blobs that an export names."""
    return _named(session, select(ExportFile.blob_id).where(ExportFile.export_id == export_id))


def both(first: Named, second: Named) -> Named:
    """Blobs that are in one of two sets."""
    if first is None or second is None or len(joined := first | second) > MAX_NAMED:
        return None
    return joined


def _named(session: Session, *statements: Select[Any]) -> Named:
    found = session.scalars(union(*statements).limit(MAX_NAMED + 1)).all()
    return None if len(found) > MAX_NAMED else frozenset(found)
