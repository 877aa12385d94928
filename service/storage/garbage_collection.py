"""Deleting bytes that nothing needs any more."""

from __future__ import annotations

from itertools import islice

from sqlalchemy import select

from service.database.connections import Database
from service.database.tables import Project, now_us
from service.storage import blobs
from service.storage.artifacts import ArtifactStore

_HOUR_US = 3600 * 1_000_000
_GRACE_US = _HOUR_US  # an upload or a publication refers to its bytes within this time
_ORPHAN_US = 24 * _HOUR_US  # an object that no blob names is left from something that was killed
_BATCH = 500


def collect_unused(database: Database, artifacts: ArtifactStore, *, project_id: str | None = None) -> int:
    """Drop blobs that nothing refers to and that were not used within the hour, and give back their space.

    Parameters
    ----------
    project_id
        Of this project only; by default of all.

    Returns
    -------
    int
        How many objects were deleted.
    """
    if project_id is not None:
        return _collect_unused_of(database, artifacts, project_id)
    with database.read() as session:
        project_ids = session.scalars(select(Project.id)).all()
    return sum(_collect_unused_of(database, artifacts, found) for found in project_ids)


def _collect_unused_of(database: Database, artifacts: ArtifactStore, project_id: str) -> int:
    """Find unused blobs while others write, and drop each batch within one short transaction."""
    deleted = 0
    last = ""
    while True:
        since_us = now_us() - _GRACE_US
        with database.read() as session:
            found = blobs.find_unused(session, project_id, untouched_since_us=since_us, after_sha256=last, limit=_BATCH)
        if not found:
            return deleted
        last = found[-1].sha256
        with database.write() as session:
            keys = blobs.forget_unused(session, untouched_since_us=since_us, blob_ids=[blob.id for blob in found])
        artifacts.delete(keys)
        deleted += len(keys)


def collect_orphans(database: Database, artifacts: ArtifactStore) -> int:
    """Delete objects of our projects that no blob names and that are older than a day.

    Returns
    -------
    int
        How many objects were deleted.
    """
    deleted = 0
    old = (found.key for found in artifacts.objects() if found.changed_us < now_us() - _ORPHAN_US)
    while keys := list(islice(old, _BATCH)):
        with database.read() as session:
            orphans = blobs.orphans(session, keys)
        artifacts.delete(orphans)
        deleted += len(orphans)
    return deleted
