"""Keeps what is recorded and what happens in step: the broker may lose messages, workers may die, times run out."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable

from sqlalchemy import ColumnElement, delete, or_, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.database.connections import Database, clock_us
from service.database.tables import (
    TERMINAL,
    Drive,
    Export,
    IdempotencyKey,
    Job,
    JobMember,
    Map,
    MapScene,
    Scene,
)
from service.domain import exports, job_trees, jobs, maps, passes, webhooks, workers
from service.job_queue import BrokerError, JobQueue, task_id
from service.logs import log_fields
from service.settings import Settings
from service.storage.artifacts import ArtifactStore
from service.storage.garbage_collection import collect_orphans, collect_unused
from worker.clock_guard import ClockGuard
from worker.webhook_sender import WebhookSender

log = logging.getLogger("mrasfm.reconciler")

_HOUR_US = 3600 * 1_000_000
_SWEEP_EVERY_S = 600.0
_SWEEP_RESTS = 9.0  # times as long as it took: of millions of files it takes minutes of the database
_ORPHANS_FIRST_S = 300.0
_ORPHANS_CHECK_EVERY_S = 600.0
_ORPHANS_EVERY_US = 24 * _HOUR_US  # not with every restart: listing a store costs time and, in the cloud, money
_END_WITHIN_S = 5.0
_BATCH = 500
_NOTED_EVERY_S = 10.0  # passes of a second are not written down one by one


class Reconciler:
    """Reconciler, of which any number may run at the same time: its changes are conditional on the database."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._database = Database.from_settings(settings)
        self._artifacts = ArtifactStore.open(settings, self._database)
        self._job_queue = JobQueue(settings)
        self._webhooks = WebhookSender(settings, self._database)
        self._broker_was_there = True
        self._clock_guard = ClockGuard(settings.lease_seconds)
        self._limits = jobs.RetryLimits.from_settings(settings)

    def close(self) -> None:
        """Close the connections to the database."""
        self._database.close()

    def run(self, ended: threading.Event) -> None:
        """Reconcile again and again until `ended`.

        Deleting takes its time, above all in the cloud: jobs of workers that died do not wait for it.
        """
        threads = [
            threading.Thread(target=self._repeat, args=(ended, *task), name=task[0], daemon=True)
            for task in (
                (passes.SWEEP, self.sweep, _SWEEP_EVERY_S, 0.0, _SWEEP_RESTS),
                (passes.WEBHOOKS, lambda: self._webhooks.send_due(ended), self._settings.webhook_seconds, 0.0),
                (passes.ORPHANS, self.collect_orphans, _ORPHANS_CHECK_EVERY_S, _ORPHANS_FIRST_S),
            )
        ]
        for thread in threads:
            thread.start()
        self._repeat(ended, passes.JOBS, self.reconcile_jobs, self._settings.reconcile_seconds, 0.0)
        for thread in threads:
            thread.join(_END_WITHIN_S)  # what is cut short is done by the next one

    def _repeat(
        self,
        ended: threading.Event,
        what: str,
        step: Callable[[], object],
        every_s: float,
        first_s: float,
        rests: float = 0.0,
    ) -> None:
        """Make a pass again and again, and note those that went well where the status and the metrics find them."""
        ended.wait(first_s)
        noted_s = math.inf if what == passes.ORPHANS else -math.inf  # which notes when the store was really listed
        while not ended.is_set():
            begun_s = time.monotonic()
            try:
                step()
                if time.monotonic() > noted_s + _NOTED_EVERY_S:
                    self._database.transact(lambda session: passes.note(session, what))
                    noted_s = time.monotonic()
            except Exception:  # the next pass tries again
                log.exception("a pass failed", extra={"fields": {"pass": what}})
            ended.wait(max(every_s, rests * (time.monotonic() - begun_s)))

    def reconcile_jobs(self) -> None:
        """Free jobs whose worker is silent, and wake workers up for those that wait and have no message."""
        lost = self._expire_leases()
        job_trees.tend(self._database)
        for job_id in lost:
            with log_fields(job_id=job_id):
                log.warning("the worker was not heard of any more")
        with self._database.read() as session:
            due = list(jobs.all_due(session))
        if not due:
            return
        try:
            known = self._job_queue.waiting()
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

    def _expire_leases(self) -> list[str]:
        chosen = self._settings
        longest_delay_s = max(chosen.retry_delay_seconds, chosen.longest_retry_delay_seconds)
        self._clock_guard.ask()
        with self._database.write() as session:
            counts = self._clock_guard.counts(clock_us(session))
            lost = jobs.expire_leases(session, limits=self._limits, only_ended=not counts)
            jobs.bound_times(session, lease_us=int(chosen.lease_seconds * 1e6), delay_us=int(longest_delay_s * 1e6))
            webhooks.bound_times(session)
        return lost

    def _send(self, missing: list[Job]) -> None:
        self._job_queue.send(missing)
        with self._database.write() as session:
            jobs.mark_enqueued(session, [job.id for job in missing])

    def sweep(self) -> None:
        """Delete what has passed its retention date, and bytes that nothing needs."""
        try:
            self._expire()
        finally:  # what expires and cannot be deleted holds up nothing else
            _tell(collect_unused(self._database, self._artifacts))

    def collect_orphans(self) -> None:
        """Delete bytes that no record names, once a day by all reconcilers: all of the store is listed for it."""
        with self._database.read() as session:
            age_us = passes.ages_us(session).get(passes.ORPHANS)
        if age_us is not None and 0 <= age_us < _ORPHANS_EVERY_US:
            return
        _tell(collect_orphans(self._database, self._artifacts))
        with self._database.write() as session:
            passes.note(session, passes.ORPHANS)

    def _expire(self) -> None:
        """Each transaction is short: while one deletes, SQLite lets no worker say that it lives."""
        now = self._database.query(clock_us)
        # Of their own: aggregations lock maps and scenes before drives.
        self._in_batches(lambda session: exports.forget_expired(session, now))
        self._in_batches(lambda session: webhooks.forget_old(session, now))
        self._in_batches(lambda session: maps.forget_expired(session, now, unless=_is_exported))
        with self._database.read() as session:
            expired = session.scalars(select(Drive.id).where(Drive.expires_us < now)).all()
        for drive_id in expired:
            self._forget_drive(drive_id, now)
        ended = (Job.expires_us < now) & Job.state.in_(TERMINAL)
        self._in_batches(lambda session: _delete_some(session, ended, Job.id))
        unkept = IdempotencyKey.created_us < now - int(self._settings.idempotency_hours * _HOUR_US)
        self._in_batches(lambda session: _delete_some(session, unkept, IdempotencyKey.project_id, IdempotencyKey.key))
        with self._database.write() as session:
            webhooks.forget_old_secrets(session)
            workers.forget(session, unseen_since_us=clock_us(session) - 30 * 24 * _HOUR_US)

    def _in_batches(self, step: Callable[[Session], int]) -> None:
        """Repeat a transaction until it deletes nothing any more."""
        deleted = 1
        while deleted:
            with self._database.write() as session:
                deleted = step(session)

    def _forget_drive(self, drive_id: str, now: int) -> None:
        with self._database.write() as session:
            # Locked first: a job that is asked for at this moment has been recorded then, or finds no drive.
            session.scalar(select(Drive.id).where(Drive.id == drive_id).with_for_update())
            active = select(Job.id).where(Job.drive_id == drive_id, Job.state.not_in(TERMINAL))
            in_map = select(MapScene.drive_id).where(MapScene.drive_id == drive_id)
            of_jobs = select(JobMember.drive_id).join(Job, Job.id == JobMember.job_id)
            wanted = of_jobs.where(JobMember.drive_id == drive_id, Job.state.not_in(TERMINAL))
            idle = ~or_(active.exists(), in_map.exists(), wanted.exists())
            session.execute(delete(Drive).where(Drive.id == drive_id, Drive.expires_us < now, idle))


def _is_exported(table: type[Map] | type[Scene]) -> ColumnElement[bool]:
    return exports.is_exported((Export.map_id == Map.id) if table is Map else (Export.scene_id == Scene.id))


def _delete_some(session: Session, condition: ColumnElement[bool], *key: InstrumentedAttribute[str]) -> int:
    """Delete no more than a batch of rows that meet a condition; how many."""
    some = select(*key).where(condition).limit(_BATCH)
    dropped = delete(key[0].class_).where(tuple_(*key).in_(some)).execution_options(synchronize_session=False)
    return int(session.execute(dropped).rowcount)  # type: ignore[attr-defined]


def _tell(deleted: int) -> None:
    if deleted:
        log.info("deleted bytes that nothing needs", extra={"fields": {"objects": deleted}})
