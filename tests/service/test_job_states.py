"""The state machine of jobs, on both databases: one holder at a time, and what has ended never changes."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.connections import Database, migrate
from service.database.tables import TERMINAL, Job, JobAttempt, JobEvent, JobState, Scene, now_us
from service.domain import jobs, scenes
from service.domain.keys import create_project
from service.errors import ServiceError
from tests.helpers.live_api import LIMITS, SUMMARY, settings_of

LEASE_US = 60_000_000
EXPIRED_US = -1_000_000  # a lease that ends before it begins
MAX_ATTEMPTS = LIMITS.max_attempts
_WITH_CLOCKS = ("_completion", "_queue", "_queries")  # of their own, besides the database's


def problem(*, retryable: bool) -> Problem:
    return Problem(
        type=PROBLEM_TYPE + "out-of-memory", title="Memory", detail="no memory", remedy="More.", retryable=retryable
    )


@pytest.fixture
def job_id(database: Database, project_id: str) -> str:
    return new_job(database, project_id)


def new_job(database: Database, project_id: str) -> str:
    with database.write() as session:
        job = jobs.create(session, project_id=project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_0")
        return job.id


def claim(database: Database, job_id: str, *, lease_us: int = LEASE_US, owner: str = "w") -> jobs.Claim | None:
    with database.write() as session:
        return jobs.claim(session, job_id, owner=owner, lease_us=lease_us)


def claimed(database: Database, job_id: str, **options: Any) -> jobs.Claim:
    held = claim(database, job_id, **options)
    assert held is not None
    return held


def job_of(database: Database, job_id: str) -> Job:
    with database.read() as session:
        return session.get_one(Job, job_id)


def expire(database: Database) -> list[str]:
    with database.write() as session:
        return jobs.expire_leases(session, limits=LIMITS)


def fail(database: Database, held: jobs.Claim, *, retryable: bool) -> JobState:
    with database.write() as session:
        return jobs.fail(
            session,
            held,
            problem(retryable=retryable),
            limits=LIMITS,
            retry_delay_us=0,
        )


def note_of(percent: float) -> jobs.ProgressNote:
    return jobs.ProgressNote(
        stage="matches", done=1, total=2, unit="pairs", percent=percent, eta_low_s=None, eta_high_s=None
    )


def cancel(database: Database, job_id: str) -> None:
    with database.write() as session:
        jobs.request_cancel(session, job_id)


def publish(database: Database, held: jobs.Claim) -> str:
    with database.write() as session:
        return scenes.publish(session, held, files={}, summary=SUMMARY, expires_us=None)


def all_at_once(count: int, work: Callable[[int], Any]) -> list[Any]:
    """What threads that begin together return, or raise."""
    barrier = threading.Barrier(count)
    results: list[Any] = []

    def run(number: int) -> None:
        barrier.wait()
        try:
            results.append(work(number))
        except Exception as error:
            results.append(error)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def test_one_of_many_workers_gets_the_job(database: Database, job_id: str) -> None:
    got = all_at_once(20, lambda number: claim(database, job_id, owner=f"w{number}"))
    (held,) = (one for one in got if one is not None)
    assert isinstance(held, jobs.Claim), held
    job = job_of(database, job_id)
    assert (job.state, job.fence, job.attempt) == (JobState.RUNNING, 1, 1)
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(JobAttempt)) == 1


def test_many_workers_share_many_jobs(database: Database, project_id: str) -> None:
    waiting = [new_job(database, project_id) for _ in range(10)]
    got = all_at_once(8, lambda number: [job for job in waiting if claim(database, job, owner=f"w{number}")])
    assert sorted(job for taken in got for job in taken) == sorted(waiting)


def test_an_old_holder_writes_nothing(database: Database, job_id: str) -> None:
    old = claimed(database, job_id, lease_us=EXPIRED_US)
    assert expire(database) == [job_id]
    new = claimed(database, job_id)
    assert new.fence > old.fence
    before = job_of(database, job_id)
    actions: list[Callable[[Session], object]] = [
        lambda session: jobs.heartbeat(session, old, lease_us=LEASE_US),
        lambda session: jobs.succeed(session, old),
        lambda session: jobs.fail(session, old, problem(retryable=True), limits=LIMITS, retry_delay_us=0),
        lambda session: jobs.cancelled(session, old),
        lambda session: jobs.release(session, old),
        lambda session: scenes.publish(session, old, files={}, summary=SUMMARY, expires_us=None),
        lambda session: jobs.record_findings(session, old, [], sound=True),
    ]
    for action in actions:
        with pytest.raises(jobs.FencedError), database.write() as session:
            action(session)
    after = job_of(database, job_id)
    assert (after.revision, after.lease_until_us, after.state) == (before.revision, before.lease_until_us, "RUNNING")
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(Scene)) == 0


def test_a_scene_is_published_once_under_a_race(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    results = all_at_once(8, lambda number: publish(database, held))
    (scene_id,) = (result for result in results if isinstance(result, str))
    assert sum(isinstance(result, jobs.FencedError) for result in results) == 7, results
    with database.read() as session:
        assert session.scalars(select(Scene.id)).all() == [scene_id]
        assert session.get_one(Job, job_id).scene_id == scene_id


def test_the_end_is_published_or_cancelled_and_not_both(database: Database, project_id: str) -> None:
    for _ in range(5):
        job_id = new_job(database, project_id)
        held = claimed(database, job_id, lease_us=EXPIRED_US)
        steps: list[Callable[[], Any]] = [
            lambda: publish(database, held),  # noqa: B023 (called at once)
            lambda: cancel(database, job_id),  # noqa: B023
            lambda: expire(database),
        ]
        all_at_once(3, lambda number: steps[number]())  # noqa: B023
        job = job_of(database, job_id)
        with database.read() as session:
            count = session.scalar(select(func.count()).select_from(Scene).where(Scene.job_id == job_id))
        assert count == (1 if job.state == JobState.SUCCEEDED else 0), job.state


def lose(database: Database, job_id: str, *, engine_ran: bool, memory_kills: int | None = None) -> JobState:
    """An attempt whose worker is lost; what of it is known as by `blame_of_loss`."""
    held = claimed(database, job_id)
    with database.write() as session:
        note = dataclasses.replace(note_of(1.0), engine_ran=engine_ran)
        jobs.heartbeat(session, held, lease_us=LEASE_US, note=note)
        assert jobs.end_lease(session, job_id, held.fence, memory_kills=memory_kills)
    assert expire(database) == [job_id]
    assert expire(database) == []
    return JobState(job_of(database, job_id).state)


def tries(database: Database, job_id: str, **known: Any) -> int:
    """How many workers a job outlasts."""
    number = 1
    while lose(database, job_id, **known) == JobState.QUEUED:
        number += 1
    return number


def test_lost_workers_are_no_fault_of_their_job(database: Database, job_id: str) -> None:
    assert tries(database, job_id, engine_ran=True, memory_kills=0) == LIMITS.max_losses
    job = job_of(database, job_id)
    assert (job.state, job.blame, job.attempt) == (JobState.FAILED, 0.0, LIMITS.max_losses)
    assert job.problem is not None
    assert job.problem["type"].endswith("worker-lost")
    assert claim(database, job_id) is None
    with database.read() as session:
        outcomes = session.scalars(select(JobAttempt.outcome).order_by(JobAttempt.fence)).all()
    assert outcomes == ["worker-lost"] * LIMITS.max_losses


@pytest.mark.parametrize(
    ("known", "expected", "problem_type"),
    [
        ({"engine_ran": True, "memory_kills": 2}, LIMITS.max_attempts, "out-of-memory"),
        ({"engine_ran": False, "memory_kills": 1}, LIMITS.max_attempts, "out-of-memory"),
        ({"engine_ran": True}, 2 * LIMITS.max_attempts, "worker-lost"),
        ({"engine_ran": False}, LIMITS.max_losses, "worker-lost"),
    ],
)
def test_what_is_known_of_a_loss_decides(
    database: Database, job_id: str, known: dict[str, Any], expected: int, problem_type: str
) -> None:
    assert tries(database, job_id, **known) == expected
    problem = job_of(database, job_id).problem
    assert problem is not None
    assert problem["type"].endswith(problem_type)


def test_losses_and_failures_are_counted_apart(database: Database, job_id: str) -> None:
    for _ in range(LIMITS.max_losses - 1):
        assert lose(database, job_id, engine_ran=True, memory_kills=0) == JobState.QUEUED
    for _ in range(LIMITS.max_attempts - 1):
        assert fail(database, claimed(database, job_id), retryable=True) == JobState.QUEUED
    job = job_of(database, job_id)
    assert (job.losses, job.blame) == (LIMITS.max_losses - 1, LIMITS.max_attempts - 1)
    assert fail(database, claimed(database, job_id), retryable=True) == JobState.FAILED


def test_losses_are_counted_since_the_last_finished_stage(database: Database, job_id: str) -> None:
    for _ in range(3):
        for _ in range(LIMITS.max_losses - 1):
            assert lose(database, job_id, engine_ran=True, memory_kills=0) == JobState.QUEUED
        held = claimed(database, job_id)
        with database.write() as session:
            jobs.note_finished_stage(session, held)
            jobs.release(session, held)
        with database.write() as session:  # an attempt that is not the job's any more changes nothing
            jobs.note_finished_stage(session, held)
    assert job_of(database, job_id).losses == 0
    assert lose(database, job_id, engine_ran=True, memory_kills=0) == JobState.QUEUED
    with database.write() as session:
        jobs.note_finished_stage(session, held)
    assert job_of(database, job_id).losses == 1


def test_several_reconcilers_take_a_lost_job_once(database: Database, project_id: str) -> None:
    lost = [new_job(database, project_id) for _ in range(5)]
    for job_id in lost:
        claimed(database, job_id, lease_us=EXPIRED_US)
    taken = all_at_once(4, lambda number: expire(database))
    assert sorted(job for some in taken for job in some) == sorted(lost), taken
    assert {job_of(database, job_id).attempt for job_id in lost} == {1}


def test_a_worker_that_is_heard_of_keeps_its_job(database: Database, job_id: str) -> None:
    held = claimed(database, job_id, lease_us=EXPIRED_US)
    with database.write() as session:
        jobs.heartbeat(session, held, lease_us=LEASE_US)
    assert expire(database) == []
    assert job_of(database, job_id).state == JobState.RUNNING


def test_failures_that_may_pass_are_tried_again_and_counted(database: Database, job_id: str) -> None:
    ends = [fail(database, claimed(database, job_id), retryable=True) for _ in range(MAX_ATTEMPTS)]
    assert ends == [JobState.QUEUED] * (MAX_ATTEMPTS - 1) + [JobState.FAILED]
    assert claim(database, job_id) is None


def test_failures_of_the_input_are_final(database: Database, job_id: str) -> None:
    assert fail(database, claimed(database, job_id), retryable=False) == JobState.FAILED
    assert job_of(database, job_id).finished_us is not None


def test_a_worker_that_is_told_to_stop_costs_no_attempt(database: Database, job_id: str) -> None:
    fences = []
    for _ in range(MAX_ATTEMPTS + 2):
        held = claimed(database, job_id)
        fences.append(held.fence)
        assert held.attempt == len(fences), "what was shown is not taken back"
        with database.write() as session:
            jobs.release(session, held)
    assert fences == sorted(set(fences)), "the fencing number rises all the same"
    with database.read() as session:
        rows = session.execute(select(JobAttempt.attempt, JobAttempt.outcome).order_by(JobAttempt.fence)).all()
    assert [tuple(row) for row in rows] == [(number, "released") for number in range(1, len(fences) + 1)]
    ends = [fail(database, claimed(database, job_id), retryable=True) for _ in range(MAX_ATTEMPTS)]
    assert ends == [JobState.QUEUED] * (MAX_ATTEMPTS - 1) + [JobState.FAILED], "all of its retries are left"


def test_progress_is_not_taken_back_when_a_worker_stops(database: Database, job_id: str) -> None:
    """Nor by a note that comes late: per attempt the percent never falls."""
    held = claimed(database, job_id)
    for percent in (60.0, 40.0):
        with database.write() as session:
            jobs.heartbeat(session, held, lease_us=LEASE_US, note=note_of(percent))
    with database.write() as session:
        jobs.release(session, held)
    claimed(database, job_id)
    with database.read() as session:
        told = [(event.data["attempt"], event.data["percent"]) for event in jobs.events_after(session, job_id, 0)]
    assert told == sorted(told)
    assert told[-1] == (2, 0.0)


def test_a_retry_waits_its_time(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    with database.write() as session:
        jobs.fail(
            session,
            held,
            problem(retryable=True),
            limits=LIMITS,
            retry_delay_us=3_600_000_000,
        )
    assert claim(database, job_id) is None
    with database.write() as session:
        assert jobs.due(session) == []
        session.get_one(Job, job_id).not_before_us = now_us()
    with database.read() as session:
        assert [job.id for job in jobs.due(session)] == [job_id]


def test_a_new_attempt_begins_at_nothing(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    note = jobs.ProgressNote(
        stage="matches", done=1, total=2, unit="pairs", percent=50.0, eta_low_s=1.0, eta_high_s=2.0, reused=["a"]
    )
    with database.write() as session:
        jobs.heartbeat(session, held, lease_us=LEASE_US, note=note)
    fail(database, held, retryable=True)
    claimed(database, job_id)
    job = job_of(database, job_id)
    assert (job.percent, job.stage, job.done, job.eta_low_s, job.reused) == (0.0, None, None, None, [])


@pytest.mark.parametrize("lease_us", [LEASE_US, EXPIRED_US])
def test_a_job_that_was_cancelled_while_it_ran_never_runs_again(database: Database, job_id: str, lease_us: int) -> None:
    held = claimed(database, job_id, lease_us=lease_us)
    cancel(database, job_id)
    if lease_us == LEASE_US:
        assert job_of(database, job_id).state == JobState.RUNNING
        with database.write() as session:
            jobs.release(session, held)
    assert job_of(database, job_id).state == JobState.CANCELLED, "no worker is needed for its end"
    assert claim(database, job_id) is None


@pytest.mark.parametrize("how", ["cancelled", "failed", "waits again"])
def test_what_does_not_run_has_no_time_to_go(database: Database, job_id: str, how: str) -> None:
    held = claimed(database, job_id)
    note = dataclasses.replace(note_of(50.0), eta_low_s=60.0, eta_high_s=90.0)
    with database.write() as session:
        jobs.heartbeat(session, held, lease_us=LEASE_US, note=note)
    assert job_of(database, job_id).eta_low_s == 60.0
    if how == "cancelled":
        cancel(database, job_id)
        with database.write() as session:
            jobs.cancelled(session, held)
    else:
        fail(database, held, retryable=how == "waits again")
    job = job_of(database, job_id)
    assert (job.eta_low_s, job.eta_high_s, job.percent) == (None, None, 50.0)


def test_a_lost_worker_of_a_cancelled_job(database: Database, job_id: str) -> None:
    claimed(database, job_id)
    cancel(database, job_id)
    with database.write() as session:
        session.get_one(Job, job_id).lease_until_us = now_us() - 1
    assert expire(database) == [job_id]
    assert job_of(database, job_id).state == JobState.CANCELLED


@pytest.mark.parametrize("retryable", [True, False])
def test_a_cancelled_job_that_fails_ends_as_cancelled(database: Database, job_id: str, retryable: bool) -> None:
    held = claimed(database, job_id)
    cancel(database, job_id)
    assert fail(database, held, retryable=retryable) == JobState.CANCELLED
    job = job_of(database, job_id)
    assert (job.state, job.problem) == (JobState.CANCELLED, None)
    with database.read() as session:
        attempt = session.get_one(JobAttempt, (job_id, held.fence))
    assert attempt.outcome == "out-of-memory", "what happened stays with the attempt"
    assert attempt.problem is not None


def test_a_cancelled_job_that_is_finished_all_the_same_keeps_its_result(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    cancel(database, job_id)
    assert publish(database, held) == job_of(database, job_id).scene_id


def test_machines_whose_clocks_differ(database: Database, job_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reconciler, an API and a worker that are an hour off take no job from a worker that lives."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("its users share a machine")
    held = claimed(database, job_id)
    for off_us in (3_600_000_000, -3_600_000_000):
        for module in _WITH_CLOCKS:
            monkeypatch.setattr(f"service.domain.jobs.{module}.now_us", lambda off_us=off_us: now_us() + off_us)
        monkeypatch.setattr("service.database.connections.now_us", lambda off_us=off_us: now_us() + off_us)
        assert expire(database) == []
        with database.write() as session:
            jobs.heartbeat(session, held, lease_us=LEASE_US)
        assert abs((job_of(database, job_id).lease_until_us or 0) - LEASE_US - now_us()) < LEASE_US // 2
    cancel(database, job_id)
    assert job_of(database, job_id).state == JobState.RUNNING, "its worker lives and is asked to stop"


def test_a_retry_is_due_by_the_database_s_clock(
    database: Database, job_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if database.engine.dialect.name == "sqlite":
        pytest.skip("its users share a machine")
    held = claimed(database, job_id)
    for module in _WITH_CLOCKS:
        monkeypatch.setattr(f"service.domain.jobs.{module}.now_us", lambda: now_us() + 3_600_000_000)
    fail(database, held, retryable=True)
    monkeypatch.undo()
    assert claim(database, job_id) is not None


def test_a_holder_asks_whether_it_is_wanted(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    with database.read() as session:
        assert not jobs.cancel_requested(session, held)
    cancel(database, job_id)
    with database.read() as session:
        assert jobs.cancel_requested(session, held)
    with database.write() as session:
        jobs.cancelled(session, held)
    with pytest.raises(jobs.FencedError), database.read() as session:
        jobs.cancel_requested(session, held)


def test_progress_leaves_one_event(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    ids = []
    for done in range(5):
        note = jobs.ProgressNote(
            stage="a", done=done, total=5, unit=None, percent=float(done), eta_low_s=None, eta_high_s=None
        )
        with database.write() as session:
            jobs.heartbeat(session, held, lease_us=LEASE_US, note=note)
        with database.read() as session:
            ids.append(jobs.events_after(session, job_id, 0)[-1].id)
    with database.read() as session:
        told = jobs.events_after(session, job_id, 0)
        assert [event.kind for event in told] == ["state", "state", "progress"]
        assert told[-1].data["done"] == 4
        assert [event.id for event in jobs.events_after(session, job_id, ids[1])] == ids[-1:], "after one that is gone"


def test_a_reader_sees_one_state(database: Database, job_id: str) -> None:
    with database.read() as session:
        assert session.scalar(select(Job.state).where(Job.id == job_id)) == JobState.QUEUED
        claimed(database, job_id)
        assert session.scalar(select(Job.state).where(Job.id == job_id)) == JobState.QUEUED
    assert job_of(database, job_id).state == JobState.RUNNING
    with database.write() as session:  # its connection has been a reader's
        job = session.get_one(Job, job_id, with_for_update=True)
        other = Database(database.engine.url.render_as_string(hide_password=False), timeout_s=0.1)
        with other.read() as elsewhere:
            assert elsewhere.scalar(select(Job.state).where(Job.id == job_id)) == JobState.RUNNING
        other.close()
        if database.engine.dialect.name == "postgresql":
            assert session.scalar(text("SHOW transaction_isolation")) == "read committed"
        job.stage = "x"


def test_releasing_and_cancelling_at_once_leaves_no_job_behind(database: Database, project_id: str) -> None:
    """Whichever comes first, a job that was asked to end does not wait for a worker."""
    for _ in range(10):
        job_id = new_job(database, project_id)
        held = claimed(database, job_id)

        def release(held: jobs.Claim = held) -> None:
            with database.write() as session:
                jobs.release(session, held)

        steps = [release, lambda job_id=job_id: cancel(database, job_id)]
        assert all_at_once(2, lambda number, steps=steps: steps[number]()) == [None, None]
        assert job_of(database, job_id).state == JobState.CANCELLED


def test_events_of_a_job_are_in_order(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    fail(database, held, retryable=True)
    publish(database, claimed(database, job_id))
    with database.read() as session:
        events = jobs.events_after(session, job_id, 0)
        assert [event.data["state"] for event in events] == ["QUEUED", "RUNNING", "QUEUED", "RUNNING", "SUCCEEDED"]
        assert jobs.events_after(session, job_id, events[2].id) == events[3:]
        assert len(session.scalars(select(JobEvent)).all()) == 5


class Transitions(RuleBasedStateMachine):
    """Whatever is called in whatever order, by holders old and new."""

    database: Database
    project_id: str

    def __init__(self) -> None:
        super().__init__()
        self.job_id = new_job(self.database, self.project_id)
        self.held: list[jobs.Claim] = []
        self.ended: tuple[Any, ...] | None = None
        self.revision = 0
        self.shown = (0, 0.0)

    def _try(self, action: Callable[[Session], Any]) -> Any:
        try:
            with self.database.write() as session:
                return action(session)
        except (jobs.FencedError, ServiceError):
            return None

    def _holder(self, pick: int) -> jobs.Claim | None:
        return self.held[pick % len(self.held)] if self.held else None

    @rule(alive=st.booleans())
    def claim(self, alive: bool) -> None:
        held = claim(self.database, self.job_id, lease_us=LEASE_US if alive else EXPIRED_US)
        if held is not None:
            assert self.ended is None
            assert all(held.fence > old.fence for old in self.held)
            assert held.blame < LIMITS.max_attempts
            self.held.append(held)

    @rule(pick=st.integers(0, 5), what=st.sampled_from(["beat", "succeed", "cancelled", "release", "publish"]))
    def holder(self, pick: int, what: str) -> None:
        held = self._holder(pick)
        if held is not None:
            actions: dict[str, Callable[[Session], Any]] = {
                "beat": lambda s: jobs.heartbeat(s, held, lease_us=LEASE_US),
                "succeed": lambda s: jobs.succeed(s, held),
                "cancelled": lambda s: jobs.cancelled(s, held),
                "release": lambda s: jobs.release(s, held),
                "publish": lambda s: scenes.publish(s, held, files={}, summary=SUMMARY, expires_us=None),
            }
            self._try(actions[what])

    @rule(pick=st.integers(0, 5), percent=st.floats(0.0, 100.0))
    def tell(self, pick: int, percent: float) -> None:
        held = self._holder(pick)
        if held is not None:
            self._try(lambda s: jobs.heartbeat(s, held, lease_us=LEASE_US, note=note_of(percent)))

    @rule(pick=st.integers(0, 5), retryable=st.booleans())
    def fail(self, pick: int, retryable: bool) -> None:
        held = self._holder(pick)
        if held is not None:
            given = problem(retryable=retryable)
            self._try(lambda s: jobs.fail(s, held, given, limits=LIMITS, retry_delay_us=0))

    @rule()
    def cancel(self) -> None:
        self._try(lambda s: jobs.request_cancel(s, self.job_id))

    @rule()
    def expire(self) -> None:
        expire(self.database)

    @rule(pick=st.integers(0, 5), memory_kills=st.sampled_from([None, 0, 1]))
    def found_dead(self, pick: int, memory_kills: int | None) -> None:
        held = self._holder(pick)
        if held is not None:
            self._try(lambda s: jobs.end_lease(s, held.job_id, held.fence, memory_kills=memory_kills))

    @rule(pick=st.integers(0, 5))
    def finished_stage(self, pick: int) -> None:
        held = self._holder(pick)
        if held is not None:
            self._try(lambda s: jobs.note_finished_stage(s, held))

    @invariant()
    def what_has_ended_never_changes(self) -> None:
        with self.database.read() as session:
            job = session.get_one(Job, self.job_id)
            seen = (job.state, job.revision, job.finished_us, job.scene_id, job.attempt, job.problem)
            open_attempts = session.scalars(
                select(JobAttempt.fence).where(JobAttempt.job_id == job.id, JobAttempt.finished_us.is_(None))
            ).all()
            published = session.scalars(select(Scene.id).where(Scene.job_id == job.id)).all()
        assert self.ended is None or seen == self.ended
        assert job.revision >= self.revision
        assert LIMITS.allow(blame=job.blame, losses=job.losses) or job.state == JobState.FAILED
        assert (job.attempt, job.percent) >= self.shown, "neither falls, the percent within an attempt"
        assert open_attempts == ([job.fence] if job.state == JobState.RUNNING else [])
        assert published == ([] if job.scene_id is None else [job.scene_id])
        assert not (job.state == JobState.QUEUED and job.cancel_requested_us), "waits although nobody wants it"
        self.revision = job.revision
        self.shown = (job.attempt, job.percent)
        if job.state in TERMINAL:
            self.ended = seen


@pytest.mark.filterwarnings("default")
def test_no_order_of_events_breaks_a_job(tmp_path: Path) -> None:
    chosen = settings_of(tmp_path)
    migrate(chosen)
    database = Database.from_settings(chosen)
    with database.write() as session:
        project = create_project(session, "test", chosen)
        project.max_active_jobs = 10**6
    machine = type("Machine", (Transitions,), {"database": database, "project_id": project.id})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=30,
            stateful_step_count=20,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
    database.close()
