"""Drives: from the manifest to the commit and the check."""

from __future__ import annotations

import json
import sqlite3
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import insert

from schemas.api.drives import PreflightState
from schemas.api.jobs import JobKind
from schemas.api.resource import Finding
from service.api.manifests import manifest_check
from service.database.tables import Blob, Drive, Job, JobMember, new_id
from service.domain import drives, jobs, maps
from tests.helpers.live_api import Api, Client, problem_of, wait_until
from tests.helpers.sqlite_steps import sqlite_steps
from tests.helpers.tiny_drive import TinyDrive, manifest, tiny_drive
from tests.service.conftest import StartApi

MISSING_ID = "drv_" + "0" * 30


def test_a_new_drive_is_shown_as_its_manifest_says(client: Client) -> None:
    drive = tiny_drive("ring road")
    answer = client.post("/v1/drives", content=drive.raw)
    shown = answer.json()
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/v1/drives/{shown['id']}"
    assert (shown["name"], shown["cameras"], shown["frames"], shown["files_expected"]) == ("ring road", 2, 3, 6)
    assert (shown["state"], shown["preflight"], shown["files_stored"], shown["has_gnss"]) == ("OPEN", "NONE", 0, False)
    assert client.get(answer.headers["location"]).json() == shown
    assert client.get(f"/v1/drives/{shown['id']}/manifest").content == drive.raw


def test_lists_go_page_by_page_newest_first(client: Client) -> None:
    created = [client.create(tiny_drive(f"drive {i}")) for i in range(5)]
    seen, cursor = [], None
    for _ in range(3):
        page = client.get("/v1/drives", params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
        seen += [drive["id"] for drive in page["items"]]
        cursor = page["next"]
    assert seen == created[::-1]
    assert cursor is None


def test_drives_of_one_vehicle(client: Client) -> None:
    """Those of others, of none, and of another project are not listed."""

    def of(vehicle: str | None, name: str) -> TinyDrive:
        drive = tiny_drive(name)
        named = {} if vehicle is None else {"version": 2, "vehicle": vehicle}
        return replace(drive, manifest={**drive.manifest, **named})

    ids = {
        name: client.create(of(vehicle, name))
        for name, vehicle in (("a", "van-7"), ("b", None), ("c", "van-7"), ("d", "van-77"), ("e", "van-7"))
    }
    client.api.client().create(of("van-7", "foreign"))
    assert client.get(f"/v1/drives/{ids['a']}").json()["vehicle"] == "van-7"
    assert client.get(f"/v1/drives/{ids['b']}").json()["vehicle"] is None
    first = client.get("/v1/drives", params={"vehicle": "van-7", "limit": 2}).json()
    assert [drive["id"] for drive in first["items"]] == [ids["e"], ids["c"]]
    rest = client.get("/v1/drives", params={"vehicle": "van-7", "limit": 2, "cursor": first["next"]}).json()
    assert [drive["id"] for drive in rest["items"]] == [ids["a"]]
    assert client.get("/v1/drives", params={"vehicle": "van-8"}).json()["items"] == []
    assert client.get("/v1/drives").json()["items"][-1]["id"] == ids["a"]
    problem = problem_of(client.get("/v1/drives", params={"vehicle": "van 7"}), 422, "invalid-request")
    assert "vehicle" in json.dumps(problem)


@pytest.mark.parametrize("name", ["front left", "größe"])
def test_a_camera_name_that_is_refused_is_told_in_words(client: Client, name: str) -> None:
    document = manifest()
    document["rig"]["cameras"][0]["name"] = name
    problem = problem_of(client.post("/v1/drives", json=document), 422, "invalid-document")
    named = next(error for error in problem["errors"] if error["field"] == "rig.cameras.0.name")
    assert "letters (A-Z, a-z), digits and _ . - without spaces" in named["detail"]
    assert name in named["detail"]
    assert "[A-Z" not in json.dumps(problem)


@pytest.mark.parametrize(
    ("path", "parameter", "words"),
    [
        ("/v1/drives", "vehicle", "letters (A-Z, a-z), digits and _ . : -"),
        ("/v1/jobs", "drive_id", "an id: 1 to 40 lower-case letters"),
        ("/v1/scenes", "drive_id", "an id: 1 to 40 lower-case letters"),
    ],
)
def test_a_parameter_that_is_refused_is_told_in_words(client: Client, path: str, parameter: str, words: str) -> None:
    problem = problem_of(client.get(path, params={parameter: "not one"}), 422, "invalid-request")
    assert problem["errors"][0]["field"] == f"query.{parameter}"
    assert words in problem["errors"][0]["detail"]
    assert "pattern" not in json.dumps(problem)


@pytest.mark.parametrize("cursor", ["", "x", "bnVsbA", "WzEsIlx1ZDgwMCJd", "WzEsIlx1MDAwMCJd", "WzEuNSwiYSJd", "ÿ"])
def test_a_cursor_of_another_making_is_refused(client: Client, cursor: str) -> None:
    problem_of(client.get("/v1/drives", params={"cursor": cursor}), 422, "bad-cursor")


@pytest.mark.parametrize("limit", ["0", "1001", "x", "-1"])
def test_a_limit_out_of_bounds_is_refused(client: Client, limit: str) -> None:
    problem = problem_of(client.get("/v1/drives", params={"limit": limit}), 422, "invalid-request")
    assert problem["errors"][0]["field"] == "query.limit"


def test_a_deleted_drive_is_gone_and_its_scene_stays(client: Client) -> None:
    scene_id = client.scene({"points.ply": b"ply"})
    drive_id = client.get(f"/v1/scenes/{scene_id}").json()["drive_id"]
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    for path in ("", "/files", "/manifest", "/preflight"):
        problem_of(client.get(f"/v1/drives/{drive_id}{path}"), 404, "not-found")
    problem_of(client.delete(f"/v1/drives/{drive_id}"), 404, "not-found")
    assert client.get(f"/v1/scenes/{scene_id}").status_code == 200
    assert client.get(f"/v1/scenes/{scene_id}/files/points.ply").content == b"ply"


def test_a_drive_that_a_job_needs_is_not_deleted(client: Client) -> None:
    drive_id = client.frozen()
    job = client.reconstruct(drive_id)
    problem = problem_of(client.delete(f"/v1/drives/{drive_id}"), 409, "drive-in-use")
    assert job["id"] in problem["detail"]
    client.post(f"/v1/jobs/{job['id']}:cancel")
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204


def test_a_deletion_does_not_read_the_members_of_old_aggregations(api: Api, client: Client) -> None:
    drive_id = client.create()

    def steps_of_check() -> int:
        with sqlite_steps(api.database) as steps, api.database.write() as session:
            maps.require_unused(session, what="it", drive_id=drive_id)
        return steps.count

    before = steps_of_check()
    with api.database.write() as session:
        old = {"project_id": client.project_id, "kind": JobKind.AGGREGATION, "state": "SUCCEEDED", "settings": {}}
        session.execute(insert(Job), [{**old, "id": "job_old"}])
        members = [{"job_id": "job_old", "drive_id": new_id("drv"), "name": str(i)} for i in range(2000)]
        session.execute(insert(JobMember), members)
    assert steps_of_check() < before + 1000, "a member that is read takes several"


def test_deleting_a_drive_cancels_its_check(client: Client) -> None:
    drive_id = client.committed()
    check = client.get(f"/v1/drives/{drive_id}").json()["preflight_job_id"]
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    assert client.get(f"/v1/jobs/{check}").json()["state"] == "CANCELLED"


def test_a_commit_lists_the_missing_files(client: Client) -> None:
    drive = tiny_drive()
    drive_id = client.create(drive)
    first, *rest = sorted(drive.files)
    client.put(f"/v1/drives/{drive_id}/files/{first}", content=drive.files[first])
    problem = problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 409, "drive-incomplete")
    assert [item["field"] for item in problem["errors"]] == rest
    assert "5 of 6 files" in problem["detail"]
    assert client.get(f"/v1/drives/{drive_id}").json()["state"] == "OPEN"


def test_what_is_missing_is_said_before_what_the_manifest_has_wrong(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive_id = client.create()
    monkeypatch.setattr(manifest_check, "_COMMAND", ("/no/such/python",))  # nothing is checked before
    problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 409, "drive-incomplete")


def test_a_manifest_that_the_store_misses(client: Client) -> None:
    drive_id = client.filled()
    with client.api.database.read() as session:
        key = session.get_one(Blob, session.get_one(Drive, drive_id).manifest_blob_id).key
    client.api.context.artifacts.delete([key])
    problem_of(client.get(f"/v1/drives/{drive_id}/manifest"), 503, "store-unavailable")
    problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 503, "store-unavailable")
    manifest = {"drive.json": tiny_drive().raw}
    archive = client.put(f"/v1/drives/{drive_id}/archive", content=tiny_drive().zipped(**manifest))
    problem_of(archive, 503, "store-unavailable")


def test_a_committed_drive_is_frozen(client: Client) -> None:
    drive = tiny_drive()
    drive_id = client.committed(drive)
    path, data = next(iter(drive.files.items()))
    shown = client.get(f"/v1/drives/{drive_id}").json()
    assert (shown["state"], shown["preflight"]) == ("COMMITTED", "PENDING")
    assert shown["committed_at"] is not None
    url = f"/v1/drives/{drive_id}/files/{path}"
    problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 409, "drive-committed")
    problem_of(client.put(url, content=tiny_drive(seed="b").files[path]), 409, "drive-committed")
    problem_of(client.delete(url), 409, "drive-committed")
    problem_of(client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped()), 409, "drive-committed")
    assert client.put(url, content=data).status_code == 200, "sending what is there changes nothing"


def test_two_commits_at_once_make_one_check(client: Client) -> None:
    drive_id = client.filled()
    statuses: list[int] = []

    def commit() -> None:
        statuses.append(client.post(f"/v1/drives/{drive_id}:commit").status_code)

    threads = [threading.Thread(target=commit) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200, 409]
    assert len(client.get("/v1/jobs", params={"drive_id": drive_id}).json()["items"]) == 1


def test_a_commit_while_files_come_takes_all_or_refuses(client: Client) -> None:
    """Whatever the order, a committed drive has every file, and none is taken after the commit."""
    drive = tiny_drive()
    drive_id = client.create(drive)
    stop = threading.Event()
    commits: list[int] = []

    def commit() -> None:
        while not stop.is_set() and 200 not in commits:
            commits.append(client.post(f"/v1/drives/{drive_id}:commit").status_code)

    thread = threading.Thread(target=commit)
    thread.start()
    client.send_files(drive_id, drive)
    stop.set()
    thread.join()
    if 200 not in commits:
        commits.append(client.post(f"/v1/drives/{drive_id}:commit").status_code)
    assert commits[-1] == 200
    assert set(commits[:-1]) <= {409}
    assert client.get(f"/v1/drives/{drive_id}").json()["files_stored"] == 6


def test_a_committed_drive_is_shown_without_its_files_being_counted(api: Api, client: Client) -> None:
    sent = [tiny_drive("short", frames=3, seed="short"), tiny_drive("long", frames=100, seed="long")]
    drive_ids = [client.frozen(drive) for drive in sent]
    steps: list[int] = []
    with api.database.read() as session:
        database = session.connection().connection.driver_connection
        assert isinstance(database, sqlite3.Connection)
        for drive_id in drive_ids:
            done: list[None] = []
            database.set_progress_handler(lambda done=done: done.append(None), 1)
            drives.stored_of(session, [drives.get(session, client.project_id, drive_id)])
            database.set_progress_handler(None, 0)
            steps.append(len(done))
    assert steps[0] == steps[1] > 0
    shown = {drive["id"]: drive for drive in client.get("/v1/drives").json()["items"]}
    for drive_id, drive in zip(drive_ids, sent, strict=True):
        size_bytes = sum(len(data) for data in drive.files.values())
        assert (shown[drive_id]["files_stored"], shown[drive_id]["bytes_stored"]) == (len(drive.files), size_bytes)


def test_what_the_check_of_the_images_finds_is_shown(client: Client) -> None:
    drive_id = client.committed()
    check = client.get(f"/v1/drives/{drive_id}/preflight").json()
    assert (check["state"], check["findings"]) == ("PENDING", [])
    finding = Finding(severity="error", code="blurred", what="all images are blurred", remedy="Clean the lens.")
    others = Finding(severity="error", code="blurred", what="7 more", remedy="Clean it.", count=7)
    warned = Finding(severity="warning", code="dark", what="an image is dark", remedy="Clean the lens.")
    findings = [finding.model_dump(exclude={"count"}), others.model_dump(), warned.model_dump()]  # as older ones are
    with client.api.database.write() as session:
        held = jobs.claim(session, check["job_id"], owner="worker@test", lease_us=60_000_000)
        assert held is not None
        jobs.record_findings(session, held, findings, sound=False)
    (listed,) = client.get("/v1/drives").json()["items"]
    assert (listed["preflight"], listed["preflight_errors"], listed["preflight_warnings"]) == ("REJECTED", 8, 1)
    shown = client.get(f"/v1/drives/{drive_id}/preflight").json()
    told = [one.model_dump() for one in (finding, others, warned)]
    assert shown == {"state": "REJECTED", "job_id": check["job_id"], "findings": told}
    answer = client.post("/v1/reconstructions", json={"drive_id": drive_id})
    problem = problem_of(answer, 422, "drive-rejected")
    assert [Finding.model_validate(one) for one in problem["findings"]] == [finding, others, warned]
    assert problem["detail"] == f"drive {drive_id}: all images are blurred (7 more errors)"
    assert problem["remedy"] == "Clean the lens."


def test_drives_by_the_state_of_their_check(client: Client) -> None:
    still_open, pending, rejected, passed = client.create(), *(client.frozen() for _ in range(3))
    with client.api.database.write() as session:
        session.get_one(Drive, rejected).preflight_state = PreflightState.REJECTED
        session.get_one(Drive, passed).preflight_state = PreflightState.PASSED

    def listed(**query: object) -> list[str]:
        return [drive["id"] for drive in client.get("/v1/drives", params=query).json()["items"]]

    assert listed(preflight="REJECTED") == [rejected]
    assert listed(preflight=["PENDING", "PASSED"]) == [passed, pending]
    assert listed(preflight=["PENDING", "PASSED"], limit=1) == [passed]
    assert listed(preflight="NONE") == [still_open]
    assert listed(preflight="UNKNOWN") == []
    assert len(listed()) == 4
    assert client.get("/v1/drives", params={"preflight": "rejected"}).status_code == 422
    assert client.get("/v1/drives", params={"preflight": ["PASSED"] * 6}).status_code == 422


def test_a_check_that_was_cancelled_leaves_the_drive_usable(client: Client) -> None:
    drive_id = client.committed()
    check = client.get(f"/v1/drives/{drive_id}").json()["preflight_job_id"]
    client.post(f"/v1/jobs/{check}:cancel")
    assert client.get(f"/v1/drives/{drive_id}").json()["preflight"] == "UNKNOWN"
    again = client.post(f"/v1/jobs/{check}:retry").json()
    shown = client.get(f"/v1/drives/{drive_id}").json()
    assert (shown["preflight"], shown["preflight_job_id"]) == ("PENDING", again["id"])


def test_an_open_drive_is_not_reconstructed(client: Client) -> None:
    problem_of(client.post("/v1/reconstructions", json={"drive_id": client.filled()}), 409, "drive-not-committed")
    problem_of(client.post("/v1/reconstructions", json={"drive_id": MISSING_ID}), 404, "not-found")


def test_retention_is_shown_from_the_beginning(start_api: StartApi) -> None:
    client = start_api(drive_retention_days=2).client()
    shown = client.post("/v1/drives", content=tiny_drive().raw).json()
    assert shown["expires_at"][:10] > shown["created_at"][:10]


def test_the_quota_of_drives(api: Api) -> None:
    client = api.client(max_drives=1)
    client.create()
    problem_of(client.post("/v1/drives", content=tiny_drive("b").raw), 429, "too-many-drives")


@pytest.mark.parametrize(
    ("image", "mask", "named"),
    [
        ("drive.json", None, "drive.json"),
        ("drive.json/a.png", None, "drive.json/a.png"),
        ("rear/000000.png/x.png", None, "rear/000000.png/x.png"),
        ("a.png", "drive.json", "drive.json"),
    ],
)
def test_names_that_no_folder_can_hold_are_refused(client: Client, image: str, mask: str | None, named: str) -> None:
    document = manifest()
    document["frames"][0]["images"]["front"] = {"file": image, **({"mask": mask} if mask else {})}
    problem = problem_of(client.post("/v1/drives", json=document), 422, "invalid-document")
    assert problem["errors"][0]["field"] == named
    assert client.get("/v1/drives").json()["items"] == []
    assert client.api.objects(client.project_id) == [], "nothing of it stays"


@pytest.mark.parametrize(("bound", "value"), [("_MEMORY_MB", 1), ("_TIMEOUT_S", 0.05)])
def test_a_manifest_whose_check_costs_too_much_has_to_be_split(
    client: Client, monkeypatch: pytest.MonkeyPatch, bound: str, value: float
) -> None:
    drive = tiny_drive()
    drive_id = client.post("/v1/drives", content=drive.raw + b" " * 3_000_000).json()["id"]
    assert client.put(f"/v1/drives/{drive_id}/archive", content=drive.zipped()).is_success
    monkeypatch.setattr(manifest_check, bound, value)
    problem = problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 422, "manifest-too-large")
    assert "Split the drive" in problem["remedy"]
    assert client.get(f"/v1/drives/{drive_id}").json()["state"] == "OPEN"
    assert client.api.spooled() == []


@pytest.mark.parametrize("command", [("/no/such/python",), (sys.executable, "-c", "raise SystemExit(1)")])
def test_a_check_that_cannot_run_is_the_services_fault(
    client: Client, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    drive_id = client.filled()
    with monkeypatch.context() as broken:
        broken.setattr(manifest_check, "_COMMAND", command)
        problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 503, "check-failed")
    assert client.post(f"/v1/drives/{drive_id}:commit").status_code == 200


def test_the_check_runs_nothing_of_the_working_directory_and_knows_no_secret(
    client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    planted = tmp_path / "mrasfm_engine"
    planted.mkdir()
    (planted / "__init__.py").write_text("raise SystemExit('planted')")
    told = tmp_path / "environment"
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(
        f"import json, os; open({str(told)!r}, 'w').write(json.dumps([os.getcwd(), dict(os.environ)]))"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    for secret in ("MRASFM_DATABASE_URL", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(secret, "secret")
    client.committed()
    where, environment = json.loads(told.read_text())
    assert where == str(client.api.settings.spool_dir)
    assert "secret" not in environment.values()


def test_a_commit_needs_nothing_of_the_engine(client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    (folder / "mrasfm_engine").mkdir(parents=True)
    (folder / "mrasfm_engine" / "__init__.py").write_text("raise ImportError('there is no engine on this machine')")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    drive_id = client.filled(tiny_drive(frames=1))
    problem = problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 422, "drive-rejected")
    assert {finding["code"] for finding in problem["findings"]} >= {"too-few-frames"}
    client.committed()


def test_slow_checks_leave_the_api_to_others(client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """More commits at once than the API has threads."""
    go_on = tmp_path / "go on"
    slow = f"import os, time\nwhile not os.path.exists({str(go_on)!r}): time.sleep(0.05)\nprint('{{\"findings\": []}}')"
    monkeypatch.setattr(manifest_check, "_COMMAND", (sys.executable, "-c", slow))
    drive_id = client.filled()
    statuses: list[int] = []

    def commit() -> None:
        own = client.api.client_of(client.project_id, client.key)
        statuses.append(own.post(f"/v1/drives/{drive_id}:commit").status_code)

    threads = [threading.Thread(target=commit) for _ in range(45)]
    for thread in threads:
        thread.start()
    try:
        wait_until(lambda: client.api.context.commits.places.waiting == 43, "the commits")
        assert client.get(f"/v1/drives/{drive_id}", timeout=20).json()["state"] == "OPEN"
    finally:
        go_on.touch()
        for thread in threads:
            thread.join()
    assert sorted(statuses) == [200] + [409] * 44


def test_a_commit_is_replayed_after_the_drive_is_gone(client: Client) -> None:
    drive_id = client.filled()
    key = {"Idempotency-Key": "commit"}
    first = client.post(f"/v1/drives/{drive_id}:commit", headers=key)
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    again = client.post(f"/v1/drives/{drive_id}:commit", headers=key)
    assert (again.status_code, again.content) == (200, first.content)
    assert again.headers["idempotent-replayed"] == "true"
    problem_of(client.post(f"/v1/drives/{drive_id}:commit"), 404, "not-found")


def test_a_large_manifest_keeps_its_turn_until_it_is_recorded(client: Client) -> None:
    places = client.api.context.large_documents
    raw = tiny_drive().raw + b" " * 2_000_000
    with ThreadPoolExecutor(1) as pool:
        with client.api.database.write():  # the writers' lock: it is parsed and stored, and waits to be recorded
            answer = pool.submit(client.post, "/v1/drives", content=raw)
            wait_until(lambda: len(client.api.objects(client.project_id)) == 1, "the manifest")
            assert places.held == 1
        assert answer.result().status_code == 201
    wait_until(lambda: places.held == 0, "the turn's end")
