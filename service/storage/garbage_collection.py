"""Deleting bytes that nothing needs any more."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Sequence
from itertools import islice

from sqlalchemy import select

from service.database.connections import Database, clock_us
from service.database.tables import Project, now_us
from service.storage import blobs
from service.storage.artifacts import ArtifactStore
from service.storage.named_blobs import Named, both

log = logging.getLogger("mrasfm.api")

_HOUR_US = 3600 * 1_000_000
_GRACE_US = _HOUR_US  # an upload or a publication refers to its bytes within this time
_ORPHAN_US = 24 * _HOUR_US  # an object that no blob names is left from something that was killed
_BATCH = 500
_LOOKED_AT = 5000  # blobs, in one statement: well within its time, also where the disk is slow
_END_WITHIN_S = 5.0


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
    last: str | None = ""
    while last is not None:
        with database.read() as session:
            since_us = clock_us(session) - _GRACE_US
            page = blobs.find_unused(
                session, project_id, untouched_since_us=since_us, after_sha256=last, look_at=_LOOKED_AT
            )
        last = page.last_sha256
        for i in range(0, len(page.blob_ids), _BATCH):
            some = page.blob_ids[i : i + _BATCH]
            deleted += _forget(database, artifacts, some, untouched_since_us=since_us)
    return deleted


def collect_named(database: Database, artifacts: ArtifactStore, blob_ids: Collection[str]) -> int:
    """As `collect_unused`, of some blobs: the project's other ones are not looked at.

    Returns
    -------
    int
        How many objects were deleted.
    """
    deleted, since_us, left = 0, database.query(clock_us) - _GRACE_US, iter(sorted(blob_ids))
    while some := list(islice(left, _BATCH)):
        with database.read() as session:
            found = blobs.unused_among(session, some, untouched_since_us=since_us)
        if found:
            deleted += _forget(database, artifacts, found, untouched_since_us=since_us)
    return deleted


def _forget(database: Database, artifacts: ArtifactStore, blob_ids: Sequence[str], *, untouched_since_us: int) -> int:
    with database.write() as session:
        keys = blobs.forget_unused(session, untouched_since_us=untouched_since_us, blob_ids=blob_ids)
    artifacts.delete(keys)
    return len(keys)


class Collector:
    """A thread that collects what deletions left, of one project after the other.

    Request threads are left alone: they would all be taken where much was deleted, or the store answers slowly. Of a
    project no more is pending than one set of blobs; where that grows too large, all of the project is looked at, once.
    The thread begins with a deletion, and ends when nothing is left. What is not collected when the process ends, or
    because of an error, is left to the reconciler.
    """

    def __init__(self, database: Database, artifacts: ArtifactStore) -> None:
        self._database = database
        self._artifacts = artifacts
        self._pending: dict[str, Named] = {}  # by project, in the order in which they came
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False

    def add(self, project_id: str, named: Named) -> None:
        """Collect blobs soon, unless something refers to them, after the transaction that deleted what named them."""
        with self._lock:
            self._pending[project_id] = both(self._pending.get(project_id, frozenset()), named)
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._run, name="garbage-collection", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """End the thread after the project that it works on, or after a moment."""
        with self._lock:
            self._closed = True
            self._pending.clear()
            thread = self._thread
        if thread is not None:
            thread.join(_END_WITHIN_S)

    def _run(self) -> None:
        while (first := self._take_first()) is not None:
            project_id, named = first
            try:
                if named is None:
                    collect_unused(self._database, self._artifacts, project_id=project_id)
                else:
                    collect_named(self._database, self._artifacts, named)
            except Exception:  # the reconciler collects them
                log.exception("what was deleted was not collected", extra={"fields": {"project": project_id}})

    def _take_first(self) -> tuple[str, Named] | None:
        with self._lock:
            for project_id in self._pending:
                return project_id, self._pending.pop(project_id)
            self._thread = None
            return None


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
