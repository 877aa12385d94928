"""Maps and their versions: published whole, kept while they are needed, and downloads as of scenes."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest
from sqlalchemy import delete, select, update

from service.database.tables import Blob, Map, MapFile, MapScene, Scene, now_us
from service.domain import jobs, maps
from tests.helpers.live_api import ONE_ATTEMPT, Api, Client, forget_all, problem_of
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi
from tests.service.test_aggregations import BROKEN, FILES, fail, finish, job_of, members

CONTENT = bytes(range(256)) * 40
SHA256 = hashlib.sha256(CONTENT).hexdigest()


def made_drives(client: Client, count: int) -> list[str]:
    return [client.frozen(tiny_drive(f"drive-{i}", seed=f"{client.project_id}{i}")) for i in range(count)]


def new_version(client: Client, files: dict[str, bytes] = FILES, **asked: Any) -> dict[str, Any]:
    """Go the whole way to a version of a map; its job as it ended."""
    job = client.aggregate(**asked)
    for member in job["members"]:
        if member["job_id"] is not None:
            finish(client, member["job_id"])
    client.publish_map(client.claim(job["id"]), files)
    return job_of(client, job["id"])


@pytest.fixture
def drives(client: Client) -> list[str]:
    return made_drives(client, 3)


@pytest.fixture
def map_id(client: Client, drives: list[str]) -> str:
    """A map of the first two drives."""
    return str(new_version(client, drives=drives[:2], name="Straße")["map_id"])


def names(client: Client, map_id: str, version: str = "current") -> list[str]:
    return [scene["name"] for scene in client.get(f"/v1/maps/{map_id}/versions/{version}").json()["scenes"]]


def test_adding_removing_and_going_back(client: Client, drives: list[str], map_id: str) -> None:
    assert new_version(client, map_id=map_id, drives=[drives[2]])["map_version"] == 2
    assert names(client, map_id) == ["drive-0", "drive-1", "drive-2"]
    assert new_version(client, map_id=map_id, remove=[drives[0]])["map_version"] == 3
    assert names(client, map_id) == ["drive-1", "drive-2"]
    assert [names(client, map_id, str(n)) for n in (1, 2)] == [
        ["drive-0", "drive-1"],
        ["drive-0", "drive-1", "drive-2"],
    ]
    listed = client.get(f"/v1/maps/{map_id}/versions", params={"limit": 2}).json()
    assert [version["number"] for version in listed["items"]] == [3, 2]
    rest = client.get(f"/v1/maps/{map_id}/versions", params={"limit": 2, "cursor": listed["next"]}).json()
    assert [(version["number"], version["is_current"]) for version in rest["items"]] == [(1, False)]
    back = client.put(f"/v1/maps/{map_id}/current-version", json={"version": 1})
    assert (back.status_code, back.json()["current_version"]) == (200, 1)
    assert names(client, map_id) == ["drive-0", "drive-1"]
    # The next version goes on from the one that is shown, and is numbered on.
    job = new_version(client, map_id=map_id, drives=[drives[2]], remove=[drives[1]])
    assert job["map_version"] == 4
    assert names(client, map_id) == ["drive-0", "drive-2"]
    problem_of(client.put(f"/v1/maps/{map_id}/current-version", json={"version": 9}), 404, "not-found")
    problem_of(client.put(f"/v1/maps/{map_id}/current-version", json={"version": 0}), 422, "invalid-document")


def test_components_of_a_drive_are_scenes_of_the_version(client: Client, drives: list[str]) -> None:
    """They come and go with their drive, and their files are downloaded by the URL that the version gives."""
    job = client.aggregate(drives=drives[:2], name="tunnel")
    for member in job["members"]:
        finish(client, member["job_id"])
    files = {**FILES, "calibration/drive-0#1.json": CONTENT}
    client.publish_map(client.claim(job["id"]), files, unconnected=("drive-0#1",), components=("drive-0#1",))
    map_id = job_of(client, job["id"])["map_id"]
    version = client.get(f"/v1/maps/{map_id}/versions/current").json()
    assert [(scene["name"], scene["connected"]) for scene in version["scenes"]] == [
        ("drive-0", True),
        ("drive-0#1", False),
        ("drive-1", True),
    ]
    assert len({scene["scene_id"] for scene in version["scenes"]}) == 2
    (file,) = (file for file in version["files"] if "#" in file["path"])
    assert file["url"].endswith("/files/calibration/drive-0%231.json")
    assert client.get(file["url"]).content == CONTENT
    assert new_version(client, map_id=map_id, drives=[drives[2]], remove=[drives[0]])["map_version"] == 2
    assert names(client, map_id) == ["drive-1", "drive-2"]
    left = client.post("/v1/aggregations", json={"map_id": map_id, "remove": [drives[1]]})
    problem_of(left, 422, "too-few-scenes")


def test_a_drive_is_not_named_as_one_whose_component_alone_is_in_the_map(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives[:2])
    for member in job["members"]:
        finish(client, member["job_id"])
    client.publish_map(client.claim(job["id"]), FILES, components=("drive-0#1",))
    map_id = job_of(client, job["id"])["map_id"]
    with client.api.database.write() as session:
        session.execute(delete(MapScene).where(MapScene.map_id == map_id, MapScene.name == "drive-0"))
    namesake = client.frozen(tiny_drive("drive-0", seed=f"{client.project_id} another"))
    added = client.aggregate(map_id=map_id, drives=[namesake])
    assert [member["name"] for member in added["members"]] == ["drive-0-2"]


def test_what_cannot_be_added_or_removed(client: Client, drives: list[str], map_id: str) -> None:
    def refused(status: int, code: str, **asked: Any) -> dict[str, Any]:
        return problem_of(client.post("/v1/aggregations", json={"map_id": map_id, **asked}), status, code)

    refused(422, "drive-twice", drives=[drives[0]])
    again = client.frozen(tiny_drive("again", seed=f"{client.project_id}0"))
    assert "have the same images" in (problem := refused(422, "drive-twice", drives=[again]))["detail"]
    assert "remove scn_" in problem["remedy"]
    refused(422, "not-in-map", remove=[drives[2]])
    refused(422, "removed-twice", drives=[drives[2]], remove=[drives[0], drives[0]])
    refused(422, "too-few-scenes", remove=[drives[0]])
    refused(422, "nothing-to-do")
    scene = client.get(f"/v1/maps/{map_id}").json()["version"]["scenes"][0]["scene_id"]
    refused(422, "removed-twice", drives=[drives[2]], remove=[drives[0], scene])
    job = client.aggregate(map_id=map_id, drives=[drives[2]])
    assert job["id"] in refused(409, "map-busy", remove=[drives[0]])["detail"]
    problem_of(client.put(f"/v1/maps/{map_id}/current-version", json={"version": 1}), 409, "map-busy")
    problem_of(client.delete(f"/v1/maps/{map_id}"), 409, "map-busy")
    assert client.get(f"/v1/maps/{map_id}").json()["job_id"] == job["id"]
    assert client.post(f"/v1/jobs/{job['id']}:cancel").status_code == 202
    assert client.delete(f"/v1/maps/{map_id}").status_code == 204


def test_a_newer_scene_takes_the_place_of_an_older_one(client: Client, drives: list[str], map_id: str) -> None:
    answer = client.post("/v1/reconstructions", json={"drive_id": drives[0], "settings": {"seed": 5}})
    newer = finish(client, answer.json()["id"])
    new_version(client, map_id=map_id, scenes=[newer], remove=[drives[0]])
    scenes = client.get(f"/v1/maps/{map_id}/versions/current").json()["scenes"]
    assert [(scene["name"], scene["drive_id"]) for scene in scenes] == [
        ("drive-0-2", drives[0]),
        ("drive-1", drives[1]),
    ]
    assert scenes[0]["scene_id"] == newer


def test_what_a_map_needs_stays(api: Api, client: Client, drives: list[str], map_id: str) -> None:
    scenes = client.get(f"/v1/maps/{map_id}").json()["version"]["scenes"]
    for path in (f"/v1/scenes/{scenes[0]['scene_id']}", f"/v1/drives/{drives[0]}"):
        detail = problem_of(client.delete(path), 409, "used-by-map")["detail"]
        assert map_id in detail
        assert "'Straße'" in detail
    assert client.delete(f"/v1/drives/{drives[2]}").status_code == 204
    # Retention dates do not take it either, and a map's own takes its scenes' protection away.
    with api.database.write() as session:
        session.execute(update(Scene).where(Scene.project_id == client.project_id).values(expires_us=1))
        maps.forget_expired(session, now_us())
    assert client.get(f"/v1/scenes/{scenes[0]['scene_id']}").status_code == 200
    with api.database.write() as session:
        session.execute(update(Map).where(Map.id == map_id).values(expires_us=1))
        maps.forget_expired(session, now_us())
    assert client.get(f"/v1/maps/{map_id}").status_code == 404
    assert client.get(f"/v1/scenes/{scenes[0]['scene_id']}").status_code == 404
    assert client.delete(f"/v1/drives/{drives[0]}").status_code == 204


def test_a_scene_that_is_being_put_into_a_map_stays(api: Api, client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives[:2])
    for member in job["members"]:
        finish(client, member["job_id"])
    scene_id = members(client, job["id"])[drives[0]]["scene_id"]
    assert job["id"] in problem_of(client.delete(f"/v1/scenes/{scene_id}"), 409, "used-by-job")["detail"]
    problem_of(client.delete(f"/v1/drives/{drives[0]}"), 409, "used-by-job")
    with api.database.write() as session:
        session.execute(update(Scene).where(Scene.id == scene_id).values(expires_us=1))
        maps.forget_expired(session, now_us())
    assert client.get(f"/v1/scenes/{scene_id}").status_code == 200


@pytest.mark.parametrize("end", ["failed", "cancelled"])
def test_a_map_that_nothing_came_of_goes_with_its_job(start_api: StartApi, end: str) -> None:
    """And one that has a version by then does not."""
    client = start_api(job_retention_days=2).client()
    job = client.aggregate(drives=made_drives(client, 2))
    map_id, soon_us = job["map_id"], now_us() + 3 * 86_400 * 1_000_000

    def expires() -> tuple[str | None, str | None]:
        return job_of(client, job["id"])["expires_at"], client.get(f"/v1/maps/{map_id}").json()["expires_at"]

    def expire() -> int:
        with client.api.database.write() as session:
            maps.forget_expired(session, soon_us)
        return client.get(f"/v1/maps/{map_id}").status_code

    of_job, of_map = expires()
    assert of_job == of_map is not None
    assert expire() == 200, "its job is under way"
    if end == "cancelled":
        assert client.post(f"/v1/jobs/{job['id']}:cancel").status_code == 202
    else:
        fail(client, job["members"][0]["job_id"])
        finish(client, job["members"][1]["job_id"])
    assert job_of(client, job["id"])["state"] == end.upper()
    first, job = job, client.post(f"/v1/jobs/{job['id']}:retry").json()
    of_job, of_map = expires()
    assert of_job == of_map > first["expires_at"], "it goes with the last one"
    for member in members(client, job["id"]).values():
        if member["scene_id"] is None:
            finish(client, member["job_id"])
    held = client.claim(job["id"])
    if end == "cancelled":
        client.publish_map(held, FILES)
        assert (expires()[1], expire()) == (None, 200), "it is kept as maps are"
        return
    with client.api.database.write() as session:
        jobs.fail(session, held, BROKEN, limits=ONE_ATTEMPT, retry_delay_us=0)
    assert expire() == 404


def test_deleting_versions(api: Api, client: Client, drives: list[str], map_id: str) -> None:
    new_version(client, {"points.ply": b"second"}, map_id=map_id, drives=[drives[2]], remove=[drives[0]])
    problem_of(client.delete(f"/v1/maps/{map_id}/versions/2"), 409, "version-current")
    problem_of(client.delete(f"/v1/drives/{drives[0]}"), 409, "used-by-map")
    assert client.delete(f"/v1/maps/{map_id}/versions/1").status_code == 204
    problem_of(client.get(f"/v1/maps/{map_id}/versions/1"), 404, "not-found")
    assert client.delete(f"/v1/drives/{drives[0]}").status_code == 204
    assert (
        new_version(client, map_id=map_id, remove=[drives[2]], scenes=scenes_of(client, drives[0]))["map_version"] == 3
    )
    assert client.delete(f"/v1/maps/{map_id}").status_code == 204
    with api.database.read() as session:
        assert session.scalars(select(MapFile).where(MapFile.map_id == map_id)).all() == []
    assert forget_all(api)
    assert not [path for path in api.objects(client.project_id) if path.read_bytes() == b"none of these"]


def test_the_number_of_a_deleted_version_is_not_given_again(client: Client, drives: list[str], map_id: str) -> None:
    assert new_version(client, map_id=map_id, drives=[drives[2]])["map_version"] == 2
    assert client.put(f"/v1/maps/{map_id}/current-version", json={"version": 1}).status_code == 200
    assert client.delete(f"/v1/maps/{map_id}/versions/2").status_code == 204
    assert new_version(client, map_id=map_id, drives=[drives[2]])["map_version"] == 3
    problem_of(client.get(f"/v1/maps/{map_id}/versions/2"), 404, "not-found")


def scenes_of(client: Client, drive_id: str) -> list[str]:
    return [scene["id"] for scene in client.get("/v1/scenes", params={"drive_id": drive_id}).json()["items"]][:1]


def test_files_of_maps_are_not_collected(api: Api, client: Client, drives: list[str]) -> None:
    content = client.project_id.encode()
    found = new_version(client, {"only.bin": content}, drives=drives[:2])["map_id"]
    forget_all(api)
    assert client.get(f"/v1/maps/{found}/versions/1/files/only.bin").content == content
    assert client.delete(f"/v1/maps/{found}").status_code == 204
    with api.database.read() as session:
        sha256 = hashlib.sha256(content).hexdigest()
        key = session.scalar(select(Blob.key).where(Blob.sha256 == sha256))
    assert key in forget_all(api)


def test_downloads(client: Client, drives: list[str]) -> None:
    files = {"points.ply": CONTENT, "calibration/drive-0.json": b"{}", "report.json": b"{}"}
    map_id = new_version(client, files, drives=drives[:2], name="Straße")["map_id"]
    version = client.get(f"/v1/maps/{map_id}/versions/1").json()
    assert [file["path"] for file in version["files"]] == sorted(files)
    for file in version["files"]:
        got = client.get(file["url"])
        assert got.content == files[file["path"]]
        assert got.headers["etag"] == f'"{file["sha256"]}"'
        assert got.headers["repr-digest"].startswith("sha-256=:")
    url = f"/v1/maps/{map_id}/versions/current/files/points.ply"
    part = client.get(url, headers={"Range": "bytes=100-199", "If-Range": f'"{SHA256}"'})
    assert (part.status_code, part.content) == (206, CONTENT[100:200])
    assert part.headers["content-range"] == f"bytes 100-199/{len(CONTENT)}"
    assert client.get(url, headers={"If-None-Match": f'"{SHA256}"'}).status_code == 304
    problem_of(client.get(url, headers={"Range": "bytes=99999-"}), 416, "range-outside")
    head = client.head(url)
    assert (head.status_code, head.headers["content-length"], head.content) == (200, str(len(CONTENT)), b"")
    assert 'filename="Stra-e-1-points.ply"' in head.headers["content-disposition"]
    for missing in (f"{url}x", f"/v1/maps/{map_id}/versions/2/files/points.ply", "/v1/maps/map_0/versions/1/files/a"):
        problem_of(client.get(missing), 404, "not-found")


@pytest.mark.parametrize("version", ["0", "01", "-1", "2", "x", "%00", "1.0", "9" * 30])
def test_versions_that_are_not_there(client: Client, map_id: str, version: str) -> None:
    problem_of(client.get(f"/v1/maps/{map_id}/versions/{version}"), 404, "not-found")


def test_a_publication_of_an_old_holder_is_not_seen(client: Client, drives: list[str]) -> None:
    job = client.aggregate(drives=drives[:2])
    for member in job["members"]:
        finish(client, member["job_id"])
    old = client.claim(job["id"])
    with client.api.database.write() as session:
        jobs.release(session, old)
    new = client.claim(job["id"])
    with pytest.raises(jobs.FencedError):
        client.publish_map(old, {"a": b"old"})
    assert client.get(f"/v1/maps/{job['map_id']}/versions").json()["items"] == []
    assert client.publish_map(new, {"a": b"new"}) == 1
    with pytest.raises(jobs.FencedError):
        client.publish_map(new, {"a": b"again"})
    assert client.get(f"/v1/maps/{job['map_id']}/versions/1/files/a").content == b"new"


def test_maps_of_others(client: Client, map_id: str) -> None:
    stranger = client.api.client()
    for method, path in (
        ("GET", f"/v1/maps/{map_id}"),
        ("DELETE", f"/v1/maps/{map_id}"),
        ("GET", f"/v1/maps/{map_id}/versions"),
        ("GET", f"/v1/maps/{map_id}/versions/1"),
        ("DELETE", f"/v1/maps/{map_id}/versions/1"),
        ("GET", f"/v1/maps/{map_id}/versions/1/files/points.ply"),
    ):
        problem_of(stranger.request(method, path), 404, "not-found")
    problem_of(stranger.put(f"/v1/maps/{map_id}/current-version", json={"version": 1}), 404, "not-found")
    assert stranger.get("/v1/maps").json()["items"] == []
    assert [found["id"] for found in client.get("/v1/maps").json()["items"]] == [map_id]
