"""What the broker loses and what workers leave behind, put right again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import redis
from sqlalchemy import insert, update

import worker.reconciler
from service.database.tables import Blob, Drive, IdempotencyKey, Job, JobEvent, Project, Scene, new_id, now_us
from service.domain import exports, jobs, passes
from service.job_queue import QUEUES, JobQueue
from service.storage import garbage_collection
from service.storage.blob_writer import file_sha256, store_file
from tests.helpers.service_world import World, wait_until
from worker.reconciler import Reconciler

DAY_US = 86_400_000_000
HOUR_US = 3_600_000_000


def queued(world: World) -> int:
    """Messages that wait for a worker."""
    with redis.Redis.from_url(world.broker.url) as client:
        return sum(int(client.llen(queue)) for queue in set(QUEUES.values()))


def flush(world: World) -> None:
    with redis.Redis.from_url(world.broker.url) as client:
        client.flushall()


def set_fields(world: World, table: type, row_id: str, **values: object) -> None:
    with world.database.write() as session:
        row = session.get_one(table, row_id)
        for name, value in values.items():
            setattr(row, name, value)


def test_lost_message(world: World, brief_drive: Path) -> None:
    drive_id = world.add_drive(brief_drive)
    job_ids = [world.ask(drive_id, seed=seed) for seed in range(3)]
    assert queued(world) == 3
    reconciler = Reconciler(world.settings)
    for _ in range(3):
        reconciler.reconcile_jobs()
    assert queued(world) == 3, "messages that wait are not sent again"
    flush(world)
    for _ in range(10):
        reconciler.reconcile_jobs()
        assert queued(world) == 3
    assert JobQueue(world.settings).waiting() == {f"{job_id}.1" for job_id in job_ids}
    assert all(world.job(job_id).enqueued_us for job_id in job_ids)


def test_jobs_that_need_no_message(world: World, brief_drive: Path) -> None:
    drive_id = world.add_drive(brief_drive)
    ended, waits, runs = (world.ask(drive_id, wake=False) for _ in range(3))
    world.cancel(ended)
    set_fields(world, Job, waits, not_before_us=now_us() + HOUR_US)
    with world.database.write() as session:
        assert jobs.claim(session, runs, owner="a worker", lease_us=HOUR_US)
    Reconciler(world.settings).reconcile_jobs()
    assert queued(world) == 0


@pytest.mark.slow
def test_many_jobs_wait(world: World) -> None:
    """All of them get a message, whatever waits in front."""
    count = 2300
    with world.database.write() as session:
        row = {"project_id": world.project_id, "drive_id": "drv_0"}
        kinds = ("PREFLIGHT", "RECONSTRUCTION")
        # Many came at the same moment.
        rows = [{**row, "id": new_id("job"), "kind": kinds[i % 2], "created_us": 1 + i // 700} for i in range(count)]
        session.execute(insert(Job), rows)
    reconciler = Reconciler(world.settings)
    for _ in range(2):
        reconciler.reconcile_jobs()
        assert queued(world) == count
    assert JobQueue(world.settings).waiting() == {f"{row['id']}.1" for row in rows}
    with world.database.read() as session:
        assert session.query(Job).filter(Job.enqueued_us.is_(None)).count() == 0


def test_jobs_do_not_wait_for_the_sweep(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that died during a long sweep is noticed; the end of the process does not wait for it either."""
    sweeping, go_on, listed = threading.Event(), threading.Event(), threading.Event()

    def sweep_for_long() -> None:
        sweeping.set()
        go_on.wait()

    reconciler = Reconciler(world.settings)
    monkeypatch.setattr(reconciler, "sweep", sweep_for_long)
    monkeypatch.setattr(reconciler, "collect_orphans", listed.set)
    monkeypatch.setattr(worker.reconciler, "_END_WITHIN_S", 0.1)
    ended = threading.Event()
    thread = threading.Thread(target=reconciler.run, args=(ended,))
    thread.start()
    try:
        assert sweeping.wait(60)
        job_id = world.ask(world.add_drive(brief_drive), wake=False)
        with world.database.write() as session:
            assert jobs.claim(session, job_id, owner="a worker", lease_us=0)
        wait_until(lambda: queued(world) == 1, "the job's message")
        assert not listed.is_set(), "the store is not listed with every start"
        wait_until(lambda: passes_of(world) == {passes.JOBS, passes.WEBHOOKS}, "what the status asks for")
    finally:
        ended.set()
        thread.join(60)
        stopped = not thread.is_alive()
        go_on.set()
    assert stopped


def passes_of(world: World) -> set[str]:
    """Passes that have been noted: those that went well."""
    with world.database.read() as session:
        return set(passes.ages_us(session))


def test_a_pass_that_fails_is_not_noted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*given: object, **more: object) -> None:
        raise OSError

    reconciler, ended = Reconciler(world.settings), threading.Event()
    monkeypatch.setattr(exports, "forget_expired", fails)
    monkeypatch.setattr(reconciler, "reconcile_jobs", fails)
    thread = threading.Thread(target=reconciler.run, args=(ended,))
    thread.start()
    try:
        wait_until(lambda: passes.WEBHOOKS in passes_of(world), "the pass that goes well")
    finally:
        ended.set()
        thread.join(60)
    assert passes_of(world) == {passes.WEBHOOKS}


def test_delivered_message_is_not_sent_again(world: World, brief_drive: Path) -> None:
    """Kombu has moved it from its queue to what is delivered and not acknowledged."""
    world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.hold(job_id)
    assert JobQueue(world.settings).waiting() == {f"{job_id}.1"}
    for _ in range(5):
        Reconciler(world.settings).reconcile_jobs()
    assert queued(world) == 0
    child.kill()


@pytest.mark.slow
def test_broker_that_is_away(world: World, brief_drive: Path) -> None:
    """Accepted meanwhile, and run after its return: a worker and a reconciler have waited for it."""
    world.start_worker()
    world.broker.kill()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    wait_until(lambda: "the broker does not answer" in world.log(), "that it is missed")
    time.sleep(3)
    assert world.log().count("the broker does not answer") == 1, "said once and not with every pass"
    assert world.job(job_id).state == "QUEUED"
    world.broker.start()
    took_s = wait_until(lambda: world.job(job_id).state != "QUEUED", "the job's begin", within_s=30)
    assert took_s > 0
    assert world.wait_for_end(job_id).state == "SUCCEEDED"


def test_silent_worker(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    reconciler = Reconciler(world.settings)
    with world.database.write() as session:
        losses = world.settings.max_losses - 3
        session.execute(update(Job).values(losses=losses))
    for attempt in (1, 2, 3):
        with world.database.write() as session:
            assert jobs.claim(session, job_id, owner=f"worker {attempt}", lease_us=0)
        flush(world)
        reconciler.reconcile_jobs()
        expected = set() if attempt == 3 else {f"{job_id}.{attempt + 1}"}
        assert JobQueue(world.settings).waiting() == expected
    job = world.job(job_id)
    assert job.state == "FAILED"
    assert job.problem is not None
    assert job.problem["type"].endswith(":worker-lost")
    assert world.outcomes(job_id) == ["worker-lost"] * 3


def test_live_worker_keeps_its_job(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    with world.database.write() as session:
        assert jobs.claim(session, job_id, owner="a worker", lease_us=HOUR_US)
    Reconciler(world.settings).reconcile_jobs()
    assert (world.job(job_id).state, world.job(job_id).fence) == ("RUNNING", 1)


def test_retention(world: World, brief_drive: Path) -> None:
    """Deleted is what has a date that has passed, unless a job needs it."""
    past, future = now_us() - 1, now_us() + DAY_US
    drives = {name: world.add_drive(brief_drive) for name in ("past", "future", "none", "needed")}
    job_ids = {name: world.ask(drive_id, wake=False) for name, drive_id in drives.items()}
    for name in ("past", "future", "none"):
        world.cancel(job_ids[name])
    for name, expires_us in (("past", past), ("future", future), ("needed", past)):
        set_fields(world, Drive, drives[name], expires_us=expires_us)
        set_fields(world, Job, job_ids[name], expires_us=expires_us)
    with world.database.write() as session:
        for name, expires_us in (("past", past), ("future", future), ("none", None)):
            session.add(
                Scene(
                    id=f"scn_{name}",
                    project_id=world.project_id,
                    job_id=f"job_{name}",
                    drive_id="gone",
                    name=name,
                    fence=1,
                    summary={},
                    expires_us=expires_us,
                )
            )
    Reconciler(world.settings).sweep()
    with world.database.read() as session:
        assert {row.id for row in session.query(Drive)} == {drives[name] for name in ("future", "none", "needed")}
        kept_jobs = {row.id for row in session.query(Job).filter_by(kind="RECONSTRUCTION")}
        assert kept_jobs == {job_ids[name] for name in ("future", "none", "needed")}
        assert {row.id for row in session.query(Scene)} == {"scn_future", "scn_none"}
        assert session.query(JobEvent).filter_by(job_id=job_ids["past"]).count() == 0


def test_bytes_that_nothing_needs(world: World, brief_drive: Path) -> None:
    drive_id = world.add_drive(brief_drive)
    used_bytes = project_bytes(world)
    with world.database.write() as session:
        session.delete(session.get_one(Drive, drive_id))
    reconciler = Reconciler(world.settings)
    stored = objects(world)
    reconciler.sweep()
    assert objects(world) == stored, "an upload under way may refer to them soon"
    with world.database.write() as session:
        blobs = session.query(Blob).all()
        assert {blob.key for blob in blobs} == stored
        for blob in blobs[1:]:
            blob.touched_us = now_us() - 2 * HOUR_US
        kept = blobs[0].key
    reconciler.sweep()
    assert objects(world) == {kept}
    assert 0 < project_bytes(world) < used_bytes


def test_objects_that_no_record_names(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Left by a process that was killed between storing and recording; a day old, as they cannot be made here."""
    drive_id = world.add_drive(brief_drive)
    named = objects(world)
    spooled = world.settings.spool_dir / "unnamed"
    spooled.write_bytes(b"bytes")
    store_file(
        world.database,
        world.artifacts,
        project_id=world.project_id,
        path=spooled,
        sha256=file_sha256(spooled),
        size_bytes=5,
    )
    (unnamed,) = objects(world) - named
    reconciler = Reconciler(world.settings)
    reconciler.collect_orphans()
    assert unnamed in objects(world)
    tomorrow: Callable[[], int] = lambda: now_us() + DAY_US + HOUR_US  # noqa: E731
    monkeypatch.setattr(garbage_collection, "now_us", tomorrow)
    reconciler.collect_orphans()
    assert unnamed in objects(world), "the store was listed within the day, maybe by a process that is gone"
    monkeypatch.setattr(passes, "clock_us", lambda session: tomorrow())
    reconciler.collect_orphans()
    assert objects(world) == named
    assert world.drive(drive_id).state == "COMMITTED"


def test_retention_of_much(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In short transactions: while one is under way, SQLite lets no worker say that it lives."""
    monkeypatch.setattr(worker.reconciler, "_BATCH", 3)
    drive_ids = [world.add_drive(brief_drive) for _ in range(3)]
    kept = world.add_drive(brief_drive)
    past = now_us() - DAY_US
    with world.database.write() as session:
        for drive_id in drive_ids:
            session.get_one(Drive, drive_id).expires_us = past
        session.query(Job).filter(Job.drive_id.in_(drive_ids)).update({"expires_us": past})
        row = {"project_id": world.project_id, "kind": "RECONSTRUCTION", "state": "FAILED", "expires_us": past}
        session.execute(insert(Job), [{**row, "drive_id": kept} for _ in range(7)])
        row = {"project_id": world.project_id, "drive_id": kept, "name": "s", "fence": 1, "summary": {}}
        session.execute(insert(Scene), [{**row, "job_id": new_id("job"), "expires_us": past} for _ in range(5)])
        session.execute(
            insert(IdempotencyKey),
            [
                {
                    "project_id": world.project_id,
                    "key": str(i),
                    "request_sha256": "0",
                    "holder": "h",
                    "held_until_us": 0,
                    "created_us": past - DAY_US,
                }
                for i in range(7)
            ],
        )
    reconciler = Reconciler(world.settings)
    deleted: list[int] = []
    real = reconciler._database.engine.dialect.do_commit

    def do_commit(connection: Any) -> None:
        cursor = connection.cursor()
        left = (cursor.execute(f"SELECT count(*) FROM {t}").fetchone()[0] for t in ("drives", "jobs", "scenes"))
        deleted.append(sum(left))
        cursor.close()
        real(connection)

    monkeypatch.setattr(reconciler._database.engine.dialect, "do_commit", do_commit)
    reconciler._expire()
    with world.database.read() as session:
        assert [row.id for row in session.query(Drive)] == [kept]
        assert session.query(Scene).count() == session.query(IdempotencyKey).count() == 0
        assert {row.drive_id for row in session.query(Job)} == {kept}
        assert session.query(Job).count() == 1
    assert max(before - after for before, after in pairwise(deleted)) <= 5


def objects(world: World) -> set[str]:
    return {item.key for item in world.artifacts.objects()}


def project_bytes(world: World) -> int:
    with world.database.read() as session:
        return session.get_one(Project, world.project_id).used_bytes
