"""Headers of answers: those that the OpenAPI page names are sent, and no others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from service.database.tables import WebhookDelivery
from service.domain import exports
from tests.helpers.live_api import MAP_FILES, SCENE_FILES, Api, Client
from tests.helpers.tiny_drive import tiny_drive
from tests.helpers.tus_client import VERSION, create, head, metadata, patch

# Of the connection and of the body's form: every HTTP server sends them.
FRAMING = {"connection", "content-length", "content-type", "date", "server", "transfer-encoding"}
FILES = {**SCENE_FILES, "points.ply": b"ply of a scene"}


class Conversation:
    """A client, and which headers each of its requests was answered with."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.heard: dict[tuple[str, str], list[set[str]]] = defaultdict(list)

    def note(self, name: str, answer: httpx.Response) -> httpx.Response:
        """An answer to the operation of this name."""
        self.heard[name, str(answer.status_code)].append(set(answer.headers))
        return answer

    def ask(self, name: str, method: str, url: str, status: int, **more: Any) -> httpx.Response:
        answer = self.note(name, self.client.request(method, url, **more))
        assert answer.status_code == status, (name, answer.text)
        return answer

    def post(self, name: str, url: str, status: int, headers: dict[str, str] | None = None, **more: Any) -> Any:
        """Twice under one key: the second answer is the first, replayed. Its body, if it has one."""
        headers = {**(headers or {}), "Idempotency-Key": f"{name}-{url}"}
        for _ in range(2):
            answer = self.ask(name, "POST", url, status, headers=headers, **more)
        return answer.json()


@pytest.fixture(scope="module")
def heard(api: Api) -> dict[tuple[str, str], list[set[str]]]:
    """All that a client can ask, once at least."""
    said = Conversation(api.client())
    drive_id = _fill(said)
    _send_in_pieces(said)
    said.post("commit_drive", f"/v1/drives/{drive_id}:commit", 200)
    said.ask("get_preflight", "GET", f"/v1/drives/{drive_id}/preflight", 200)
    scene_id = _reconstruct(said, drive_id)
    _download(said, "scene", f"/v1/scenes/{scene_id}/files/points.ply")
    export_id = _export(said, f"/v1/scenes/{scene_id}/exports", "scene")
    _download(said, "export", f"/v1/exports/{export_id}/files/points.ply")
    map_id = _aggregate(said, scene_id)
    _export(said, f"/v1/maps/{map_id}/versions/1/exports", "map")
    said.ask("delete_export", "DELETE", f"/v1/exports/{export_id}", 204)
    _download(said, "map", f"/v1/maps/{map_id}/versions/current/files/points.ply")
    _follow(said)
    _delete(said, map_id, scene_id)
    _webhook(said, drive_id)
    for name, url in (
        ("get_liveness", "/livez"),
        ("get_readiness", "/readyz"),
        ("get_metrics", "/metrics"),
        ("get_status", "/v1/status"),
    ):
        said.ask(name, "GET", url, 200)
    return said.heard


def _fill(said: Conversation) -> str:
    drive = tiny_drive(seed="headers")
    path, data = next(iter(drive.files.items()))
    with said.client.api.anonymous() as stranger:
        assert said.note("create_drive", stranger.post("/v1/drives", content=drive.raw)).status_code == 401
    drive_id = said.post("create_drive", "/v1/drives", 201, content=drive.raw)["id"]
    url = f"/v1/drives/{drive_id}"
    said.ask("list_drives", "GET", "/v1/drives", 200)
    said.ask("list_drives", "GET", "/v1/drives?limit=0", 422)
    said.ask("get_drive", "GET", url, 200)
    said.ask("get_drive", "GET", f"{url}0", 404)
    said.ask("get_drive_manifest", "GET", f"{url}/manifest", 200)
    said.post("declare_files", f"{url}/files:declare", 200, json=drive.declaration)
    said.ask("commit_drive", "POST", f"{url}:commit", 409)
    said.ask("put_file", "PUT", f"{url}/files/{path}", 201, content=data)
    said.ask("put_file", "PUT", f"{url}/files/{path}", 200, content=data)
    said.ask("put_file", "PUT", f"{url}/files/{path}", 422, content=b"no image")
    said.ask("delete_file", "DELETE", f"{url}/files/{path}", 204)
    said.ask("put_archive", "PUT", f"{url}/archive", 200, content=drive.zipped())
    said.ask("put_archive", "PUT", f"{url}/archive", 415, content=b"no archive")
    said.ask("list_files", "GET", f"{url}/files", 200)
    _download(said, "drive", f"{url}/files/{path}")
    return str(drive_id)


def _send_in_pieces(said: Conversation) -> None:
    drive, client = tiny_drive(seed="pieces"), said.client
    path, data = next(iter(drive.files.items()))
    drive_id = client.create(drive)
    url = f"/v1/drives/{drive_id}/uploads"
    said.ask("get_upload_protocol", "OPTIONS", url, 204)
    said.ask("get_upload_protocol", "OPTIONS", "/v1/drives/none/uploads", 404)
    said.ask("create_upload", "POST", url, 412)
    said.ask("list_uploads", "GET", url, 200)
    assert said.note("create_upload", create(client, drive_id, 10**17, path=path)).status_code == 413
    announced = {**VERSION, "Upload-Length": str(len(data)), "Upload-Metadata": metadata(path=path)}
    upload = f"{url}/{said.post('create_upload', url, 201, headers=announced)['id']}"
    assert said.note("get_upload_offset", head(client, upload)).status_code == 200
    assert said.note("append_to_upload", patch(client, upload, 5, data)).status_code == 409
    wrong = patch(client, upload, 0, data[:10], Upload_Checksum="sha1 " + "A" * 27 + "=")
    assert said.note("append_to_upload", wrong).status_code == 460
    assert said.note("append_to_upload", patch(client, upload, 0, data)).status_code == 204
    said.ask("delete_upload", "DELETE", upload, 204, headers=VERSION)
    said.ask("delete_drive", "DELETE", f"/v1/drives/{drive_id}", 204)


def _reconstruct(said: Conversation, drive_id: str) -> str:
    client, asked = said.client, {"json": {"drive_id": drive_id}}
    said.ask("create_reconstruction", "POST", "/v1/reconstructions", 422, json={})
    job_id = said.post("create_reconstruction", "/v1/reconstructions", 202, **asked)["id"]
    url = f"/v1/jobs/{job_id}"
    etag = said.ask("list_jobs", "GET", "/v1/jobs", 200).headers["etag"]
    said.ask("list_jobs", "GET", "/v1/jobs", 304, headers={"If-None-Match": etag})
    _poll(said, url)
    said.post("cancel_job", f"{url}:cancel", 202)
    job_id = said.post("retry_job", f"{url}:retry", 202)["id"]
    url = f"/v1/jobs/{job_id}"
    scene_id = client.publish(client.claim(job_id), FILES)
    _poll(said, url)
    said.ask("cancel_job", "POST", f"{url}:cancel", 409)
    said.ask("stream_job_events", "GET", f"{url}/events", 200)
    said.ask("list_scenes", "GET", "/v1/scenes", 200)
    said.ask("get_scene", "GET", f"/v1/scenes/{scene_id}", 200)
    return scene_id


def _poll(said: Conversation, url: str) -> None:
    etag = said.ask("get_job", "GET", url, 200).headers["etag"]
    said.ask("get_job", "GET", url, 304, headers={"If-None-Match": etag})


def _download(said: Conversation, of: str, url: str) -> None:
    for name, method in ((f"download_{of}_file", "GET"), (f"head_{of}_file", "HEAD")):
        etag = said.ask(name, method, url, 200).headers["etag"]
        said.ask(name, method, url, 304, headers={"If-None-Match": etag})
        said.ask(name, method, url, 412, headers={"If-Match": '"another"'})
        said.ask(name, method, f"{url}x", 404)
    said.ask(f"download_{of}_file", "GET", url, 206, headers={"Range": "bytes=0-1", "If-Range": etag})
    said.ask(f"download_{of}_file", "GET", url, 416, headers={"Range": "bytes=99999-"})


def _aggregate(said: Conversation, scene_id: str) -> str:
    client = said.client
    other, third = (_scene(client, name) for name in ("other", "third"))
    job = said.post("create_aggregation", "/v1/aggregations", 202, json={"scenes": [scene_id, other]})
    url, files = f"/v1/maps/{job['map_id']}", {**MAP_FILES, "points.ply": b"ply of a map"}
    said.ask("create_aggregation", "POST", "/v1/aggregations", 409, json={"map_id": job["map_id"], "remove": [other]})
    client.publish_map(client.claim(job["id"]), files)
    again = client.aggregate(map_id=job["map_id"], scenes=[third])
    client.publish_map(client.claim(again["id"]), files)
    said.ask("list_maps", "GET", "/v1/maps", 200)
    said.ask("get_map", "GET", url, 200)
    said.ask("set_current_version", "PUT", f"{url}/current-version", 200, json={"version": 1})
    said.ask("list_map_versions", "GET", f"{url}/versions", 200)
    said.ask("get_map_version", "GET", f"{url}/versions/1", 200)
    said.ask("delete_map_version", "DELETE", f"{url}/versions/2", 204)
    return str(job["map_id"])


def _export(said: Conversation, url: str, of: str) -> str:
    client, asked = said.client, {"json": {"formats": ["kitti"]}}
    name = f"create_{of}_export"
    export = said.post(name, url, 202, **asked)
    said.ask(name, "POST", url, 200, headers={"Idempotency-Key": f"under-way-{url}"}, **asked)
    said.ask(name, "POST", url, 422, json={"formats": []})
    said.ask("delete_export", "DELETE", f"/v1/exports/{export['id']}", 409)
    held, stored = client.claim(export["job_id"]), client._store(FILES)
    with client.api.database.write() as session:
        exports.publish(session, held, files=stored, results=[], expires_us=None)
    for _ in range(2):
        said.ask(name, "POST", url, 200, headers={"Idempotency-Key": f"there-{url}"}, **asked)
    said.ask(f"list_{of}_exports", "GET", url, 200)
    said.ask("list_exports", "GET", "/v1/exports", 200)
    said.ask("get_export", "GET", f"/v1/exports/{export['id']}", 200)
    return str(export["id"])


def _webhook(said: Conversation, drive_id: str) -> None:
    asked, client = {"json": {"url": "https://example.org/hook"}}, said.client
    said.ask("create_webhook", "POST", "/v1/webhooks", 422, json={"url": "http://example.org"})
    url = f"/v1/webhooks/{said.post('create_webhook', '/v1/webhooks', 201, **asked)['id']}"
    said.ask("list_webhooks", "GET", "/v1/webhooks", 200)
    said.ask("get_webhook", "GET", url, 200)
    said.post("rotate_webhook", f"{url}:rotate", 200)
    client.post(f"/v1/jobs/{client.reconstruct(drive_id)['id']}:cancel")
    (message,) = said.ask("list_deliveries", "GET", f"{url}/deliveries", 200).json()["items"]
    again = f"{url}/deliveries/{message['id']}:retry"
    said.ask("retry_delivery", "POST", again, 409)
    with client.api.database.write() as session:
        session.get_one(WebhookDelivery, message["id"]).state = "FAILED"
    said.post("retry_delivery", again, 202)
    said.ask("delete_webhook", "DELETE", url, 204)


def _scene(client: Client, name: str) -> str:
    job = client.reconstruct(client.frozen(tiny_drive(name, seed=f"headers {name}")))
    return client.publish(client.claim(job["id"]), FILES)


def _follow(said: Conversation) -> None:
    """The stream and the session, which the console has."""
    client = said.client
    with client.stream("GET", "/v1/events") as answer:
        assert said.note("stream_events", answer).status_code == 200
    said.ask("begin_session", "POST", "/v1/session", 201)
    said.ask("get_session", "GET", "/v1/session", 200)
    said.ask("end_session", "DELETE", "/v1/session", 204)
    client.cookies.clear()


def _delete(said: Conversation, map_id: str, scene_id: str) -> None:
    said.ask("delete_scene", "DELETE", f"/v1/scenes/{scene_id}", 409)
    said.ask("delete_map", "DELETE", f"/v1/maps/{map_id}", 204)
    said.ask("delete_scene", "DELETE", f"/v1/scenes/{scene_id}", 204)


@pytest.fixture(scope="module")
def documented(page: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """By operation and status: headers, in lower case, and whether an answer always has them."""
    common = {f"#/components/headers/{name}": of for name, of in page["components"]["headers"].items()}
    return {
        (operation["operationId"], status): {
            name.lower(): common.get(of.get("$ref"), of).get("required", False)
            for name, of in response["headers"].items()
        }
        for operation in _operations(page)
        for status, response in operation["responses"].items()
    }


def _operations(page: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for methods in page["paths"].values():
        yield from methods.values()


def test_every_operation_was_asked(heard: Any, documented: Any) -> None:
    successes = {(name, status) for name, status in documented if status < "400"}
    assert successes == {(name, status) for name, status in heard if status < "400"}


def test_what_is_sent_is_documented(heard: Any, documented: Any) -> None:
    for case, answers in heard.items():
        undocumented = set[str]().union(*answers) - FRAMING - set(documented[case])
        assert not undocumented, case


def test_what_is_documented_is_sent(heard: Any, documented: Any) -> None:
    for case, answers in heard.items():
        for sent in answers:
            missing = {name for name, always in documented[case].items() if always} - sent
            assert not missing, case
        if case[1] < "400":  # a refusal has many reasons, and not all were given
            never = set(documented[case]) - set[str]().union(*answers)
            assert not never, case
