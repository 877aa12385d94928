"""Drives that have the same images as others: one recording that was uploaded twice."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.drives import FileRole
from service.database.tables import Blob, Drive, DriveFile

_BATCH = 500


def drives_of_one_recording(
    session: Session, coming: Collection[str], present: Collection[str] = ()
) -> tuple[Drive, Drive] | None:
    """The first two of some committed drives whose images have the same contents, whatever their manifests say.

    Contents are compared only between drives of equally many files and bytes: the files of a map's drives may be
    millions. Drives with the same images and other masks are not found so, an aggregation refuses them later.

    Parameters
    ----------
    coming, present
        Ids of the drives. One of the two is coming at least: what a map has, it keeps.
    """
    alike: dict[tuple[int, int, int | None, int | None], list[Drive]] = {}
    for drive in sorted(_drives(session, sorted({*coming, *present})), key=lambda drive: (drive.created_us, drive.id)):
        size = drive.cameras, drive.frames, drive.files_stored, drive.bytes_stored
        alike.setdefault(size, []).append(drive)
    for drives in alike.values():
        first_with: dict[frozenset[str], Drive] = {}
        for drive in drives if len(drives) > 1 else ():
            contents = _contents(session, drive)
            first = first_with.setdefault(contents, drive)
            if contents and first is not drive and not {first.id, drive.id}.isdisjoint(coming):
                return first, drive
    return None


def _drives(session: Session, drive_ids: list[str]) -> Iterable[Drive]:
    for begin in range(0, len(drive_ids), _BATCH):
        yield from session.scalars(select(Drive).where(Drive.id.in_(drive_ids[begin : begin + _BATCH])))


def _contents(session: Session, drive: Drive) -> frozenset[str]:
    """SHA-256 of the images."""
    mine = (DriveFile.drive_id == drive.id) & (DriveFile.role == FileRole.IMAGE)
    return frozenset(session.scalars(select(Blob.sha256).join(DriveFile, DriveFile.blob_id == Blob.id).where(mine)))
