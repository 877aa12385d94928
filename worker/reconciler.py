"""Keeps what is recorded and what happens in step: the broker may lose messages, workers may die, times run out."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from itertools import islice

from sqlalchemy import delete, select

from service.logs import log_fields
from service.persistence import blobs, jobs, workers
from service.persistence.artifacts import ArtifactStore
from service.persistence.database import Database
from service.persistence.tables import TERMINAL, Drive, IdempotencyKey, Job, Scene, now_us
from service.persistence.wakeups import BrokerError, Wakeups, task_id
from service.settings import Settings

log = logging.getLogger("mrasfm.reconciler")

_HOUR_US = 3600 * 1_000_000
_GRACE_US = _HOUR_US  # an upload or a publication refers to its bytes within this time
_ORPHAN_US = 24 * _HOUR_US  # an object that no blob names is left from something that was killed
_SWEEP_EVERY_S = 600.0


class Reconciler:
    """Any number may run at the same time: all that one does is conditional on what the database says."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._database = Database.of(settings)
        self._artifacts = ArtifactStore(settings)
        self._wakeups = Wakeups(settings)
        self._broker_was_there = True

    def run(self, ended: threading.Event) -> None:
        """Reconcile again and again until `ended`."""
        swept_s = -_SWEEP_EVERY_S
        while not ended.is_set():
            self._try("jobs", self.reconcile_jobs)
            if time.monotonic() - swept_s > _SWEEP_EVERY_S:
                swept_s = time.monotonic()
                self._try("sweep", self.sweep)
            ended.wait(self._settings.reconcile_seconds)

    def _try(self, what: str, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception:  # the next pass tries again
            log.exception("a pass failed", extra={"fields": {"pass": what}})

    def reconcile_jobs(self) -> None:
        """Free jobs whose worker is silent, and wake workers up for those that wait and have no message."""
        with self._database.write() as session:
            lost = jobs.expire_leases(session, max_attempts=self._settings.max_attempts)
        for job_id in lost:
            with log_fields(job_id=job_id):
                log.warning("the worker was not heard of any more")
        with self._database.read() as session:
            due = jobs.due(session)
        if not due:
            return
        try:
            known = self._wakeups.waiting()
            missing = [job for job in due if task_id(job) not in known]
            if missing:
                self._wakeups.send(missing)
        except BrokerError as error:
            if self._broker_was_there:
                log.warning("the broker does not answer", extra={"fields": {"why": str(error), "jobs": len(due)}})
            self._broker_was_there = False
            return
        self._broker_was_there = True
        if missing:
            log.info("woke workers up", extra={"fields": {"jobs": len(missing)}})
            with self._database.write() as session:
                jobs.mark_enqueued(session, [job.id for job in missing])

    def sweep(self) -> None:
        """Delete what has passed its retention date, and bytes that nothing needs."""
        self._expire()
        self._collect_blobs()
        self._collect_orphans()

    def _expire(self) -> None:
        now = now_us()
        with self._database.write() as session:
            active = select(Job.drive_id).where(Job.state.not_in(TERMINAL))
            session.execute(delete(Drive).where(Drive.expires_us < now, Drive.id.not_in(active)))
            session.execute(delete(Scene).where(Scene.expires_us < now))
            session.execute(delete(Job).where(Job.expires_us < now, Job.state.in_(TERMINAL)))
            kept_us = int(self._settings.idempotency_hours * _HOUR_US)
            session.execute(delete(IdempotencyKey).where(IdempotencyKey.created_us < now - kept_us))
            workers.forget(session, unseen_since_us=now - 30 * 24 * _HOUR_US)

    def _collect_blobs(self) -> None:
        while True:
            with self._database.write() as session:
                keys = blobs.forget_unused(session, untouched_since_us=now_us() - _GRACE_US)
            if not keys:
                return
            self._artifacts.delete(keys)
            log.info("deleted bytes that nothing needs", extra={"fields": {"objects": len(keys)}})

    def _collect_orphans(self) -> None:
        old = (o.key for o in self._artifacts.objects() if o.changed_us < now_us() - _ORPHAN_US)
        while keys := list(islice(old, 500)):
            with self._database.read() as session:
                known = blobs.known_keys(session, keys)
            self._artifacts.delete(set(keys) - known)
