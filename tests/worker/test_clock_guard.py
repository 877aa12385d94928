"""Clocks that are set, machines that sleep, databases that are away: silence that is no worker's death."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import service.database.connections
from schemas.api.jobs import JobKind
from schemas.api.webhooks import WebhookRequest
from service.database.tables import WebhookDelivery, now_us
from service.domain import jobs, webhooks
from tests.helpers.service_world import World
from worker.clock_guard import ClockGuard
from worker.heartbeat import Heartbeat
from worker.reconciler import Reconciler

LEASE_S = 40.0


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Records alone."""
    made = World(tmp_path)
    yield made
    made.close()


class Clocks:
    """Of a machine: what its wall and its monotonic clock say."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall_s, self.monotonic_s = 1e9, 100.0
        monkeypatch.setattr("worker.clock_guard.time.monotonic", lambda: self.monotonic_s)

    def go_on(self, seconds: float) -> None:
        self.wall_s += seconds
        self.monotonic_s += seconds

    def counts(self, clock_guard: ClockGuard, *, waits_s: float = 0.0) -> bool:
        clock_guard.ask()
        self.go_on(waits_s)
        return clock_guard.counts(int(self.wall_s * 1e6))


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


def test_a_silent_worker_counts_while_nothing_happens(clocks: Clocks) -> None:
    clock_guard = ClockGuard(LEASE_S)
    for _ in range(20):
        assert clocks.counts(clock_guard)
        clocks.go_on(300.0)  # a pass may take its time


@pytest.mark.parametrize("step_s", [60.0, -3600.0])
def test_a_silent_worker_after_a_step_of_the_clock(clocks: Clocks, step_s: float) -> None:
    clock_guard = ClockGuard(LEASE_S)
    assert clocks.counts(clock_guard)
    for _ in range(3):
        clocks.wall_s += step_s
        assert not clocks.counts(clock_guard)
        clocks.go_on(5.0)
    clocks.go_on(LEASE_S - 6.0)
    assert not clocks.counts(clock_guard)
    clocks.go_on(2.0)
    assert clocks.counts(clock_guard)


def test_a_silent_worker_after_a_database_that_was_away(clocks: Clocks) -> None:
    """Where every turn takes long, a dead worker's jobs are free all the same."""
    clock_guard = ClockGuard(LEASE_S)
    clock_guard.ask()  # and got no answer
    clocks.go_on(20.0)
    assert not clocks.counts(clock_guard)
    clocks.go_on(LEASE_S)
    assert clocks.counts(clock_guard)
    assert not clocks.counts(clock_guard, waits_s=15.0)
    clocks.go_on(LEASE_S)
    assert clocks.counts(clock_guard, waits_s=15.0)


@pytest.mark.slow
def test_step_of_the_clock(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Live workers keep their jobs; who died is replaced in the time of a lease, however far the clock was set back."""
    off_us = 0
    monkeypatch.setattr(service.database.connections, "now_us", lambda: now_us() + off_us)
    lease_us = int(world.settings.lease_seconds * 1e6)
    drive_id = world.add_drive(brief_drive)
    job_id = world.ask(drive_id, wake=False)
    waits = world.ask(drive_id, wake=False)
    reconciler = Reconciler(world.settings)

    def reconcile() -> None:
        with world.database.read() as session:  # nothing is to be sent: there is no broker
            assert list(jobs.all_due(session)) == []
        reconciler.reconcile_jobs()

    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="a worker", lease_us=lease_us)
        other = jobs.claim(session, waits, owner="another", lease_us=lease_us)
        assert held is not None
        assert other is not None
    reconcile()
    for _ in range(3):
        off_us += 60_000_000
        reconcile()
        with world.database.write() as session:
            for claim in (held, other):
                jobs.heartbeat(session, claim, lease_us=lease_us)
    with world.database.write() as session:
        jobs.end_lease(session, waits, other.fence)
    off_us += 60_000_000
    reconciler.reconcile_jobs()
    assert world.outcomes(waits) == ["worker-lost"], "its process is known to be dead, whatever the clock says"
    assert world.job(job_id).state == "RUNNING"
    off_us -= 3_600_000_000
    reconciler.reconcile_jobs()
    clock_us = now_us() + off_us
    assert (world.job(job_id).lease_until_us or 0) <= clock_us + lease_us


def test_wait_that_the_clock_made_long(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    day_us = 86_400_000_000
    with world.database.write() as session:
        session.get_one(type(world.job(job_id)), job_id).not_before_us = now_us() + day_us
    Reconciler(world.settings).reconcile_jobs()
    assert world.job(job_id).not_before_us <= now_us() + 120_000_000


def test_messages_that_wait_when_the_clock_is_set_back(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new one is sent at once, and one that was refused is tried again as soon as it would have been."""
    off_us = 3_600_000_000
    monkeypatch.setattr(service.database.connections, "now_us", lambda: now_us() + off_us)
    asked = WebhookRequest.model_validate({"url": "http://127.0.0.1:1/hook"})
    with world.database.write() as session:
        webhooks.create(session, project_id=world.project_id, asked=asked, allow_private=True)
    end_job(world)
    with world.database.write() as session:
        (refused,) = webhooks.take(session, limit=1)
        webhooks.note(session, refused, webhooks.Outcome(status=500, error="answered 500"))
    end_job(world)
    off_us = 0
    Reconciler(world.settings).reconcile_jobs()
    with world.database.write() as session:
        (fresh,) = webhooks.take(session, limit=1)
        assert fresh.id != refused.id
        assert session.get_one(WebhookDelivery, refused.id).next_us <= now_us() + webhooks.TAKEN_US


def end_job(world: World) -> None:
    with world.database.write() as session:
        job = jobs.create(session, project_id=world.project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_1")
        jobs.request_cancel(session, job.id)


def test_database_that_is_locked_for_longer_than_a_lease(world: World, brief_drive: Path) -> None:
    """A stage goes on: whoever locks the database keeps the others from taking its job, too."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    hasty = world.settings.model_copy(update={"heartbeat_seconds": 0.05, "lease_seconds": 0.5})
    impatient = service.database.connections.Database(world.settings.resolved_database_url, timeout_s=0.1)
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="a worker", lease_us=500_000)
    assert held is not None
    with Heartbeat(impatient, held, hasty, progress=jobs.ProgressNote) as heartbeat:
        lock = sqlite3.connect(world.settings.data_dir / "mrasfm.sqlite3", isolation_level=None)
        lock.execute("BEGIN IMMEDIATE")
        ends_s = time.monotonic() + 2.0
        while time.monotonic() < ends_s:
            heartbeat.check_stop()
            time.sleep(0.05)
        lock.execute("ROLLBACK")
        lock.close()
        time.sleep(0.5)
        heartbeat.check_stop()
    assert (world.job(job_id).heartbeat_us or 0) > now_us() - 2_000_000
    impatient.close()
