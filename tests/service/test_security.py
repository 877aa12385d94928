"""Keys: who may see what, and that no secret is kept or said."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.database.connections import migrate
from service.database.tables import ApiKey
from service.domain import exports
from service.domain.keys import ensure_first_key, revoke_key
from tests.helpers.live_api import SCENE_FILES, Api, Client, api_process, problem_of, settings_of, wait_until
from tests.helpers.tiny_drive import tiny_drive
from tests.helpers.tus_client import OFFSET_TYPE, VERSION, begin, metadata
from tests.service.test_maps import new_version

OPEN = {"/livez", "/readyz", "/metrics"}
BODIES: dict[str, Any] = {
    "/v1/drives": json.loads(tiny_drive().raw),
    "/v1/maps/{map_id}/current-version": {"version": 1},
    "/v1/scenes/{scene_id}/exports": {"formats": ["kitti"]},
    "/v1/maps/{map_id}/versions/{version}/exports": {"formats": ["kitti"]},
    "/v1/webhooks": {"url": "https://example.org/"},
    "/v1/drives/{drive_id}/files:declare": {"files": [{"path": "a", "size_bytes": 1, "sha256": "0" * 64}]},
}


def with_export_and_webhook(client: Client, scene_id: str) -> dict[str, str]:
    """Ids of an export with the file `points.ply`, and of a webhook with a message."""
    webhook_id = client.post("/v1/webhooks", json={"url": "https://example.org/"}).json()["id"]
    export = client.post(f"/v1/scenes/{scene_id}/exports", json={"formats": ["kitti"]}).json()
    stored, held = client._store({"points.ply": b"secret"}), client.claim(export["job_id"])
    with client.api.database.write() as session:
        exports.publish(session, held, files=stored, results=[], expires_us=None)
    (message,) = client.get(f"/v1/webhooks/{webhook_id}/deliveries").json()["items"]
    return {"export_id": export["id"], "webhook_id": webhook_id, "delivery_id": message["id"]}


def operations(api: Api) -> list[tuple[str, str]]:
    """All methods and paths of the OpenAPI page: what is added later is tested too."""
    page = httpx.get(f"{api.url}/openapi.json").json()
    return [(method.upper(), path) for path, methods in page["paths"].items() for method in methods]


def body_of(path: str, ids: dict[str, str]) -> Any:
    if path == "/v1/reconstructions":
        return {"drive_id": ids["drive_id"]}
    if path == "/v1/aggregations":
        return {"drives": [ids["drive_id"]], "scenes": [ids["scene_id"]]}
    return BODIES.get(path)


def headers_of(path: str) -> dict[str, str]:
    """What the resumable protocol wants to see before it looks for anything."""
    if "/uploads" not in path:
        return {}
    return {**VERSION, "Upload-Length": "1", "Upload-Metadata": metadata(path="a"), "Upload-Offset": "0"}


@pytest.fixture(scope="module")
def foreign(api: Api) -> dict[str, str]:
    """Ids of another project's things, all of which exist."""
    other = api.client()
    scene_id = other.scene({**SCENE_FILES, "points.ply": b"secret"})
    scene = other.get(f"/v1/scenes/{scene_id}").json()
    drive = tiny_drive("open", seed="open")
    upload = begin(other, other.create(drive), *next(iter(drive.files.items())))
    drives = [other.frozen(tiny_drive(f"drive-{i}", seed=str(i))) for i in range(2)]
    return {
        "scene_id": scene_id,
        "drive_id": scene["drive_id"],
        "job_id": scene["job_id"],
        "upload_id": upload.rpartition("/")[2],
        "map_id": new_version(other, {"points.ply": b"secret"}, drives=drives)["map_id"],
        "version": "1",
        "path": "points.ply",
        **with_export_and_webhook(other, scene_id),
    }


def test_no_route_answers_without_a_key(api: Api, foreign: dict[str, str]) -> None:
    keyless = api.anonymous()
    seen = set()
    for method, path in operations(api):
        answer = keyless.request(method, path.format(**foreign), json=body_of(path, foreign))
        if path in OPEN:
            assert answer.status_code == 200, path
            seen.add(path)
            continue
        assert answer.status_code == 401, (method, path)
        assert answer.headers["www-authenticate"].startswith("Bearer")
        if method != "HEAD":
            problem_of(answer, 401, "unauthorized")
    assert seen == OPEN
    for path in ("/docs", "/openapi.json"):
        assert keyless.get(path).status_code == 200


def test_foreign_ids_are_not_found_at_any_route(api: Api, client: Client, foreign: dict[str, str]) -> None:
    tried = 0
    for method, path in operations(api):
        if "{" not in path and path not in {"/v1/reconstructions", "/v1/aggregations"}:
            continue
        tried += 1
        headers = headers_of(path) | ({"Content-Type": OFFSET_TYPE} if method == "PATCH" else {})
        mine = client.request(method, path.format(**foreign), json=body_of(path, foreign), headers=headers)
        assert mine.status_code == 404, (method, path, mine.text)
        unknown = {name: re.sub(r"[0-9a-f]{30}", "0" * 30, value) for name, value in foreign.items()}
        other = client.request(method, path.format(**unknown), json=body_of(path, unknown), headers=headers)
        assert other.status_code == 404
        if method != "HEAD":
            problem = problem_of(mine, 404, "not-found")
            assert problem["title"] == other.json()["title"], "existing and missing look alike"
    assert tried >= 18


def test_head_is_get_without_a_body(api: Api, client: Client) -> None:
    scene_id = client.scene(SCENE_FILES)
    scene = client.get(f"/v1/scenes/{scene_id}").json()
    ids = {"scene_id": scene_id, "drive_id": scene["drive_id"], "job_id": scene["job_id"], "path": "points.ply"}
    drives = [client.frozen(tiny_drive(f"head-{i}", seed=f"head-{i}")) for i in range(2)]
    ids |= with_export_and_webhook(client, scene_id)
    ids |= {"map_id": new_version(client, {"points.ply": b"ply"}, drives=drives)["map_id"], "version": "1"}
    readable = [path for method, path in operations(api) if method == "GET"]
    assert len(readable) >= 20
    for path in readable:
        target = path.format(**ids)
        if path == "/v1/drives/{drive_id}/files/{path}":
            target = target.replace("points.ply", next(iter(tiny_drive().files)))
        if path.endswith("/events"):
            assert client.head(target).status_code == 405
            continue
        got, head = client.get(target), client.head(target)
        assert (got.status_code, head.status_code, head.content) == (200, 200, b""), path
        assert head.headers["content-type"] == got.headers["content-type"], path
        if "content-length" in got.headers and path not in ("/metrics", "/v1/status"):
            assert head.headers["content-length"] == got.headers["content-length"], path
        if path not in OPEN:
            assert api.anonymous().head(target).status_code == 401, path


def test_lists_show_nothing_foreign(client: Client, foreign: dict[str, str]) -> None:
    of_drive = f"?drive_id={foreign['drive_id']}"
    for path in ("/v1/drives", "/v1/jobs", "/v1/scenes", f"/v1/jobs{of_drive}", f"/v1/scenes{of_drive}"):
        assert client.get(path).json() == {"items": [], "next": None}


@pytest.mark.parametrize("row_id", ["", "x", "..", "drv_", "%00", "drv_%00", "ÿ", "drv_" + "f" * 500, "' OR 1=1 --"])
def test_ids_that_are_none(client: Client, row_id: str) -> None:
    for path in ("drives", "jobs", "scenes"):
        problem_of(client.get(f"/v1/{path}/{row_id}/"), 404, "not-found")
        assert client.get(f"/v1/{path}/x{row_id}").status_code == 404


def test_a_slash_too_many_leads_nowhere(api: Api, client: Client) -> None:
    """A redirect would go to the host that the request names."""
    for method in ("GET", "POST", "PUT"):
        for asking in (client, api.anonymous()):
            answer = asking.request(method, "/v1/drives/", headers={"Host": "elsewhere.example"})
            problem_of(answer, 404, "not-found")


@pytest.mark.parametrize(
    "value",
    [
        "",
        "Bearer",
        "Bearer wrong",
        "Basic {key}",
        "{key}",
        "Bearer {key}x",
        "Bearer {key} {key}",
        "Bearer ÿ",
        "Bearer " + "a" * 5000,
    ],
)
def test_headers_that_open_nothing(api: Api, client: Client, value: str) -> None:
    given = value.format(key=client.key).encode("latin-1")
    answer = httpx.get(f"{api.url}/v1/drives", headers={"Authorization": given})
    problem_of(answer, 401, "unauthorized")
    assert client.key not in answer.text


def test_a_revoked_key_opens_nothing(api: Api, client: Client) -> None:
    assert client.get("/v1/drives").status_code == 200
    with api.database.write() as session:
        (key,) = session.query(ApiKey).filter_by(project_id=client.project_id)
        assert revoke_key(session, key.id)
        assert not revoke_key(session, "key_0")
    wait_until(lambda: client.get("/v1/drives").status_code == 401, "the end of the key")
    problem_of(client.get("/v1/drives"), 401, "unauthorized")


def test_a_key_in_the_address_opens_nothing(api: Api, client: Client) -> None:
    for name in ("key", "token", "access_token", "api_key"):
        problem_of(httpx.get(f"{api.url}/v1/drives", params={name: client.key}), 401, "unauthorized")


def test_the_first_key_is_made_once(tmp_path: Path) -> None:
    chosen = settings_of(tmp_path)
    migrate(chosen)
    secret = ensure_first_key(chosen)
    assert secret is not None
    assert len(secret) > 40
    assert ensure_first_key(chosen) is None


def test_secrets_are_neither_kept_nor_logged(tmp_path: Path) -> None:
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        client.create()
        client.get("/v1/drives/nothing")
        httpx.get(f"{api.url}/v1/drives", headers={"Authorization": f"Basic {client.key}"})
        httpx.get(f"{api.url}/v1/drives", headers={"Authorization": f"Bearer {client.key}x"})
        secret = client.key
        while_running = [path.read_bytes() for path in (tmp_path / "data").rglob("*") if path.is_file()]
    kept = while_running + [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert any(b"api_keys" in content for content in kept), "the database is among them"
    for content in kept:
        assert secret.encode() not in content
        assert secret.removeprefix("mrasfm_").encode() not in content
    lines = [json.loads(line) for line in api.log.read_text().splitlines()]
    requests = [line for line in lines if line["message"] == "request"]
    assert {line["status"] for line in requests} >= {200, 201, 401, 404}
    assert all(line["request_id"].startswith("req_") for line in requests)


def test_what_is_stored_is_for_its_owner_alone(api: Api, client: Client) -> None:
    client.filled()
    for folder in (api.settings.data_dir / "artifacts", api.settings.spool_dir):
        assert folder.stat().st_mode & 0o077 == 0, folder
    assert all(path.stat().st_mode & 0o007 == 0 for path in api.objects(client.project_id))
