"""Reconstructions that wait for their sub-maps, on both databases, and as the API shows them."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import delete, select, update

from schemas.api.aggregations import AggregationRequest
from schemas.api.drives import DriveState
from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.connections import Database
from service.database.tables import Blob, Drive, Job, JobEvent, JobMember, JobState, Project, WorkerSeen, new_id
from service.domain import aggregations, drives, job_trees, jobs, scenes, workers
from service.errors import JobOfTree, TooManyJobs
from tests.helpers.live_api import LIMITS, SUMMARY, Client, problem_of, wait_until
from tests.helpers.tiny_drive import tiny_drive
from tests.service.test_aggregations_at_once import meanwhile
from tests.service.test_job_states import all_at_once, cancel, claim, claimed, expire, job_of, note_of

TOTAL = 3
BROKEN = Problem(type=PROBLEM_TYPE + "no-overlap", title="T", detail="it broke", remedy="Look.", retryable=False)


@pytest.fixture
def drive_id(database: Database, project_id: str) -> str:
    return new_drive(database, project_id)


@pytest.fixture
def parent(database: Database, project_id: str, drive_id: str) -> jobs.Claim:
    """A reconstruction under way."""
    return reconstructing(database, project_id, drive_id)


@pytest.fixture
def submaps(database: Database, parent: jobs.Claim) -> list[str]:
    """The jobs of its sub-maps."""
    return plan(database, parent)


def new_drive(database: Database, project_id: str) -> str:
    with database.write() as session:
        blob = Blob(id=new_id("blb"), project_id=project_id, sha256=new_id("x")[2:], size_bytes=1, key=new_id("k"))
        session.add(blob)
        session.flush()
        drive = Drive(
            id=new_id("drv"), project_id=project_id, name="drive", state=DriveState.COMMITTED, has_gnss=True,
            manifest_blob_id=blob.id, cameras=2, frames=90, files_expected=4,
        )  # fmt: skip
        session.add(drive)
        return drive.id


def reconstructing(database: Database, project_id: str, drive_id: str, **of_tree: Any) -> jobs.Claim:
    with database.write() as session:
        job = jobs.create(
            session, project_id=project_id, kind=JobKind.RECONSTRUCTION, drive_id=drive_id,
            settings={"use_gnss": True}, **of_tree,
        )  # fmt: skip
    return claimed(database, job.id)


def places(*numbers: int) -> list[jobs.SubmapPlace]:
    return [
        jobs.SubmapPlace(number=n, total=TOTAL, first_unit=30 * (n - 1), last_unit=30 * n + 4)
        for n in numbers or range(1, TOTAL + 1)
    ]


def plan(database: Database, held: jobs.Claim, *numbers: int) -> list[str]:
    with database.write() as session:
        return jobs.wait_for_submaps(session, held, places(*numbers))


def finish(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    with database.write() as session:
        jobs.succeed(session, held)


def fail(database: Database, job_id: str) -> None:
    held = claimed(database, job_id)
    with database.write() as session:
        jobs.fail(session, held, BROKEN, limits=LIMITS, retry_delay_us=0)


def due(database: Database) -> set[str]:
    with database.read() as session:
        return {job.id for job in jobs.all_due(session)}


def due_after(database: Database, job_id: str) -> set[str]:
    with database.read() as session:
        return {job.id for job in jobs.due_after(session, job_id)}


def percents(database: Database, job_id: str) -> list[float]:
    with database.read() as session:
        found = session.scalars(select(JobEvent).where(JobEvent.job_id == job_id).order_by(JobEvent.id))
        return [event.data["percent"] for event in found]


def test_a_planned_reconstruction_waits(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """And costs no attempt; then it goes on as a job whose sub-maps are done."""
    waiting = job_of(database, parent.job_id)
    assert (waiting.state, waiting.waiting_for, waiting.blame, waiting.losses) == (JobState.QUEUED, TOTAL, 0, 0)
    assert (waiting.stage, waiting.done, waiting.total) == ("submaps", 0, TOTAL)
    assert due(database) == set(submaps)
    assert claim(database, parent.job_id) is None
    for number, submap in enumerate(submaps, 1):
        job = job_of(database, submap)
        assert (job.kind, job.parent_id, job.is_child) == (JobKind.SUBMAP, parent.job_id, True)
        assert (job.drive_id, job.settings) == (parent.drive_id, parent.settings)
        assert (job.request or {})["number"] == number
        finish(database, submap)
        assert job_of(database, parent.job_id).waiting_for == TOTAL - number
    assert due(database) == {parent.job_id}
    again = claimed(database, parent.job_id)
    assert (again.has_submaps, parent.has_submaps) == (True, False)
    with database.write() as session:
        jobs.heartbeat(session, again, lease_us=60_000_000, note=note_of(50.0))
        scenes.publish(session, again, files={}, summary=SUMMARY, expires_us=None)
    assert job_of(database, parent.job_id).state == JobState.SUCCEEDED
    told = percents(database, parent.job_id)
    assert told == sorted(told)


def test_who_may_begin_after_whom(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """The sub-maps after the plan, and the reconstruction after the last of them; no job of another tree."""
    other = reconstructing(database, parent.project_id, new_drive(database, parent.project_id))
    others = plan(database, other)
    assert due_after(database, parent.job_id) == set(submaps)
    for submap in submaps:
        assert due_after(database, submap) == set()
        finish(database, submap)
    assert due_after(database, submaps[-1]) == {parent.job_id}
    claimed(database, parent.job_id)
    assert due_after(database, submaps[-1]) == set()
    assert due_after(database, other.job_id) == set(others)


def test_progress_of_sub_maps_is_their_parents(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """It does not fall where one begins anew."""
    before = job_of(database, parent.job_id).percent
    held = claimed(database, submaps[0], lease_us=-1_000_000)
    with database.write() as session:
        jobs.heartbeat(session, held, lease_us=-1_000_000, note=note_of(60.0))
    half = job_of(database, parent.job_id).percent
    assert before < half < 75
    assert expire(database) == [submaps[0]]
    claimed(database, submaps[0])
    assert job_of(database, parent.job_id).percent == half
    assert job_of(database, parent.job_id).state == JobState.QUEUED


def test_all_sub_maps_end_at_one_time(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    results = all_at_once(TOTAL, lambda number: finish(database, submaps[number]))
    assert results == [None] * TOTAL
    job = job_of(database, parent.job_id)
    assert (job.waiting_for, job.done) == (0, TOTAL)
    assert due(database) == {parent.job_id}


def test_a_sub_map_ends_while_another_does(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """The second sees that the first has ended, though that was not committed when it began."""
    finish(database, submaps[0])
    first, second = (claimed(database, submap) for submap in submaps[1:])

    def end() -> None:
        with database.write() as session:
            jobs.succeed(session, second)

    with meanwhile(database, end) as (session, begin):
        jobs.succeed(session, first)
        begin()
    assert due(database) == {parent.job_id}


def test_a_sub_map_that_fails(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """Its problem is the reconstruction's, and the others end."""
    running = claimed(database, submaps[0])
    fail(database, submaps[1])
    job = job_of(database, parent.job_id)
    assert (job.state, job.attempt) == (JobState.FAILED, 1)
    assert job.problem is not None
    assert job.problem["type"] == BROKEN.type
    assert job.problem["detail"] == f"sub-map 2 of {TOTAL}: it broke"
    assert job.problem["job_id"] == parent.job_id
    assert sorted(job_trees.end_orphans(database)) == sorted([submaps[0], submaps[2]])
    assert job_of(database, submaps[2]).state == JobState.CANCELLED
    with database.write() as session:
        assert jobs.heartbeat(session, running, lease_us=60_000_000), "its worker is told to stop"
        jobs.cancelled(session, running)
    assert job_of(database, parent.job_id).problem == job.problem


def test_a_retry_maps_what_is_not_finished(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    finish(database, submaps[0])
    fail(database, submaps[1])
    job_trees.end_orphans(database)
    with database.write() as session:
        again = jobs.retry(session, job_of(database, parent.job_id), expires_us=None)
        assert (again.kind, again.parent_id, again.waiting_for) == (JobKind.RECONSTRUCTION, None, 0)
    made = plan(database, claimed(database, again.id), 2, 3)
    assert [(job_of(database, job_id).request or {})["number"] for job_id in made] == [2, 3]
    for job_id in made:
        finish(database, job_id)
    assert due(database) == {again.id}


def test_a_sub_map_is_not_retried_alone(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    fail(database, submaps[1])
    with database.write() as session, pytest.raises(JobOfTree, match=f"{parent.job_id}:retry"):
        jobs.retry(session, job_of(database, submaps[1]), expires_us=None)


def test_a_sub_map_that_is_cancelled(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    """There is no scene without it."""
    cancel(database, submaps[2])
    job = job_of(database, parent.job_id)
    assert job.state == JobState.FAILED
    assert job.problem is not None
    assert job.problem["type"] == PROBLEM_TYPE + "submap-cancelled"
    assert job.problem["detail"] == f"sub-map 3 of {TOTAL} was cancelled, job {submaps[2]}"


def test_the_reconstruction_is_cancelled(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    running = claimed(database, submaps[0])
    finish(database, submaps[1])
    cancel(database, parent.job_id)
    assert job_of(database, parent.job_id).state == JobState.CANCELLED
    job_trees.tend(database)
    assert job_of(database, submaps[2]).state == JobState.CANCELLED
    assert job_of(database, submaps[0]).cancel_requested_us is not None
    with database.write() as session:
        jobs.cancelled(session, running)
    assert job_of(database, parent.job_id).problem is None


def test_cancelled_while_it_was_planned(database: Database, parent: jobs.Claim) -> None:
    cancel(database, parent.job_id)
    assert plan(database, parent) == []
    assert job_of(database, parent.job_id).state == JobState.CANCELLED


def test_a_plan_of_a_lost_worker_makes_nothing(database: Database, project_id: str, drive_id: str) -> None:
    held = reconstructing(database, project_id, drive_id)
    with database.write() as session:
        assert jobs.end_lease(session, held.job_id, held.fence)
    expire(database)
    claimed(database, held.job_id)
    with pytest.raises(jobs.FencedError):
        plan(database, held)
    with database.read() as session:
        assert session.scalars(select(Job).where(Job.kind == JobKind.SUBMAP)).all() == []


@pytest.mark.parametrize("lost", ["told", "records"])
def test_sub_maps_that_ended_untold(database: Database, parent: jobs.Claim, submaps: list[str], lost: str) -> None:
    """The reconciler sees it, also where their records are gone."""
    with database.write() as session:
        mine = Job.id.in_(submaps)
        if lost == "told":
            session.execute(update(Job).where(mine).values(state=JobState.SUCCEEDED, percent=100.0))
        else:
            session.execute(delete(JobEvent).where(JobEvent.job_id.in_(submaps)))
            session.execute(delete(Job).where(mine))
    assert due(database) == set()
    job_trees.tend(database)
    assert due(database) == {parent.job_id}


def test_a_failure_that_was_not_told(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    with database.write() as session:
        described = BROKEN.model_dump(mode="json", exclude_none=True)
        failed = update(Job).where(Job.id == submaps[0]).values(state=JobState.FAILED, problem=described)
        session.execute(failed)
    job_trees.tend(database)
    assert job_of(database, parent.job_id).state == JobState.FAILED
    assert job_of(database, submaps[1]).state == JobState.CANCELLED


def test_tending_leaves_those_that_wait(database: Database, parent: jobs.Claim, submaps: list[str]) -> None:
    job_trees.tend(database)
    job = job_of(database, parent.job_id)
    assert (job.state, job.waiting_for) == (JobState.QUEUED, TOTAL)
    assert due(database) == set(submaps)


def test_sub_maps_do_not_count_against_the_quota(
    database: Database, project_id: str, parent: jobs.Claim, drive_id: str
) -> None:
    with database.write() as session:
        session.get_one(Project, project_id).max_active_jobs = 2
    plan(database, parent)
    reconstructing(database, project_id, drive_id)
    with pytest.raises(TooManyJobs, match="has 2 jobs"):
        reconstructing(database, project_id, drive_id)


@pytest.mark.parametrize("ends", ["well", "badly"])
def test_an_aggregation_waits_for_sub_maps(database: Database, project_id: str, ends: str) -> None:
    """Through the reconstruction between them."""
    ids = [new_drive(database, project_id) for _ in range(2)]
    with database.write() as session:
        asked = AggregationRequest(drives=ids)
        job, children = aggregations.create(session, project_id=project_id, asked=asked, job_expires_us=None)
        first, second = [child.id for child in children]
    made = plan(database, claimed(database, first))
    before = job_of(database, job.id).percent
    held = claimed(database, made[0])
    with database.write() as session:
        jobs.heartbeat(session, held, lease_us=60_000_000, note=note_of(80.0))
    assert job_of(database, job.id).percent > before
    other = claimed(database, second)
    with database.write() as session:
        scenes.publish(session, other, files={}, summary=SUMMARY, expires_us=None)
    assert job_of(database, job.id).waiting_for == 1
    job_trees.tend(database)
    assert due(database) == set(made[1:]), "nothing is ended that is needed"
    if ends == "badly":
        fail(database, made[1])
        ended = job_of(database, job.id)
        assert ended.state == JobState.FAILED
        assert ended.problem is not None
        assert f"sub-map 2 of {TOTAL}: it broke" in ended.problem["detail"]
        with database.read() as session:
            assert any(member.problem for member in session.scalars(select(JobMember)))
        return
    with database.write() as session:
        jobs.succeed(session, held)
    for job_id in made[1:]:
        finish(database, job_id)
    third = claimed(database, first)
    with database.write() as session:
        scenes.publish(session, third, files={}, summary=SUMMARY, expires_us=None)
    assert due(database) == due_after(database, first) == {job.id}
    told = percents(database, job.id)
    assert told == sorted(told)


def test_an_aggregation_may_begin_after_a_sub_map_failed(database: Database, project_id: str) -> None:
    """The failure is its reconstruction's, and the other drives make a map."""
    ids = [new_drive(database, project_id) for _ in range(3)]
    with database.write() as session:
        asked = AggregationRequest(drives=ids)
        job, children = aggregations.create(session, project_id=project_id, asked=asked, job_expires_us=None)
        first, *others = [child.id for child in children]
    made = plan(database, claimed(database, first))
    for other in others:
        held = claimed(database, other)
        with database.write() as session:
            scenes.publish(session, held, files={}, summary=SUMMARY, expires_us=None)
    fail(database, made[0])
    assert due_after(database, made[0]) == {job.id}


def test_cancelling_an_aggregation_ends_all_below(database: Database, project_id: str) -> None:
    ids = [new_drive(database, project_id) for _ in range(2)]
    with database.write() as session:
        asked = AggregationRequest(drives=ids)
        job, children = aggregations.create(session, project_id=project_id, asked=asked, job_expires_us=None)
        first = children[0].id
    made = plan(database, claimed(database, first))
    cancel(database, job.id)
    assert set(made) <= set(job_trees.end_orphans(database))
    with database.read() as session:
        assert set(session.scalars(select(Job.state))) == {JobState.CANCELLED}


def test_a_drive_is_deleted_while_its_last_sub_maps_end(
    database: Database, project_id: str, drive_id: str, parent: jobs.Claim, submaps: list[str]
) -> None:
    running = claimed(database, submaps[0])
    cancel(database, parent.job_id)
    with database.write() as session:
        drives.remove(session, project_id, drive_id)
    assert job_of(database, submaps[1]).state == JobState.CANCELLED
    with database.write() as session:
        assert jobs.cancel_requested(session, running)


def test_processes_that_take_sub_maps(database: Database) -> None:
    with database.write() as session:
        workers.report(session, name="a", queues=["checks", "reconstructions"], concurrency=2)
        workers.report(session, name="b", queues=["reconstructions"], concurrency=3)
        workers.report(session, name="c", queues=["checks"], concurrency=4)
    with database.write() as session:
        assert workers.count_processes(session, "reconstructions") == 5
        session.execute(update(WorkerSeen).where(WorkerSeen.name == "b").values(seen_us=1))
        assert workers.count_processes(session, "reconstructions") == 2


def test_the_api_shows_the_tree(client: Client) -> None:
    drive_id = client.frozen(tiny_drive(seed=client.project_id))
    job_id = client.reconstruct(drive_id)["id"]
    made = plan(client.api.database, client.claim(job_id))
    shown = client.get(f"/v1/jobs/{job_id}")
    job = shown.json()
    assert (job["state"], job["progress"]["stage"], job["progress"]["unit"]) == ("QUEUED", "submaps", "sub-maps")
    assert (job["parent_id"], job["submap"]) == (None, None)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["planned"]
    assert [submap["job_id"] for submap in job["submaps"]] == made
    assert job["submaps"][1] == {
        "number": 2, "job_id": made[1], "first_unit": 30, "last_unit": 64, "state": "QUEUED", "percent": 0.0,
        "problem": None,
    }  # fmt: skip
    submap = client.get(f"/v1/jobs/{made[1]}").json()
    assert (submap["kind"], submap["parent_id"], submap["submap"]) == ("SUBMAP", job_id, 2)
    assert submap["submaps"] == []
    assert set(made) <= {each["id"] for each in client.get("/v1/jobs").json()["items"]}
    fail(client.api.database, made[1])
    changed = client.get(f"/v1/jobs/{job_id}", headers={"If-None-Match": shown.headers["etag"]})
    assert (changed.status_code, changed.json()["submaps"][1]["state"]) == (200, "FAILED")
    problem = problem_of(client.post(f"/v1/jobs/{made[1]}:retry"), 409, "job-of-tree")
    assert job_id in problem["remedy"]
    job_trees.end_orphans(client.api.database)
    ended = client.get(f"/v1/jobs/{job_id}", headers={"If-None-Match": changed.headers["etag"]})
    assert (ended.status_code, ended.json()["submaps"][0]["state"]) == (200, "CANCELLED")
    assert client.post(f"/v1/jobs/{job_id}:retry").json()["retry_of"] == job_id


def test_cancelling_over_http_ends_the_sub_maps(client: Client) -> None:
    job_id = client.reconstruct(client.frozen(tiny_drive(seed=client.project_id)))["id"]
    made = plan(client.api.database, client.claim(job_id))
    assert client.post(f"/v1/jobs/{job_id}:cancel").json()["state"] == "CANCELLED"

    def states() -> list[str]:
        return [client.get(f"/v1/jobs/{submap}").json()["state"] for submap in made]

    wait_until(lambda: states() == ["CANCELLED"] * TOTAL, "the end of its sub-maps")
