"""Jobs over HTTP: shown, listed, cancelled, retried, and told about as they go."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from sqlalchemy import insert, inspect, select

from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.api.routes import job_views
from service.database.tables import ApiKey, Job, Project, new_id, now_us
from service.domain import jobs
from service.domain.keys import revoke_key
from tests.helpers.executed_statements import statements_of
from tests.helpers.job_history import job_history
from tests.helpers.live_api import LIMITS, Api, Client, problem_of, wait_until
from tests.helpers.sqlite_steps import sqlite_steps
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

LEASE_US = 60_000_000
BROKEN = Problem(type=PROBLEM_TYPE + "engine-abort", title="Aborted", detail="it", remedy="Look.", retryable=False)


@pytest.fixture(scope="module")
def drive_id(owner: Client) -> str:
    return owner.frozen()


@pytest.fixture(scope="module")
def owner(api: Api) -> Client:
    return api.client()


@pytest.fixture
def job(owner: Client, drive_id: str) -> dict[str, Any]:
    return owner.reconstruct(drive_id)


def note(percent: float, stage: str = "matches") -> jobs.ProgressNote:
    return jobs.ProgressNote(
        stage=stage, done=1, total=2, unit="pairs", percent=percent, eta_low_s=1.0, eta_high_s=2.0, reused=("features",)
    )


def beat(client: Client, held: jobs.Claim, percent: float) -> bool:
    with client.api.database.write() as session:
        return jobs.heartbeat(session, held, lease_us=LEASE_US, note=note(percent))


def fail(client: Client, held: jobs.Claim) -> None:
    with client.api.database.write() as session:
        jobs.fail(session, held, BROKEN, limits=LIMITS, retry_delay_us=0)


def test_a_new_job_waits_and_says_where_to_look(owner: Client, drive_id: str) -> None:
    settings = {"use_gnss": False, "seed": 7}
    answer = owner.post("/v1/reconstructions", json={"drive_id": drive_id, "settings": settings})
    shown = answer.json()
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{shown['id']}"
    assert int(answer.headers["retry-after"]) > 0
    assert (shown["state"], shown["kind"], shown["drive_id"]) == ("QUEUED", "RECONSTRUCTION", drive_id)
    assert shown["settings"] == settings
    assert owner.get(answer.headers["location"]).json() == shown


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"drive_id": "x", "settings": {"seed": -1}},
        {"drive_id": "DRV!"},
        {"drive_id": 5},
        {"drive_id": "x", "other": 1},
        {"drive_id": "x", "settings": {"max_keypoints": 1.5}},
        {"drive_id": "x", "settings": {"use_gnss": "yes"}},
        [],
        None,
    ],
)
def test_a_request_that_makes_no_sense(owner: Client, body: Any) -> None:
    problem = problem_of(owner.post("/v1/reconstructions", json=body), 422, "invalid-document")
    assert problem["errors"]


def test_progress_is_shown_and_polling_costs_nothing_where_nothing_changed(owner: Client, job: dict[str, Any]) -> None:
    url = f"/v1/jobs/{job['id']}"
    first = owner.get(url)
    assert first.headers["retry-after"]
    assert owner.get(url, headers={"If-None-Match": first.headers["etag"]}).status_code == 304
    held = owner.claim(job["id"])
    second = owner.get(url, headers={"If-None-Match": first.headers["etag"]})
    assert (second.status_code, second.json()["state"]) == (200, "RUNNING")
    beat(owner, held, 33.5)
    third = owner.get(url, headers={"If-None-Match": second.headers["etag"]})
    progress = third.json()["progress"]
    assert progress == {
        "stage": "matches",
        "done": 1,
        "total": 2,
        "unit": "pairs",
        "percent": 33.5,
        "eta_low_s": 1.0,
        "eta_high_s": 2.0,
        "reused_stages": ["features"],
    }
    unchanged = owner.get(url, headers={"If-None-Match": f'W/{third.headers["etag"]}, "x"'})
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    in_two_lines = [("If-None-Match", third.headers["etag"]), ("If-None-Match", '"x"')]
    assert owner.get(url, headers=in_two_lines).status_code == 304
    assert owner.get(url, headers=in_two_lines[::-1]).status_code == 304
    assert owner.get(url, headers=in_two_lines[1:] * 2).status_code == 200
    assert third.json()["attempts"][0]["worker"] == "worker@test"


def test_a_silent_job_is_shown_as_stalled(owner: Client, job: dict[str, Any]) -> None:
    owner.claim(job["id"])
    url = f"/v1/jobs/{job['id']}"
    running = owner.get(url)
    with owner.api.database.write() as session:
        session.get_one(Job, job["id"]).heartbeat_us = now_us() - 3_600_000_000
    stalled = owner.get(url, headers={"If-None-Match": running.headers["etag"]})
    assert stalled.json()["state"] == "STALLED"
    assert owner.get("/v1/status").json()["queue"]["stalled"] >= 1


@pytest.mark.parametrize("off_us", [3_600_000_000, -3_600_000_000])
def test_a_job_stalls_by_the_database_s_clock(postgres_api: Api, set_clock: Callable[[int], None], off_us: int) -> None:
    """Not by that of the host that shows it."""
    client = postgres_api.client()
    drive_id = client.frozen(tiny_drive("clock", seed=str(off_us)))
    silent, alive = (client.reconstruct(drive_id, **{"Idempotency-Key": key})["id"] for key in "ab")
    for job_id in (silent, alive):
        client.claim(job_id)
    with postgres_api.database.write() as session:
        session.get_one(Job, silent).heartbeat_us = now_us() - 600_000_000

    def count_stalled() -> int:
        return int(client.get("/v1/status").json()["queue"]["stalled"])

    before = count_stalled()
    set_clock(off_us)
    with statements_of(postgres_api.context.database) as statements:
        states = {job["id"]: job["state"] for job in client.get("/v1/jobs").json()["items"]}
    assert (states[silent], states[alive]) == ("STALLED", "RUNNING")
    assert sum("clock_timestamp" in statement for statement in statements) == 1, "one look at the clock for all jobs"
    counted = count_stalled()
    set_clock(0)
    assert before <= counted <= count_stalled(), "jobs of others may stall meanwhile"


def test_jobs_are_listed_newest_first_and_by_drive(api: Api) -> None:
    client = api.client()
    first, second = client.frozen(), client.frozen()
    made = [client.reconstruct(first)["id"] for _ in range(3)]
    client.reconstruct(second)
    page = client.get("/v1/jobs", params={"drive_id": first, "limit": 2}).json()
    rest = client.get("/v1/jobs", params={"drive_id": first, "limit": 10, "cursor": page["next"]}).json()
    check = client.get(f"/v1/drives/{first}").json()["preflight_job_id"]
    assert [shown["id"] for shown in (*page["items"], *rest["items"])] == [*made[::-1], check]
    assert len(client.get("/v1/jobs").json()["items"]) == 6


def test_jobs_are_listed_by_state_and_kind(api: Api) -> None:
    client = api.client()
    drive_id = client.frozen()
    waits, runs, silent, broken = (
        client.reconstruct(drive_id, **{"Idempotency-Key": key})["id"] for key in ("waits", "runs", "silent", "broken")
    )
    client.claim(runs)
    client.claim(silent)
    with api.database.write() as session:
        session.get_one(Job, silent).heartbeat_us = now_us() - 600_000_000
    fail(client, client.claim(broken))

    def listed(*where: tuple[str, str]) -> list[str]:
        return [shown["id"] for shown in client.get("/v1/jobs", params=[*where]).json()["items"]]

    reconstructions = ("kind", "RECONSTRUCTION")
    assert listed(("state", "FAILED")) == [broken]
    assert listed(("state", "RUNNING"), reconstructions) == [runs], "what is shown as STALLED is not listed as RUNNING"
    assert listed(("state", "STALLED")) == [silent]
    assert listed(("state", "STALLED"), ("state", "RUNNING"), reconstructions) == [silent, runs]
    assert listed(("state", "QUEUED"), ("state", "FAILED"), reconstructions) == [broken, waits]
    assert listed(reconstructions) == [broken, silent, runs, waits]
    assert len(listed(("kind", "PREFLIGHT"))) == 1
    assert listed(("kind", "EXPORT")) == []
    page = client.get("/v1/jobs", params={"kind": "RECONSTRUCTION", "limit": 3}).json()
    assert listed(reconstructions, ("cursor", page["next"])) == [waits]
    assert client.get("/v1/jobs", params={"state": "failed"}).status_code == 422
    assert client.get("/v1/jobs", params=[("kind", "EXPORT")] * 6).status_code == 422


def test_a_page_of_jobs_ends_where_their_members_are_many(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_views, "CHILDREN_OF_PAGE", 10)
    client = api.client()
    made = job_history(client, 0, 4, 4, 0, 4, 11, 12, 0)
    pages: list[list[str]] = []
    members: list[int] = []
    cursor = None
    while len(pages) < 2 or cursor is not None:
        where = {"limit": 6, **({} if cursor is None else {"cursor": cursor})}
        page = client.get("/v1/jobs", params=where).json()
        pages.append([shown["id"] for shown in page["items"] if shown["id"] in made])
        members += [len(shown["members"]) for shown in page["items"] if shown["id"] in made]
        cursor = page["next"]
    assert [len(page) for page in pages[:5]] == [4, 1, 1, 1, 1]
    assert [job_id for page in pages for job_id in page] == made
    assert members == [0, 4, 4, 0, 4, 11, 12, 0]


def test_a_page_of_jobs_reads_no_more_than_it_shows(api: Api) -> None:
    client = api.client()
    job_history(client, *[0] * 20, *[1500] * 3)
    with statements_of(api.context.database) as statements:
        page = client.get("/v1/jobs", params={"limit": 1000}).json()
    assert [len(shown["members"]) for shown in page["items"]] == [*[0] * 20, 1500]
    assert len(statements) < 12, "however many jobs and members there are"
    of_members = [statement for statement in statements if "job_members.name" in statement]
    assert len(of_members) == 1
    assert "jobs.request" not in of_members[0]


def test_cancelling_a_waiting_job_ends_it_with_no_worker(owner: Client, job: dict[str, Any]) -> None:
    url = f"/v1/jobs/{job['id']}"
    answer = owner.post(f"{url}:cancel")
    assert (answer.status_code, answer.json()["state"]) == (202, "CANCELLED")
    assert answer.json()["finished_at"] is not None
    again = owner.post(f"{url}:cancel")
    assert (again.status_code, again.json()["state"]) == (202, "CANCELLED")
    assert "retry-after" not in owner.get(url).headers


def test_cancelling_a_running_job_tells_its_worker(owner: Client, job: dict[str, Any]) -> None:
    held = owner.claim(job["id"])
    assert not beat(owner, held, 1.0)
    answer = owner.post(f"/v1/jobs/{job['id']}:cancel").json()
    assert (answer["state"], answer["cancel_requested"]) == ("RUNNING", True)
    assert beat(owner, held, 2.0)
    with owner.api.database.write() as session:
        jobs.cancelled(session, held)
    assert owner.get(f"/v1/jobs/{job['id']}").json()["state"] == "CANCELLED"


def test_what_has_ended_is_not_cancelled(owner: Client, job: dict[str, Any]) -> None:
    held = owner.claim(job["id"])
    fail(owner, held)
    problem_of(owner.post(f"/v1/jobs/{job['id']}:cancel"), 409, "job-ended")
    shown = owner.get(f"/v1/jobs/{job['id']}").json()
    assert shown["problem"]["type"] == BROKEN.type
    assert shown["attempts"][0]["outcome"] == "engine-abort"


def test_a_failed_job_is_retried_as_a_new_one(owner: Client, job: dict[str, Any], drive_id: str) -> None:
    url = f"/v1/jobs/{job['id']}"
    problem_of(owner.post(f"{url}:retry"), 409, "job-not-failed")
    fail(owner, owner.claim(job["id"]))
    answer = owner.post(f"{url}:retry")
    new = answer.json()
    assert (answer.status_code, new["state"], new["retry_of"]) == (202, "QUEUED", job["id"])
    assert answer.headers["location"] == f"/v1/jobs/{new['id']}"
    assert (new["drive_id"], new["settings"]) == (drive_id, job["settings"])
    assert owner.get(url).json()["state"] == "FAILED"


def test_a_job_whose_drive_is_gone_is_not_retried(owner: Client) -> None:
    drive_id = owner.frozen()
    job = owner.reconstruct(drive_id)
    owner.post(f"/v1/jobs/{job['id']}:cancel")
    owner.delete(f"/v1/drives/{drive_id}")
    problem_of(owner.post(f"/v1/jobs/{job['id']}:retry"), 409, "drive-deleted")


def test_a_job_is_retried_once_at_a_time(owner: Client, job: dict[str, Any]) -> None:
    """Also by the retry of a retry; a request that is repeated under its key gets the retry that it made."""
    url = f"/v1/jobs/{job['id']}:retry"
    fail(owner, owner.claim(job["id"]))
    first = owner.post(url, headers={"Idempotency-Key": "again"}).json()
    assert first["id"] in problem_of(owner.post(url), 409, "retry-active")["detail"]
    assert owner.post(url, headers={"Idempotency-Key": "again"}).json() == first
    fail(owner, owner.claim(first["id"]))
    second = owner.post(f"/v1/jobs/{first['id']}:retry").json()
    assert second["id"] in problem_of(owner.post(url), 409, "retry-active")["detail"]
    owner.post(f"/v1/jobs/{second['id']}:cancel")
    assert owner.post(url).json()["retry_of"] == job["id"]


def test_retries_at_one_time_make_one_job(api: Api, owner: Client, job: dict[str, Any]) -> None:
    fail(owner, owner.claim(job["id"]))
    clients = [api.client_of(owner.project_id, owner.key) for _ in range(4)]
    with ThreadPoolExecutor(len(clients)) as pool:
        answers = list(pool.map(lambda client: client.post(f"/v1/jobs/{job['id']}:retry"), clients))
    assert sorted(answer.status_code for answer in answers) == [202, 409, 409, 409]


def test_a_job_of_a_rejected_drive_is_not_retried(api: Api, owner: Client) -> None:
    drive_id = owner.frozen()
    job = owner.reconstruct(drive_id)
    owner.post(f"/v1/jobs/{job['id']}:cancel")
    held = owner.claim(check_of(owner, drive_id)["preflight_job_id"])
    finding = {"severity": "error", "code": "blurred", "what": "all is blurred", "remedy": "Drive by day."}
    with api.database.write() as session:
        jobs.record_findings(session, held, [finding], sound=False)
    asked_anew = owner.post("/v1/reconstructions", json={"drive_id": drive_id})
    problem = problem_of(owner.post(f"/v1/jobs/{job['id']}:retry"), 422, "drive-rejected")
    assert problem["findings"] == problem_of(asked_anew, 422, "drive-rejected")["findings"] == [finding]
    assert "all is blurred" in problem["detail"]


def test_a_retried_job_is_kept_as_long_as_a_new_one(start_api: StartApi) -> None:
    client = start_api(job_retention_days=1).client()
    job = client.reconstruct(client.frozen())
    client.post(f"/v1/jobs/{job['id']}:cancel")
    with client.api.database.write() as session:
        session.get_one(Job, job["id"]).expires_us = now_us() + 1_000_000
    new = client.post(f"/v1/jobs/{job['id']}:retry").json()
    assert new["expires_at"][:10] > new["created_at"][:10]


def test_the_quota_of_jobs(api: Api) -> None:
    client = api.client(max_active_jobs=1)
    drive_id = client.frozen()
    job = client.reconstruct(drive_id)
    answer = client.post("/v1/reconstructions", json={"drive_id": drive_id})
    problem_of(answer, 429, "too-many-jobs")
    assert int(answer.headers["retry-after"]) > 0
    client.post(f"/v1/jobs/{job['id']}:cancel")
    client.reconstruct(drive_id)
    problem_of(client.post(f"/v1/jobs/{job['id']}:retry"), 429, "too-many-jobs")


def test_a_heartbeat_changes_nothing_that_an_index_has(postgres_api: Api) -> None:
    """Else PostgreSQL writes to all indexes of the table each second of each running job, and has to vacuum them."""
    client, database = postgres_api.client(), postgres_api.database
    job_id = client.reconstruct(client.frozen())["id"]
    with database.write() as session:
        held = jobs.claim(session, job_id, owner="w", lease_us=LEASE_US)
        assert held is not None
        row = select(*Job.__table__.columns).where(Job.id == job_id)
        before = session.execute(row).one()._mapping
        jobs.heartbeat(session, held, lease_us=LEASE_US + 1, note=note(10.0))
        after = session.execute(row).one()._mapping
    changed = {name for name in after if after[name] != before[name]}
    indexed = {name for index in inspect(database.engine).get_indexes("jobs") for name in index["column_names"]}
    assert {"lease_until_us", "percent", "revision"} <= changed
    assert changed & indexed == set()


def test_the_quota_of_jobs_is_counted_without_thejob_history(api: Api) -> None:
    client = api.client()
    with sqlite_steps(api.database) as new, api.database.write() as session:
        jobs.require_places(session, client.project_id, 1)
    with api.database.write() as session:
        old = {"project_id": client.project_id, "kind": JobKind.RECONSTRUCTION, "state": "SUCCEEDED"}
        session.execute(insert(Job), [{**old, "id": new_id("job"), "settings": {}} for _ in range(2000)])
    with sqlite_steps(api.database) as later, api.database.write() as session:
        jobs.require_places(session, client.project_id, 1)
    assert later.count < new.count + 500, "a job of the history takes ten or more"


def test_a_project_without_space_gets_no_jobs(api: Api) -> None:
    """What jobs make may exceed the quota: so none begins where it is used up."""
    client = api.client(max_active_jobs=2)
    drive_id = client.frozen()
    job = client.reconstruct(drive_id)
    client.post(f"/v1/jobs/{job['id']}:cancel")
    with client.api.database.write() as session:
        project = session.get_one(Project, session.get_one(Job, job["id"]).project_id)
        project.max_bytes = project.used_bytes
    problem_of(client.post("/v1/reconstructions", json={"drive_id": drive_id}), 413, "quota-full")
    problem_of(client.post(f"/v1/jobs/{job['id']}:retry"), 413, "quota-full")
    with client.api.database.write() as session:
        session.get_one(Project, project.id).max_bytes += 1
    client.reconstruct(drive_id)


def check_of(client: Client, drive_id: str) -> dict[str, Any]:
    shown: dict[str, Any] = client.get(f"/v1/drives/{drive_id}").json()
    return shown


def test_a_drive_has_one_check_at_a_time(api: Api) -> None:
    client = api.client(max_active_jobs=1)
    drive_id = client.frozen()
    first = check_of(client, drive_id)["preflight_job_id"]
    client.post(f"/v1/jobs/{first}:cancel")
    statuses: list[int] = []

    def retry() -> None:
        own = api.client_of(client.project_id, client.key)
        statuses.append(own.post(f"/v1/jobs/{first}:retry").status_code)

    threads = [threading.Thread(target=retry) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [202, 409, 409, 409]
    again = problem_of(client.post(f"/v1/jobs/{first}:retry"), 409, "check-active")
    second = check_of(client, drive_id)["preflight_job_id"]
    assert second in again["detail"]
    client.post(f"/v1/jobs/{second}:cancel")
    assert client.post(f"/v1/jobs/{first}:retry").status_code == 202


@pytest.mark.parametrize(("sound", "result"), [(True, "PASSED"), (False, "REJECTED")])
def test_a_drive_that_was_checked_is_not_checked_again(api: Api, sound: bool, result: str) -> None:
    client = api.client()
    drive_id = client.frozen()
    first = check_of(client, drive_id)["preflight_job_id"]
    client.post(f"/v1/jobs/{first}:cancel")
    second = client.post(f"/v1/jobs/{first}:retry").json()["id"]
    held = client.claim(second)
    with api.database.write() as session:
        jobs.record_findings(session, held, [], sound=sound)
    problem = problem_of(client.post(f"/v1/jobs/{first}:retry"), 409, "check-active")
    assert result in problem["detail"]


def test_the_last_place_is_taken_once(api: Api) -> None:
    client = api.client(max_active_jobs=1)
    drive_id = client.frozen()
    statuses: list[int] = []

    def ask() -> None:
        own = api.client_of(client.project_id, client.key)
        statuses.append(own.post("/v1/reconstructions", json={"drive_id": drive_id}).status_code)

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [202] + [429] * 7


def events_of(answer: httpx.Response) -> Iterator[dict[str, Any]]:
    """Server-sent events, as a browser reads them; comments are left out."""
    event: dict[str, Any] = {}
    for line in answer.iter_lines():
        if line == "" and event:
            yield event
            event = {}
        elif line and not line.startswith(":"):
            name, _, value = line.partition(": ")
            event[name] = json.loads(value) if name == "data" else value


def read_all(client: Client, job_id: str, **headers: str) -> list[dict[str, Any]]:
    with client.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        return list(events_of(answer))


def test_events_tell_the_whole_story_and_go_on_where_a_reader_stopped(owner: Client, job: dict[str, Any]) -> None:
    held = owner.claim(job["id"])
    for percent in (10.0, 20.0):
        beat(owner, held, percent)
    scene_id = owner.publish(held, {"a": b"a"})
    events = read_all(owner, job["id"])
    assert [(e["event"], e["data"].get("state"), e["data"]["percent"]) for e in events] == [
        ("state", "QUEUED", 0.0),
        ("state", "RUNNING", 0.0),
        ("progress", None, 20.0),
        ("state", "SUCCEEDED", 100.0),
    ]
    assert events[-1]["data"]["scene_id"] == scene_id
    ids = [int(event["id"]) for event in events]
    assert ids == sorted(set(ids))
    for i, seen in enumerate(events):
        assert read_all(owner, job["id"], **{"Last-Event-ID": seen["id"]}) == events[i + 1 :]


def test_a_reader_goes_on_after_progress_that_is_not_kept(owner: Client, job: dict[str, Any]) -> None:
    held = owner.claim(job["id"])
    beat(owner, held, 10.0)
    with owner.api.database.read() as session:
        last = jobs.events_after(session, job["id"], 0)[-1].id
    beat(owner, held, 20.0)
    owner.publish(held, {"a": b"a"})
    events = read_all(owner, job["id"], **{"Last-Event-ID": str(last)})
    assert [(e["event"], e["data"]["percent"]) for e in events] == [("progress", 20.0), ("state", 100.0)]


def test_events_come_as_they_happen(owner: Client, job: dict[str, Any]) -> None:
    seen: list[dict[str, Any]] = []

    def read() -> None:
        reader = owner.api.client_of(owner.project_id, owner.key)
        with reader.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
            for event in events_of(answer):
                seen.append(event)

    thread = threading.Thread(target=read)
    thread.start()
    wait_until(lambda: len(seen) == 1, "the first event")
    held = owner.claim(job["id"])
    wait_until(lambda: len(seen) == 2, "the claim's event")
    owner.post(f"/v1/jobs/{job['id']}:cancel")
    wait_until(lambda: len(seen) == 3, "the request's event")
    assert thread.is_alive(), "the stream goes on while the job runs"
    with owner.api.database.write() as session:
        jobs.cancelled(session, held)
    thread.join(30)
    assert not thread.is_alive(), "the stream ends with the job"
    assert [event["data"]["state"] for event in seen] == ["QUEUED", "RUNNING", "RUNNING", "CANCELLED"]
    assert seen[2]["data"]["cancel_requested"] is True


def test_events_end_with_the_key(api: Api) -> None:
    client = api.client()
    job = client.reconstruct(client.frozen())
    with client.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
        lines = answer.iter_lines()
        assert any("QUEUED" in line for line in lines)
        with api.database.write() as session:
            (key,) = session.query(ApiKey).filter_by(project_id=client.project_id)
            assert revoke_key(session, key.id)
        began_s = time.monotonic()
        for _ in lines:
            assert time.monotonic() - began_s < 10, "keys are remembered for 3 s"
    with api.database.read() as session:
        assert session.get_one(Job, job["id"]).state == "QUEUED"


@pytest.mark.parametrize("last", ["x", "-1", "1.5", "99999999999999999999"])
def test_an_event_id_of_another_making(owner: Client, job: dict[str, Any], last: str) -> None:
    answer = owner.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": last})
    problem_of(answer, 422, "invalid-request")


def test_events_of_no_job(owner: Client) -> None:
    problem_of(owner.get("/v1/jobs/job_0/events"), 404, "not-found")
