"""Exports over HTTP: asked for, found again, listed, downloaded, deleted, and what is refused."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from schemas.api.scenes import SceneComponent
from service.database.tables import Export, Job, now_us
from service.domain import exports, jobs
from service.domain.export_inputs import ExportInputs
from service.domain.map_inputs import StoredArtifact
from tests.helpers import live_api
from tests.helpers.live_api import MAP_FILES, SCENE_FILES, Client, forget_all, problem_of

CONTENT = bytes(range(256)) * 8
FILES = {"colmap/sparse/0/cameras.bin": CONTENT, "kitti/00/poses.txt": b"1 0 0\n", "report.json": b"{}"}
RESULTS = [
    {"format": "colmap", "files": 1, "size_bytes": len(CONTENT), "withheld": None, "notes": ["as seen"]},
    {"format": "kitti", "files": 1, "size_bytes": 6, "withheld": None, "notes": []},
]
ASKED = {"formats": ["kitti", "colmap", "kitti"], "image_size_px": 800}


@pytest.fixture
def scene_id(client: Client) -> str:
    return client.scene({**SCENE_FILES, "report.json": b"{}", "features.db": b"db"})


def ask(client: Client, scene_id: str, status: int = 202, **asked: Any) -> dict[str, Any]:
    answer = client.post(f"/v1/scenes/{scene_id}/exports", json=asked or ASKED)
    assert answer.status_code == status, answer.text
    assert answer.headers["location"] == f"/v1/exports/{answer.json()['id']}"
    return dict(answer.json())


def inputs_of(client: Client, asked: dict[str, Any]) -> tuple[ExportInputs, list[StoredArtifact], dict[str, str]]:
    """What a worker gets for an export that was asked for."""
    held = jobs.Claim(
        job_id=asked["job_id"], fence=1, attempt=1, project_id=client.project_id, kind="EXPORT", drive_id=None,
        map_id=None, settings={}, request={"export_id": asked["id"]},
    )  # fmt: skip
    with client.api.database.read() as session:
        inputs = exports.inputs_of(session, held)
        return inputs, inputs.files(session), inputs.drives(session)


def publish(client: Client, job_id: str, results: list[dict[str, Any]] = RESULTS) -> None:
    stored = client._store(FILES)
    held = client.claim(job_id)
    with client.api.database.write() as session:
        exports.publish(session, held, files=stored, results=results, expires_us=None)


@pytest.mark.parametrize(
    ("report", "reason", "remedy"),
    [
        (
            {"stages": [{"stage": "pictures", "birds_eye": {"not_drawn": "too few points lie on the ground"}}]},
            ": too few points lie on the ground",
            "reconstruct the drive again",
        ),
        ({"stages": [{"stage": "pictures", "birds_eye": {}, "road": {"not_drawn": "a"}}]}, ": a", "Leave the format"),
        ({"stages": [{"stage": "mapping"}]}, "is made of", "output.pictures is on"),
        (["no report"], "is made of", "output.pictures is on"),
    ],
)
def test_a_picture_that_is_missing_is_refused_with_the_scenes_own_reason(
    client: Client, monkeypatch: pytest.MonkeyPatch, report: object, reason: str, remedy: str
) -> None:
    monkeypatch.setattr(live_api, "SUMMARY", live_api.SUMMARY.model_copy(update={"georeferenced": True}))
    scene_id = client.scene({**SCENE_FILES, "report.json": json.dumps(report).encode()})
    answer = client.post(f"/v1/scenes/{scene_id}/exports", json={"formats": ["geotiff"]})
    problem = problem_of(answer, 422, "files-missing")
    assert problem["detail"].startswith(f"scene {scene_id} has no picture of the road, which format geotiff is made of")
    assert problem["detail"].endswith(reason)
    assert remedy in problem["remedy"]


def test_an_export_from_the_request_to_the_download(client: Client, scene_id: str) -> None:
    asked = ask(client, scene_id)
    assert (asked["state"], asked["formats"], asked["scene_id"]) == ("QUEUED", ["colmap", "kitti"], scene_id)
    job = client.get(f"/v1/jobs/{asked['job_id']}").json()
    assert (job["kind"], job["export_id"], job["scene_id"]) == ("EXPORT", asked["id"], None)
    assert ask(client, scene_id, 200)["id"] == asked["id"], "it is under way"
    publish(client, asked["job_id"])
    shown = ask(client, scene_id, 200, formats=["colmap", "kitti"], image_size_px=800)
    assert shown == client.get(f"/v1/exports/{asked['id']}").json()
    assert (shown["state"], shown["results"]) == ("SUCCEEDED", RESULTS)
    assert {file["path"]: file["size_bytes"] for file in shown["files"]} == {k: len(v) for k, v in FILES.items()}
    for file in shown["files"]:
        assert hashlib.sha256(client.get(file["url"]).content).hexdigest() == file["sha256"]
    url = f"/v1/exports/{asked['id']}/files/colmap/sparse/0/cameras.bin"
    part = client.get(url, headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, CONTENT[100:200])
    state = client.get(f"/v1/jobs/{asked['job_id']}/events").text
    assert f'"export_id":"{asked["id"]}"' in state.replace(": ", ":")


def test_an_idempotency_key_replays_the_answer(client: Client, scene_id: str) -> None:
    url, headers = f"/v1/scenes/{scene_id}/exports", {"Idempotency-Key": "one"}
    first, again = (client.post(url, json=ASKED, headers=headers) for _ in range(2))
    assert (first.status_code, again.status_code, again.headers["idempotent-replayed"]) == (202, 202, "true")
    assert first.json() == again.json()
    problem_of(client.post(url, json={"formats": ["kitti"]}, headers=headers), 422, "idempotency-key-reused")


def test_lists(client: Client, scene_id: str) -> None:
    ids = [ask(client, scene_id, formats=["kitti"], image_size_px=size)["id"] for size in (100, 200, 300)]
    other = ask(client, client.scene({**SCENE_FILES, "points.ply": b"other"}), formats=["kitti"])["id"]
    page = client.get(f"/v1/scenes/{scene_id}/exports", params={"limit": 2}).json()
    assert [item["id"] for item in page["items"]] == ids[:0:-1]
    rest = client.get(f"/v1/scenes/{scene_id}/exports", params={"limit": 2, "cursor": page["next"]}).json()
    assert [item["id"] for item in rest["items"]] == ids[:1]
    assert [item["id"] for item in client.get("/v1/exports").json()["items"]] == [other, *ids[::-1]]


def test_what_is_exported_is_not_deleted_before_the_job_has_ended(client: Client, scene_id: str) -> None:
    asked = ask(client, scene_id)
    problem_of(client.delete(f"/v1/scenes/{scene_id}"), 409, "used-by-job")
    problem_of(client.delete(f"/v1/exports/{asked['id']}"), 409, "export-active")
    drive_id = client.get(f"/v1/scenes/{scene_id}").json()["drive_id"]
    problem_of(client.delete(f"/v1/drives/{drive_id}"), 409, "drive-in-use")
    assert client.post(f"/v1/jobs/{asked['job_id']}:cancel").status_code == 202
    assert client.get(f"/v1/exports/{asked['id']}").json()["state"] == "CANCELLED"
    again = client.post(f"/v1/jobs/{asked['job_id']}:retry").json()
    assert (again["kind"], again["export_id"]) == ("EXPORT", asked["id"])
    problem_of(client.post(f"/v1/jobs/{asked['job_id']}:retry"), 409, "export-active")
    publish(client, again["id"])
    assert client.delete(f"/v1/scenes/{scene_id}").status_code == 204
    problem_of(client.get(f"/v1/exports/{asked['id']}"), 404, "not-found")


def test_deleting_an_export_gives_its_bytes_back(client: Client, scene_id: str) -> None:
    asked = ask(client, scene_id)
    publish(client, asked["job_id"])
    forget_all(client.api)
    assert client.get(f"/v1/exports/{asked['id']}/files/kitti/00/poses.txt").content == b"1 0 0\n"
    assert client.delete(f"/v1/exports/{asked['id']}").status_code == 204
    problem_of(client.get(f"/v1/exports/{asked['id']}/files/kitti/00/poses.txt"), 404, "not-found")
    assert len(forget_all(client.api)) == 2, "the third is a file of the scene, too"


def test_a_format_that_was_withheld_is_shown_and_made_again(client: Client, scene_id: str) -> None:
    asked = ask(client, scene_id)
    withheld = {**RESULTS[0], "withheld": "colmap is withheld: images was written but does not read back: a.png"}
    publish(client, asked["job_id"], [withheld, RESULTS[1]])
    assert client.get(f"/v1/exports/{asked['id']}").json()["results"][0]["withheld"].endswith("a.png")
    assert ask(client, scene_id)["id"] != asked["id"]


def test_what_is_refused(client: Client, scene_id: str) -> None:
    url = f"/v1/scenes/{scene_id}/exports"
    unknown = problem_of(client.post(url, json={"formats": ["dxf"]}), 422, "invalid-document")
    assert "colmap" in str(unknown)
    for wrong in (
        {"formats": []},
        {},
        {"formats": ["kitti"], "image_size_px": 10},
        {"formats": ["kitti"], "crs": "UTM 32"},
        {"formats": ["kitti"], "more": 1},
    ):
        problem_of(client.post(url, json=wrong), 422, "invalid-document")
    problem_of(client.post(url, json={"formats": ["kitti"], "crs": "EPSG:25832"}), 422, "crs-not-taken")
    problem_of(client.post("/v1/scenes/scn_0/exports", json=ASKED), 404, "not-found")
    other = client.api.client()
    problem_of(other.post(url, json=ASKED), 404, "not-found")
    asked = ask(client, scene_id)
    problem_of(other.get(f"/v1/exports/{asked['id']}"), 404, "not-found")
    problem_of(other.delete(f"/v1/exports/{asked['id']}"), 404, "not-found")
    problem_of(client.get(f"/v1/exports/{asked['id']}/files/none"), 404, "not-found")


def test_a_system_that_is_none_is_refused_before_a_job(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_api, "SUMMARY", live_api.SUMMARY.model_copy(update={"georeferenced": True}))
    scene_id = client.scene({**SCENE_FILES, "points.ply": b"somewhere"})
    url = f"/v1/scenes/{scene_id}/exports"
    for crs, words in (
        ("EPSG:999999", "EPSG:999999 of 'EPSG:999999' is not known"),
        ("EPSG:4326", "EPSG:4326 (WGS 84) is no projected system"),
        ("EPSG:25832+25833", "is no vertical datum"),
    ):
        refused = problem_of(client.post(url, json={"formats": ["copc"], "crs": crs}), 422, "bad-crs")
        assert words in refused["detail"]
        assert "EPSG:25832+7837" in refused["remedy"]
    assert client.get("/v1/exports").json()["items"] == []
    ask(client, scene_id, formats=["copc"], crs="EPSG:25832+7837")


def test_a_scene_nowhere_on_earth(client: Client, scene_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_api, "SUMMARY", live_api.SUMMARY.model_copy(update={"georeferenced": False}))
    nowhere = client.scene({**SCENE_FILES, "points.ply": b"nowhere"})
    answer = client.post(f"/v1/scenes/{nowhere}/exports", json={"formats": ["geojson", "kitti"]})
    problem_of(answer, 422, "not-georeferenced")
    ask(client, nowhere, formats=["kitti"])


def test_versions_of_maps(client: Client) -> None:
    scenes = [client.scene({"points.ply": b"a"}), client.scene({"points.ply": b"b"})]
    job = client.aggregate(scenes=scenes)
    client.publish_map(client.claim(job["id"]), MAP_FILES)
    url = f"/v1/maps/{job['map_id']}/versions"
    answer = client.post(f"{url}/current/exports", json={"formats": ["colmap"]})
    assert answer.status_code == 202, answer.text
    asked = answer.json()
    assert (asked["map_id"], asked["map_version"], asked["scene_id"]) == (job["map_id"], 1, None)
    problem_of(client.delete(f"/v1/maps/{job['map_id']}"), 409, "used-by-job")
    _, files, drives = inputs_of(client, asked)
    assert [file.path for file in files] == sorted(MAP_FILES)
    assert len(drives) == 2
    assert client.get(f"{url}/1/exports").json()["items"][0]["id"] == asked["id"]
    publish(client, asked["job_id"])
    assert client.post(f"{url}/1/exports", json={"formats": ["colmap"]}).status_code == 200
    problem_of(client.post(f"{url}/2/exports", json={"formats": ["colmap"]}), 404, "not-found")
    assert client.delete(f"/v1/maps/{job['map_id']}").status_code == 204
    problem_of(client.get(f"/v1/exports/{asked['id']}"), 404, "not-found")


def component(number: int, folder: str, *, georeferenced: bool) -> SceneComponent:
    figures = {"registered_units": 1, "registered_images": 2, "points": 3}
    return SceneComponent(component=number, folder=folder, georeferenced=georeferenced, **figures)


def test_components_of_a_scene(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = [component(0, ".", georeferenced=True), component(1, "components/1", georeferenced=False)]
    listed += [component(2, ".", georeferenced=True)]
    summary = live_api.SUMMARY.model_copy(update={"components": listed, "georeferenced": True})
    monkeypatch.setattr(live_api, "SUMMARY", summary)
    own = {f"components/1/{path}": b"of the component" for path in SCENE_FILES}
    scene_id = client.scene({**SCENE_FILES, **own, "components/10/poses.json": b"of another"})
    url = f"/v1/scenes/{scene_id}/exports"
    asked = ask(client, scene_id, formats=["kitti"], component=1)
    assert asked["component"] == 1
    inputs, files, _ = inputs_of(client, asked)
    assert [file.path for file in files] == sorted(SCENE_FILES)
    assert len({file.key for file in files}) == 1, "files of the component alone, which are all the same"
    assert inputs.engine_options == {"image_size_px": None, "crs": None}
    assert ask(client, scene_id, formats=["kitti"])["id"] != asked["id"]
    assert ask(client, scene_id, 200, formats=["kitti"], component=1)["id"] == asked["id"]
    refused = problem_of(client.post(url, json={"formats": ["kitti"], "component": 2}), 422, "component-unknown")
    assert refused["remedy"] == "Leave it out, or give one that has: 1."
    refused = problem_of(client.post(url, json={"formats": ["geojson"], "component": 1}), 422, "not-georeferenced")
    assert f"component 1 of scene {scene_id}" in refused["detail"]
    problem_of(client.post(url, json={"formats": ["kitti"], "component": 0}), 422, "invalid-document")
    ask(client, scene_id, formats=["geojson"])


def test_a_result_without_the_files_that_are_read_is_refused_before_a_job(client: Client) -> None:
    files = {path: data for path, data in SCENE_FILES.items() if path != "manifest.json"}
    scene_id = client.scene(files)
    answer = client.post(f"/v1/scenes/{scene_id}/exports", json=ASKED)
    assert "has no manifest.json" in problem_of(answer, 422, "files-missing")["detail"]
    assert client.get("/v1/exports").json()["items"] == []


def test_an_export_whose_time_is_over_is_not_given_again(client: Client, scene_id: str) -> None:
    """It is deleted at the next pass: whoever was sent to it would find nothing."""
    asked = ask(client, scene_id)
    publish(client, asked["job_id"])
    with client.api.database.write() as session:
        session.get_one(Export, asked["id"]).expires_us = now_us() - 1
    assert ask(client, scene_id)["id"] != asked["id"]


def test_an_export_whose_job_was_deleted_is_listed_as_failed(client: Client, scene_id: str) -> None:
    for size in (100, 200, 300):
        ask(client, scene_id, formats=["kitti"], image_size_px=size)
    with client.api.database.write() as session:
        oldest = session.query(Export).filter_by(project_id=client.project_id).order_by(Export.created_us).first()
        assert oldest is not None
        session.query(Job).filter_by(id=oldest.job_id).delete()
    items = client.get("/v1/exports").json()["items"]
    assert [item["state"] for item in items] == ["QUEUED", "QUEUED", "FAILED"]
