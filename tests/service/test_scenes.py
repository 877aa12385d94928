"""Scenes and their downloads."""

from __future__ import annotations

import base64
import hashlib

import httpx
import pytest

from service.domain import jobs
from tests.helpers.live_api import Api, Client, problem_of
from tests.helpers.tiny_drive import tiny_drive

CONTENT = bytes(range(256)) * 40
SHA256 = hashlib.sha256(CONTENT).hexdigest()
FILES = {"points.ply": CONTENT, "model/cameras.txt": b"# cameras\n", "report.json": b"{}", "empty.bin": b""}


@pytest.fixture(scope="module")
def owner(api: Api) -> Client:
    return api.client()


@pytest.fixture(scope="module")
def scene_id(owner: Client) -> str:
    return owner.scene(FILES, tiny_drive("Straße nach Köln"))


@pytest.fixture(scope="module")
def url(scene_id: str) -> str:
    return f"/v1/scenes/{scene_id}/files/points.ply"


def test_a_scene_names_its_files(owner: Client, scene_id: str) -> None:
    shown = owner.get(f"/v1/scenes/{scene_id}").json()
    files = {file["path"]: file for file in shown["files"]}
    assert sorted(files) == sorted(FILES)
    assert shown["name"] == "Straße nach Köln"
    assert shown["summary"]["points"] == 7
    for path, file in files.items():
        downloaded = owner.get(file["url"])
        assert downloaded.content == FILES[path]
        assert downloaded.headers["content-type"] == file["media_type"]
        assert hashlib.sha256(downloaded.content).hexdigest() == file["sha256"]
        assert len(downloaded.content) == file["size_bytes"]
    job = owner.get(f"/v1/jobs/{shown['job_id']}").json()
    assert (job["state"], job["scene_id"], job["progress"]["percent"]) == ("SUCCEEDED", scene_id, 100.0)


def test_files_for_other_programs_say_what_they_are(owner: Client) -> None:
    kinds = {
        "points.copc.laz": "application/vnd.laszip",
        "trajectory.gpkg": "application/geopackage+sqlite3",
        "rig/rig.urdf": "application/xml",
        "rig/camera_info/front.yaml": "application/yaml",
        "autoware/pointcloud_map.pcd": "application/octet-stream",
        "pictures/road.tif": "image/tiff",
    }
    shown = owner.get(f"/v1/scenes/{owner.scene(dict.fromkeys(kinds, CONTENT))}").json()
    assert {file["path"]: file["media_type"] for file in shown["files"]} == kinds
    for file in shown["files"]:
        downloaded = owner.get(file["url"], headers={"Range": "bytes=375-588"})
        assert downloaded.status_code == 206
        assert downloaded.content == CONTENT[375:589]
        assert downloaded.headers["content-type"] == file["media_type"]
        assert downloaded.headers["content-disposition"].startswith("attachment")


def test_a_whole_download_says_what_it_is(owner: Client, url: str) -> None:
    answer = owner.get(url)
    assert answer.status_code == 200
    assert answer.headers["etag"] == f'"{SHA256}"'
    assert answer.headers["repr-digest"] == f"sha-256=:{base64.b64encode(bytes.fromhex(SHA256)).decode()}:"
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["content-disposition"] == (
        'attachment; filename="Stra-e-nach-K-ln-points.ply"; '
        "filename*=UTF-8''Stra%C3%9Fe%20nach%20K%C3%B6ln-points.ply"
    )


def test_a_head_has_the_headers_of_the_download(owner: Client, url: str) -> None:
    got, head = owner.get(url), owner.head(url)
    assert (head.status_code, head.content) == (200, b"")
    ignored = {"date", "x-request-id"}
    assert {k: v for k, v in head.headers.items() if k not in ignored} == {
        k: v for k, v in got.headers.items() if k not in ignored
    }


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=0-99", 0, 100),
        ("bytes=100-199", 100, 200),
        ("bytes=10000-", 10_000, len(CONTENT)),
        ("bytes=-1", len(CONTENT) - 1, len(CONTENT)),
        ("bytes=-999999", 0, len(CONTENT)),
        ("bytes=10239-999999", 10_239, len(CONTENT)),
        ("Bytes = 5 - 9", 5, 10),
    ],
)
def test_a_range(owner: Client, url: str, asked: str, start: int, stop: int) -> None:
    answer = owner.get(url, headers={"Range": asked})
    assert answer.status_code == 206
    assert answer.content == CONTENT[start:stop]
    assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(CONTENT)}"
    assert answer.headers["content-length"] == str(stop - start)
    assert answer.headers["etag"] == f'"{SHA256}"'


@pytest.mark.parametrize("asked", ["bytes=10240-", "bytes=99999-100000", "bytes=-0"])
def test_a_range_outside_the_file(owner: Client, url: str, asked: str) -> None:
    answer = owner.get(url, headers={"Range": asked})
    problem_of(answer, 416, "range-outside")
    assert answer.headers["content-range"] == f"bytes */{len(CONTENT)}"


@pytest.mark.parametrize(
    "given",
    [
        [f'"{SHA256}"'],
        ["*"],
        [f'"other", "{SHA256}"'],
        ['"other", W/"x"', f'"{SHA256}"'],
        [f'"with, comma","{SHA256}"'],
    ],
)
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_if_match_of_the_version_there_is(owner: Client, url: str, method: str, given: list[str]) -> None:
    headers = httpx.Headers([*(("If-Match", line) for line in given), ("Range", "bytes=0-9")])
    assert owner.request(method, url, headers=headers).status_code == (206 if method == "GET" else 200)


@pytest.mark.parametrize(
    "given",
    [['"other"'], [f'W/"{SHA256}"'], [SHA256], [""], ['"other"', 'W/"x", "y"'], [f'"{SHA256}x"'], [f'"a {SHA256}"']],
)
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_if_match_of_another_version(owner: Client, url: str, method: str, given: list[str]) -> None:
    """It comes before If-None-Match and Range, which would answer 304 and 416."""
    rest = [("If-None-Match", f'"{SHA256}"'), ("Range", "bytes=99999-")]
    answer = owner.request(method, url, headers=httpx.Headers([*(("If-Match", line) for line in given), *rest]))
    assert (answer.status_code, answer.headers["etag"]) == (412, f'"{SHA256}"')
    if method == "GET":
        problem_of(answer, 412, "precondition-failed")


def test_if_none_match_comes_after_if_match_and_before_the_range(owner: Client, url: str) -> None:
    headers = {"If-Match": f'"{SHA256}"', "If-None-Match": f'"{SHA256}"', "Range": "bytes=99999-"}
    assert owner.get(url, headers=headers).status_code == 304


@pytest.mark.parametrize(
    "asked", ["bytes=0-1,5-6", "bytes=", "bytes=-", "lines=0-1", "bytes=9-5", "bytes=a-b", "x", "bytes=0-1-2"]
)
def test_ranges_that_are_not_served_are_ignored(owner: Client, url: str, asked: str) -> None:
    answer = owner.get(url, headers={"Range": asked})
    assert (answer.status_code, answer.content) == (200, CONTENT)


@pytest.mark.parametrize(
    ("condition", "status"),
    [
        (f'"{SHA256}"', 206),
        (f'W/"{SHA256}"', 200),
        ('"other"', 200),
        ("Wed, 21 Oct 2026 07:28:00 GMT", 200),
    ],
)
def test_a_range_only_of_the_same_file(owner: Client, url: str, condition: str, status: int) -> None:
    answer = owner.get(url, headers={"Range": "bytes=1-2", "If-Range": condition})
    assert answer.status_code == status
    assert answer.content == (CONTENT[1:3] if status == 206 else CONTENT)


@pytest.mark.parametrize("tags", ['"{}"', 'W/"{}"', '"x", "{}"', "*"])
def test_a_version_that_the_client_has(owner: Client, url: str, tags: str) -> None:
    for ask in (owner.get, owner.head):
        answer = ask(url, headers={"If-None-Match": tags.format(SHA256), "Range": "bytes=0-1"})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["etag"] == f'"{SHA256}"'
    assert owner.get(url, headers={"If-None-Match": '"other"'}).status_code == 200


def test_an_empty_file(owner: Client, scene_id: str) -> None:
    answer = owner.get(f"/v1/scenes/{scene_id}/files/empty.bin")
    assert (answer.status_code, answer.content, answer.headers["content-length"]) == (200, b"", "0")


@pytest.mark.parametrize("path", ["no.ply", "POINTS.PLY", "points.ply/", "%00", "..%2Fpoints.ply", "model"])
def test_files_that_are_not_there(owner: Client, scene_id: str, path: str) -> None:
    problem_of(owner.get(f"/v1/scenes/{scene_id}/files/{path}"), 404, "not-found")
    assert owner.head(f"/v1/scenes/{scene_id}/files/{path}").status_code == 404


def test_a_download_goes_on_while_the_scene_is_deleted(api: Api) -> None:
    client = api.client()
    content = b"x" * 20_000_000
    scene_id = client.scene({"large.bin": content})
    with client.stream("GET", f"/v1/scenes/{scene_id}/files/large.bin") as answer:
        pieces = answer.iter_bytes(1000)
        received = len(next(pieces))
        assert api.anonymous(Authorization=f"Bearer {client.key}").delete(f"/v1/scenes/{scene_id}").status_code == 204
        received += sum(len(piece) for piece in pieces)
    assert received == len(content)
    problem_of(client.get(f"/v1/scenes/{scene_id}/files/large.bin"), 404, "not-found")
    problem_of(client.delete(f"/v1/scenes/{scene_id}"), 404, "not-found")


def test_scenes_are_listed_newest_first(api: Api) -> None:
    client = api.client()
    drive_id = client.frozen()
    made = [client.publish(client.claim(client.reconstruct(drive_id)["id"]), {"a": b"a"}) for _ in range(3)]
    first = client.get("/v1/scenes", params={"limit": 2, "drive_id": drive_id}).json()
    second = client.get("/v1/scenes", params={"limit": 2, "cursor": first["next"]}).json()
    assert [scene["id"] for scene in (*first["items"], *second["items"])] == made[::-1]
    assert second["next"] is None
    assert client.get("/v1/scenes", params={"drive_id": "drv_0"}).json() == {"items": [], "next": None}


def test_a_publication_of_an_old_holder_is_not_seen(client: Client) -> None:
    job = client.reconstruct(client.frozen())
    old = client.claim(job["id"])
    with client.api.database.write() as session:
        jobs.release(session, old)
    new = client.claim(job["id"])
    with pytest.raises(jobs.FencedError):
        client.publish(old, {"a": b"old"})
    assert client.get("/v1/scenes").json()["items"] == []
    scene_id = client.publish(new, {"a": b"new"})
    with pytest.raises(jobs.FencedError):
        client.publish(new, {"a": b"again"})
    (scene,) = client.get("/v1/scenes").json()["items"]
    assert scene["id"] == scene_id
    assert client.get(f"/v1/scenes/{scene_id}/files/a").content == b"new"


def test_bytes_that_are_gone_are_an_error_not_a_broken_answer(api: Api, client: Client) -> None:
    scene_id = client.scene({"gone.ply": b"gone"})
    (stored,) = [path for path in api.objects(client.project_id) if path.read_bytes() == b"gone"]
    stored.unlink()
    problem_of(client.get(f"/v1/scenes/{scene_id}/files/gone.ply"), 503, "store-unavailable")
