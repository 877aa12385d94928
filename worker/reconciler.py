"""Keeps what is recorded and what happens in step: the broker may lose messages, workers may die, times run out."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from sqlalchemy import delete, select

from service.logs import log_fields
from service.persistence import jobs, maps, trees, workers
from service.persistence.artifacts import ArtifactStore
from service.persistence.collecting import collect_orphans, collect_unused
from service.persistence.database import Database
from service.persistence.tables import TERMINAL, Drive, IdempotencyKey, Job, JobMember, MapScene, now_us
from service.persistence.wakeups import BrokerError, Wakeups, task_id
from service.settings import Settings

log = logging.getLogger("mrasfm.reconciler")

_HOUR_US = 3600 * 1_000_000
_SWEEP_EVERY_S = 600.0
_ORPHANS_FIRST_S = 3600.0  # not with every restart: listing a store costs time and, in the cloud, money
_ORPHANS_EVERY_S = 86_400.0
_END_WITHIN_S = 5.0
_BATCH = 500


class Reconciler:
    """Any number may run at the same time: all that one does is conditional on what the database says."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._database = Database.of(settings)
        self._artifacts = ArtifactStore(settings)
        self._wakeups = Wakeups(settings)
        self._broker_was_there = True

    def close(self) -> None:
        """Let go of the database."""
        self._database.close()

    def run(self, ended: threading.Event) -> None:
        """Reconcile again and again until `ended`.

        Deleting takes its time, above all in the cloud: jobs of workers that died do not wait for it.
        """
        threads = [
            threading.Thread(target=self._repeat, args=(ended, *task), name=task[0], daemon=True)
            for task in (
                ("sweep", self.sweep, _SWEEP_EVERY_S, 0.0),
                ("orphans", self.collect_orphans, _ORPHANS_EVERY_S, _ORPHANS_FIRST_S),
            )
        ]
        for thread in threads:
            thread.start()
        self._repeat(ended, "jobs", self.reconcile_jobs, self._settings.reconcile_seconds, 0.0)
        for thread in threads:
            thread.join(_END_WITHIN_S)  # what is cut short is done by the next one

    def _repeat(
        self, ended: threading.Event, what: str, step: Callable[[], None], every_s: float, first_s: float
    ) -> None:
        ended.wait(first_s)
        while not ended.is_set():
            self._try(what, step)
            ended.wait(every_s)

    def _try(self, what: str, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception:  # the next pass tries again
            log.exception("a pass failed", extra={"fields": {"pass": what}})

    def reconcile_jobs(self) -> None:
        """Free jobs whose worker is silent, and wake workers up for those that wait and have no message."""
        with self._database.write() as session:
            lost = jobs.expire_leases(session, max_attempts=self._settings.max_attempts)
        trees.tend(self._database)
        for job_id in lost:
            with log_fields(job_id=job_id):
                log.warning("the worker was not heard of any more")
        with self._database.read() as session:
            due = list(jobs.all_due(session))
        if not due:
            return
        try:
            known = self._wakeups.waiting()
            missing = [job for job in due if task_id(job) not in known]
            for i in range(0, len(missing), _BATCH):
                self._send(missing[i : i + _BATCH])
        except BrokerError as error:
            if self._broker_was_there:
                log.warning("the broker does not answer", extra={"fields": {"why": str(error), "jobs": len(due)}})
            self._broker_was_there = False
            return
        self._broker_was_there = True
        if missing:
            log.info("woke workers up", extra={"fields": {"jobs": len(missing)}})

    def _send(self, missing: list[Job]) -> None:
        self._wakeups.send(missing)
        with self._database.write() as session:
            jobs.mark_enqueued(session, [job.id for job in missing])

    def sweep(self) -> None:
        """Delete what has passed its retention date, and bytes that nothing needs."""
        self._try("retention", self._expire)
        _tell(collect_unused(self._database, self._artifacts))

    def collect_orphans(self) -> None:
        """Delete bytes that no record names: all of the store is listed for it."""
        _tell(collect_orphans(self._database, self._artifacts))

    def _expire(self) -> None:
        now = now_us()
        with self._database.write() as session:  # of its own: aggregations lock maps and scenes before drives
            maps.forget_expired(session, now)
        with self._database.write() as session:
            # Locked first: a job that is asked for at this moment has been recorded then, or finds no drive.
            expired = session.scalars(select(Drive.id).where(Drive.expires_us < now).with_for_update()).all()
            active = select(Job.drive_id).where(Job.drive_id.is_not(None), Job.state.not_in(TERMINAL))
            in_map = select(MapScene.drive_id)
            of_jobs = select(JobMember.drive_id).join(Job, Job.id == JobMember.job_id)
            wanted = of_jobs.where(Job.state.not_in(TERMINAL))
            idle = Drive.id.not_in(active) & Drive.id.not_in(in_map) & Drive.id.not_in(wanted)
            session.execute(delete(Drive).where(Drive.id.in_(expired), idle))
            session.execute(delete(Job).where(Job.expires_us < now, Job.state.in_(TERMINAL)))
            kept_us = int(self._settings.idempotency_hours * _HOUR_US)
            session.execute(delete(IdempotencyKey).where(IdempotencyKey.created_us < now - kept_us))
            workers.forget(session, unseen_since_us=now - 30 * 24 * _HOUR_US)


def _tell(deleted: int) -> None:
    if deleted:
        log.info("deleted bytes that nothing needs", extra={"fields": {"objects": deleted}})
