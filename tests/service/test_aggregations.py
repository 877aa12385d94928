"""Aggregations: what is there is reused, what is not is made first, and the tree of jobs stays in step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, update

from mrasfm_engine.aggregation.load import name_scenes
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.tables import Drive, Job, JobMember, Scene
from service.domain import job_trees, jobs
from service.domain.same_images import drives_of_one_recording
from tests.helpers.executed_statements import statements_of
from tests.helpers.live_api import ONE_ATTEMPT, Api, Client, problem_of, wait_until
from tests.helpers.tiny_drive import tiny_drive

FILES = {"points.ply": b"ply", "map.json": b"{}", "report.json": b"{}"}
LEASE_US = 60_000_000
BROKEN = Problem(type=PROBLEM_TYPE + "no-overlap", title="T", detail="it broke", remedy="Look.", retryable=False)


@pytest.fixture
def drives(client: Client) -> list[str]:
    return [client.frozen(tiny_drive(f"drive-{i}", seed=f"{client.project_id}{i}")) for i in range(3)]


def job_of(client: Client, job_id: str) -> dict[str, Any]:
    return dict(client.get(f"/v1/jobs/{job_id}").json())


def members(client: Client, job_id: str) -> dict[str, dict[str, Any]]:
    return {member["drive_id"]: member for member in job_of(client, job_id)["members"]}


def finish(client: Client, job_id: str) -> str:
    """Do a reconstruction as a worker would; its scene."""
    return client.publish(client.claim(job_id), {"points.ply": job_id.encode()})


def fail(client: Client, job_id: str, problem: Problem = BROKEN) -> None:
    held = client.claim(job_id)
    with client.api.database.write() as session:
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)


def beat(client: Client, held: jobs.Claim, percent: float) -> None:
    note = jobs.ProgressNote(
        stage="matches", done=1, total=2, unit="pairs", percent=percent, eta_low_s=None, eta_high_s=None
    )
    with client.api.database.write() as session:
        jobs.heartbeat(session, held, lease_us=LEASE_US, note=note)


def due(client: Client) -> set[str]:
    with client.api.database.read() as session:
        return {job.id for job in jobs.all_due(session)}


def tend(client: Client) -> None:
    job_trees.tend(client.api.database)


def test_a_tree_of_jobs(client: Client, drives: list[str]) -> None:
    answer = client.post("/v1/aggregations", json={"drives": drives, "name": "Kreuzung", "settings": {"seed": 1}})
    job = answer.json()
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert int(answer.headers["retry-after"]) > 0
    assert (job["kind"], job["state"], job["drive_id"], job["settings"]["seed"]) == ("AGGREGATION", "QUEUED", None, 1)
    assert [member["name"] for member in job["members"]] == ["drive-0", "drive-1", "drive-2"]
    children = {member["drive_id"]: member["job_id"] for member in job["members"]}
    assert set(children) == set(drives)
    assert set(children.values()) <= due(client), "all reconstructions may run at one time"
    assert job["id"] not in due(client)
    with pytest.raises(AssertionError):
        client.claim(job["id"])
    for drive_id in drives:
        assert job["id"] not in due(client)
        finish(client, children[drive_id])
    assert job["id"] in due(client)
    assert client.publish_map(client.claim(job["id"]), FILES) == 1
    shown = job_of(client, job["id"])
    assert (shown["state"], shown["map_version"], shown["progress"]["percent"]) == ("SUCCEEDED", 1, 100.0)
    found = client.get(f"/v1/maps/{shown['map_id']}").json()
    assert (found["name"], found["current_version"], found["job_id"]) == ("Kreuzung", 1, None)
    assert [scene["drive_id"] for scene in found["version"]["scenes"]] == drives


def test_progress_covers_the_tree(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives)
    children = [members(client, job["id"])[drive]["job_id"] for drive in drives]
    seen: list[float] = []

    def look() -> None:
        answer = client.get(f"/v1/jobs/{job['id']}")
        seen.append(answer.json()["progress"]["percent"])

    held = client.claim(children[0])
    for percent in (0.0, 50.0, 90.0):
        beat(client, held, percent)
        look()
    with client.api.database.write() as session:  # its worker is lost, and it begins anew
        jobs.release(session, held)
    look()
    beat(client, client.claim(children[0]), 5.0)
    look()
    with client.api.database.write() as session:
        session.execute(update(Job).where(Job.id == children[0]).values(state="QUEUED", attempt=0))
    for child in children:
        finish(client, child)
        look()
    assert job_of(client, job["id"])["progress"]["stage"] == "reconstructions"
    assert seen[-1] == pytest.approx(80.0)
    parent = client.claim(job["id"])
    look()
    for percent in (0.0, 50.0, 100.0):
        beat(client, parent, percent)
        look()
    assert seen == sorted(seen), "percent never falls"
    assert seen[1] > seen[0] >= 0.0
    assert seen[-2] == pytest.approx(90.0)
    assert 0.0 < seen[2] < 80.0 / 3 + 1.0
    events = [line for line in client.get(f"/v1/jobs/{job['id']}").json()["members"] if line["state"] != "SUCCEEDED"]
    assert events == []


def test_the_etag_covers_the_tree(client: Client, drives: list[str]) -> None:
    """Members change without their aggregation: where one waits again, and after the aggregation has ended."""
    job = client.aggregate(drives=drives)
    child = members(client, job["id"])[drives[0]]["job_id"]

    def etag() -> str:
        return str(client.get(f"/v1/jobs/{job['id']}").headers["etag"])

    held = client.claim(child)
    running = etag()
    assert running == etag()
    with client.api.database.write() as session:
        jobs.release(session, held)
    assert members(client, job["id"])[drives[0]]["state"] == "QUEUED"
    assert etag() != running
    assert client.post(f"/v1/jobs/{job['id']}:cancel").json()["state"] == "CANCELLED"
    tend(client)
    assert members(client, job["id"])[drives[0]]["state"] == "CANCELLED"
    ended = etag()
    assert ended != running
    assert client.get(f"/v1/jobs/{job['id']}", headers={"If-None-Match": ended}).status_code == 304


def test_a_drive_that_fails_does_not_take_the_others_with_it(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives)
    children = {drive: members(client, job["id"])[drive]["job_id"] for drive in drives}
    fail(client, children[drives[1]])
    for drive in (drives[0], drives[2]):
        finish(client, children[drive])
    assert client.publish_map(client.claim(job["id"]), FILES, unconnected=("drive-2",)) == 1
    version = client.get(f"/v1/maps/{job['map_id']}/versions/current").json()
    assert [scene["drive_id"] for scene in version["scenes"]] == [drives[0], drives[2]]
    (failed,) = version["failed"]
    assert (failed["name"], failed["drive_id"], failed["job_id"]) == ("drive-1", drives[1], children[drives[1]])
    assert failed["problem"]["detail"] == "it broke"
    assert version["unconnected"] == ["drive-2"]
    assert members(client, job["id"])[drives[1]]["problem"]["detail"] == "it broke"


def test_all_are_demanded(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives, require_all=True)
    children = {drive: members(client, job["id"])[drive]["job_id"] for drive in drives}
    running = client.claim(children[drives[2]])
    fail(client, children[drives[1]])
    shown = job_of(client, job["id"])
    assert shown["state"] == "FAILED"
    assert shown["problem"]["type"].endswith("drives-failed")
    assert "drive-1" in shown["problem"]["detail"]
    assert shown["problem"]["errors"] == [{"field": "drive-1", "detail": "it broke"}]
    tend(client)
    assert job_of(client, children[drives[0]])["state"] == "CANCELLED", "nobody needs it any more"
    assert job_of(client, children[drives[2]])["cancel_requested"]
    with client.api.database.write() as session:
        jobs.cancelled(session, running)
    assert job_of(client, job["id"])["state"] == "FAILED"


def test_too_few_are_left(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives[:2])
    children = [member["job_id"] for member in job["members"]]
    finish(client, children[0])
    fail(client, children[1])
    shown = job_of(client, job["id"])
    assert (shown["state"], shown["problem"]["type"]) == ("FAILED", PROBLEM_TYPE + "drives-failed")
    assert client.get(f"/v1/maps/{job['map_id']}").json()["current_version"] is None


def test_what_is_there_is_reused(client: Client, drives: list[str]) -> None:
    known = finish(client, client.reconstruct(drives[0])["id"])
    under_way = client.reconstruct(drives[1])["id"]
    other_settings = client.post(
        "/v1/reconstructions", json={"drive_id": drives[2], "settings": {"max_keypoints": 500}}
    ).json()["id"]
    job = client.aggregate(drives=drives)
    found = members(client, job["id"])
    assert (found[drives[0]]["scene_id"], found[drives[0]]["job_id"]) == (known, None)
    assert found[drives[1]]["job_id"] == under_way
    assert found[drives[2]]["job_id"] not in (None, other_settings)
    finish(client, under_way)
    finish(client, found[drives[2]]["job_id"])
    assert job["id"] in due(client)
    again = client.aggregate(drives=drives)
    assert all(member["job_id"] is None for member in again["members"])
    assert again["progress"]["percent"] == 0.0
    assert again["id"] in due(client)
    # A scene of another engine would be made differently now.
    with client.api.database.write() as session:
        scene = session.get_one(Scene, known)
        scene.summary = {**scene.summary, "engine_version": "0.0.1"}
    assert members(client, client.aggregate(drives=drives)["id"])[drives[0]]["job_id"] is not None


def test_scenes_as_they_are(client: Client, drives: list[str]) -> None:
    made = [finish(client, client.reconstruct(drive)["id"]) for drive in drives]
    job = client.aggregate(scenes=made[:2], drives=[drives[2]], settings={"max_keypoints": 999})
    found = members(client, job["id"])
    assert [found[drive]["scene_id"] for drive in drives[:2]] == made[:2]
    assert found[drives[2]]["job_id"] is not None, "of other settings is no scene there"


def test_cancel_stops_all_of_it_but_what_others_asked_for(api: Api, client: Client, drives: list[str]) -> None:
    asked_for = client.reconstruct(drives[0])["id"]
    first = client.aggregate(drives=drives)
    second = client.aggregate(drives=drives[1:])
    children = {drive: member["job_id"] for drive, member in members(client, first["id"]).items()}
    assert children[drives[0]] == asked_for
    assert {m["job_id"] for m in second["members"]} == {children[drives[1]], children[drives[2]]}
    running = client.claim(children[drives[1]])
    assert client.post(f"/v1/jobs/{first['id']}:cancel").json()["state"] == "CANCELLED"
    tend(client)
    assert job_of(client, asked_for)["state"] == "QUEUED"
    assert job_of(client, children[drives[2]])["state"] == "QUEUED", "the second one needs it"
    assert client.post(f"/v1/jobs/{second['id']}:cancel").status_code == 202
    wait_until(lambda: job_of(client, children[drives[2]])["state"] == "CANCELLED", "its children's end")
    wait_until(lambda: job_of(client, children[drives[1]])["cancel_requested"], "the request to the running one")
    assert job_of(client, asked_for)["state"] == "QUEUED"
    with client.api.database.write() as session:
        jobs.cancelled(session, running)
    assert client.post(f"/v1/jobs/{first['id']}:cancel").status_code == 202


def test_retry_goes_on_with_what_is_there(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives, require_all=True, name="again")
    children = {drive: members(client, job["id"])[drive]["job_id"] for drive in drives}
    scene_id = finish(client, children[drives[0]])
    problem_of(client.post(f"/v1/jobs/{job['id']}:retry"), 409, "job-not-failed")
    fail(client, children[drives[1]])
    tend(client)
    answer = client.post(f"/v1/jobs/{job['id']}:retry")
    assert answer.status_code == 202, answer.text
    new = answer.json()
    assert (new["retry_of"], new["map_id"]) == (job["id"], job["map_id"])
    found = members(client, new["id"])
    assert found[drives[0]]["scene_id"] == scene_id
    assert {found[drive]["job_id"] for drive in drives[1:]}.isdisjoint(children.values())
    for drive in drives[1:]:
        finish(client, found[drive]["job_id"])
    assert client.publish_map(client.claim(new["id"]), FILES) == 1


def test_a_child_whose_end_was_not_seen(client: Client, drives: list[str]) -> None:
    """Its record may be deleted by its retention date: the reconciler finds that nothing is left to wait for."""
    job = client.aggregate(drives=drives)
    children = [member["job_id"] for member in job["members"]]
    for child in children[:2]:
        finish(client, child)
    with client.api.database.write() as session:
        session.execute(delete(Job).where(Job.id == children[2]))
    assert job["id"] not in due(client)
    tend(client)
    assert job["id"] in due(client)
    (member,) = [m for m in job_of(client, job["id"])["members"] if m["problem"]]
    assert "is not there any more" in member["problem"]["detail"]


def test_a_rejected_drive(client: Client, drives: list[str]) -> None:
    finding = {"severity": "error", "code": "truncated-image", "what": "an image ends early", "remedy": "Copy it."}
    with client.api.database.write() as session:
        session.execute(
            update(Drive).where(Drive.id == drives[0]).values(preflight_state="REJECTED", findings=[finding])
        )
    refused = client.post("/v1/aggregations", json={"drives": drives, "require_all": True})
    assert problem_of(refused, 422, "drive-rejected")["findings"] == [finding]
    job = client.aggregate(drives=drives)
    found = members(client, job["id"])[drives[0]]
    assert (found["job_id"], found["problem"]["detail"]) == (None, "an image ends early")
    alone = client.aggregate(drives=drives[:2])
    assert members(client, alone["id"])[drives[1]]["job_id"] is not None
    finish(client, members(client, alone["id"])[drives[1]]["job_id"])
    assert job_of(client, alone["id"])["state"] == "FAILED"


def test_refused_requests(client: Client, drives: list[str]) -> None:
    scene_id = finish(client, client.reconstruct(drives[0])["id"])

    def refused(status: int, code: str, **asked: Any) -> dict[str, Any]:
        return problem_of(client.post("/v1/aggregations", json=asked), status, code)

    refused(422, "nothing-to-do")
    refused(422, "too-few-scenes", drives=drives[:1])
    refused(422, "drive-twice", drives=[drives[0], drives[1], drives[0]])
    refused(422, "drive-twice", drives=drives, scenes=[scene_id])
    refused(422, "drive-twice", scenes=[scene_id, scene_id])
    refused(422, "not-in-map", drives=drives, remove=[drives[0]])
    refused(404, "not-found", drives=[*drives, "drv_0"])
    refused(404, "not-found", scenes=["scn_0"], drives=drives)
    refused(404, "not-found", map_id="map_0", drives=drives)
    refused(422, "invalid-document", drives=drives, surprise=1)
    refused(422, "invalid-document", drives=drives, name="a\nb")
    open_drive = client.create(tiny_drive("open", seed="open"))
    problem = refused(409, "drive-not-committed", drives=[*drives, open_drive])
    assert problem["errors"][0]["field"] == open_drive
    stranger = client.api.client()
    problem_of(stranger.post("/v1/aggregations", json={"drives": drives}), 404, "not-found")
    assert client.get("/v1/maps").json()["items"] == [], "a refused request leaves nothing behind"


def test_one_recording_that_was_uploaded_twice(client: Client, drives: list[str]) -> None:
    again = client.frozen(tiny_drive("again", seed=f"{client.project_id}0"))

    def refused(**asked: Any) -> dict[str, Any]:
        return problem_of(client.post("/v1/aggregations", json=asked), 422, "drive-twice")

    problem = refused(drives=[*drives, again])
    assert problem["detail"] == f"drives {drives[0]} (drive-0) and {again} (again) have the same images"
    assert "Name one of them" in problem["remedy"]
    assert client.get("/v1/maps").json()["items"] == []
    scene_id = finish(client, client.reconstruct(drives[0])["id"])
    refused(drives=[drives[1], again], scenes=[scene_id])
    job = client.aggregate(drives=[drives[1], again])
    assert {member["drive_id"] for member in job["members"]} == {drives[1], again}


def test_drives_that_are_in_the_map_already_stay_there(client: Client, drives: list[str]) -> None:
    again = client.frozen(tiny_drive("again", seed=f"{client.project_id}0"))
    with client.api.database.read() as session:
        assert drives_of_one_recording(session, drives[1:], [drives[0], again]) is None
        found = drives_of_one_recording(session, [again], drives)
    assert found is not None
    assert [drive.id for drive in found] == [drives[0], again]


def test_drives_of_the_same_size_are_of_different_recordings(client: Client) -> None:
    files = {name: tiny_drive(seed=f"{client.project_id} {name}") for name in ("a", "b")}
    drives = [client.frozen(drive) for drive in files.values()]
    with client.api.database.write() as session:
        session.execute(update(Drive).where(Drive.id.in_(drives)).values(bytes_stored=1))
        assert drives_of_one_recording(session, drives) is None


def test_the_same_request_twice(client: Client, drives: list[str]) -> None:
    headers = {"Idempotency-Key": "map-1"}
    first = client.post("/v1/aggregations", json={"drives": drives}, headers=headers)
    again = client.post("/v1/aggregations", json={"drives": drives}, headers=headers)
    assert first.json() == again.json()
    assert again.headers["idempotent-replayed"] == "true"
    assert len(client.get("/v1/maps").json()["items"]) == 1
    problem_of(
        client.post("/v1/aggregations", json={"drives": drives[:2]}, headers=headers), 422, "idempotency-key-reused"
    )


def test_the_quota_of_jobs_counts_the_whole_tree(api: Api) -> None:
    client = api.client(max_active_jobs=3)
    drives = [client.frozen(tiny_drive(str(i), seed=f"quota{i}")) for i in range(3)]
    asked = {"drives": drives}

    def refused(status: int, code: str) -> dict[str, Any]:
        answer = client.post("/v1/aggregations", json=asked)
        problem = problem_of(answer, status, code)
        assert ("retry-after" in answer.headers) == (status == 429)
        with api.database.read() as session:
            assert session.query(JobMember).join(Job).filter(Job.project_id == client.project_id).count() == 0
        assert client.get("/v1/maps").json()["items"] == []
        return problem

    problem = refused(422, "aggregation-too-large")
    assert "4 jobs at one time, the project's quota is 3" in problem["detail"]
    assert "at least 1 of the drives first" in problem["remedy"]
    # The remedy helps: what is there and what is under way needs no other job, only its time.
    first, second = (client.reconstruct(drive)["id"] for drive in drives[:2])
    assert "2 jobs queued or running, its quota is 3, and this needs 2 more" in refused(429, "too-many-jobs")["detail"]
    finish(client, first)
    job = client.aggregate(**asked)
    assert [member["job_id"] for member in job["members"]][:2] == [None, second]
    problem_of(client.post("/v1/reconstructions", json={"drive_id": drives[0]}), 429, "too-many-jobs")


def test_active_jobs_are_counted_once_for_the_whole_tree(api: Api, client: Client, drives: list[str]) -> None:
    with statements_of(api.context.database) as statements:
        client.aggregate(drives=drives)
    counts = [each for each in statements if "count(*)" in each and "jobs.project_id" in each]
    assert len(counts) == 1


def test_drives_of_one_name(client: Client) -> None:
    drives = [client.frozen(tiny_drive("Straße 1/2", seed=f"{client.project_id}{i}")) for i in range(3)]
    job = client.aggregate(drives=drives)
    assert [member["name"] for member in job["members"]] == ["Stra-e-1-2", "Stra-e-1-2-2", "Stra-e-1-2-3"]


def test_drives_whose_names_differ_in_case_alone_have_scenes_of_different_names(client: Client) -> None:
    drives = [client.frozen(tiny_drive(name, seed=f"{client.project_id}{name}")) for name in ("Night", "night")]
    given = [member["name"] for member in client.aggregate(drives=drives)["members"]]
    assert given == ["Night", "night-2"]
    assert name_scenes({name: Path(name) for name in given})


def test_names_of_drives_that_no_scene_can_have(client: Client) -> None:
    names = {"_night": "night", "...": "drive", "-_-": "drive-2", "ÄÖ ~ x": "x", "y" * 120: "y" * 80}
    drives = [client.frozen(tiny_drive(name, seed=f"{client.project_id}{name}")) for name in names]
    given = [member["name"] for member in client.aggregate(drives=drives)["members"]]
    assert sorted(given) == sorted(names.values())
    assert name_scenes({name: Path(name) for name in given})
