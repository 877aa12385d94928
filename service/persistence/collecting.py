"""Deleting bytes that nothing needs any more."""

from __future__ import annotations

from itertools import islice

from service.persistence import blobs
from service.persistence.artifacts import ArtifactStore
from service.persistence.database import Database
from service.persistence.tables import now_us

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
    deleted = 0
    while True:
        with database.write() as session:
            keys = blobs.forget_unused(
                session, untouched_since_us=now_us() - _GRACE_US, project_id=project_id, limit=_BATCH
            )
        if not keys:
            return deleted
        artifacts.delete(keys)
        deleted += len(keys)


def collect_orphans(database: Database, artifacts: ArtifactStore) -> int:
    """Delete objects that no blob names and that are older than a day.

    Returns
    -------
    int
        How many objects were deleted.
    """
    deleted = 0
    old = (found.key for found in artifacts.objects() if found.changed_us < now_us() - _ORPHAN_US)
    while keys := list(islice(old, _BATCH)):
        with database.read() as session:
            orphans = set(keys) - blobs.known_keys(session, keys)
        artifacts.delete(orphans)
        deleted += len(orphans)
    return deleted
