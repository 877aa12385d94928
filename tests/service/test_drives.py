"""Drives: from the manifest to the commit and the check."""

from __future__ import annotations

import threading

import pytest

from schemas.api.common import Finding
from service.persistence import jobs
from tests.service.conftest import StartApi
from tests.service.live_api import Api, Client, problem_of
from tests.service.tiny_drive import manifest, tiny_drive

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
    drive_id = client.committed()
    job = client.reconstruct(drive_id)
    problem = problem_of(client.delete(f"/v1/drives/{drive_id}"), 409, "drive-in-use")
    assert job["id"] in problem["detail"]
    client.post(f"/v1/jobs/{job['id']}:cancel")
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204


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


def test_what_the_check_of_the_images_finds_is_shown(client: Client) -> None:
    drive_id = client.committed()
    check = client.get(f"/v1/drives/{drive_id}/preflight").json()
    assert (check["state"], check["findings"]) == ("PENDING", [])
    finding = Finding(severity="error", code="blurred", what="all images are blurred", remedy="Clean the lens.")
    with client.api.database.write() as session:
        held = jobs.claim(session, check["job_id"], owner="worker@test", lease_us=60_000_000)
        assert held is not None
        jobs.record_findings(session, held, [finding.model_dump()], sound=False)
    shown = client.get(f"/v1/drives/{drive_id}/preflight").json()
    assert shown == {"state": "REJECTED", "job_id": check["job_id"], "findings": [finding.model_dump()]}
    answer = client.post("/v1/reconstructions", json={"drive_id": drive_id})
    problem = problem_of(answer, 422, "drive-rejected")
    assert problem["findings"] == [finding.model_dump()]
    assert problem["remedy"] == "Clean the lens."


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
