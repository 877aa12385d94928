"""Lists, deletion, retry, maps, exports and webhooks with the library, with and without an event loop, and commands."""

from __future__ import annotations

import asyncio
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete

from schemas.api.drives import PreflightState
from schemas.api.exports import ExportRequest
from schemas.api.jobs import JobKind, JobState
from schemas.api.problems import PROBLEM_TYPE, Problem
from schemas.api.webhooks import WebhookEvent, WebhookRequest
from service.client import ApiError, AsyncClient, Client, ClientError, download, watch_job
from service.client import api as client_api
from service.commands.client_program import main
from service.database.tables import Drive, Job
from service.domain import exports, jobs
from tests.helpers.live_api import LIMITS, SCENE_FILES
from tests.helpers.live_api import Client as Owner
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import Connect

FILES = {"kitti/00/poses.txt": b"1 0 0\n", "report.json": b"{}"}
RESULTS = [{"format": "kitti", "files": 1, "size_bytes": 6, "withheld": None, "notes": ["as seen"]}]


def publish(client: Owner, job_id: str) -> None:
    stored, held = client._store(FILES), client.claim(job_id)
    with client.api.database.write() as session:
        exports.publish(session, held, files=stored, results=RESULTS, expires_us=None)


def test_lists_go_on_page_after_page(client: Owner, connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_api, "PAGE", 2)
    drives = [client.create() for _ in range(5)]
    library = connect(client)
    assert [drive.id for drive in library.drives()] == drives[::-1]
    first = next(iter(library.drives()))
    assert first.id == drives[-1]
    library.delete_drive(drives[2])
    assert [drive.id for drive in library.drives()] == [d for d in drives[::-1] if d != drives[2]]
    with pytest.raises(ApiError) as raised:
        library.delete_drive(drives[2])
    assert raised.value.status == 404


def test_scenes_maps_and_jobs(client: Owner, connect: Connect) -> None:
    scene_ids = [client.scene({"points.ply": name}) for name in (b"a", b"b")]
    library = connect(client)
    assert [scene.id for scene in library.scenes()] == scene_ids[::-1]
    job = client.aggregate(scenes=scene_ids)
    library.cancel_job(job["id"])
    again = library.retry_job(job["id"])
    assert again.retry_of == job["id"]
    assert [found.id for found in library.jobs(states=JobState.CANCELLED)] == [job["id"]]
    both = library.jobs(states=[JobState.CANCELLED, JobState.QUEUED], kinds=JobKind.AGGREGATION)
    assert [found.id for found in both] == [again.id, job["id"]]
    client.publish_map(client.claim(again.id), {"map.json": b"{}"})
    assert again.map_id is not None
    assert library.map(again.map_id).current_version == 1
    assert [found.id for found in library.maps()] == [again.map_id]
    assert [version.number for version in library.map_versions(again.map_id)] == [1]
    assert library.map_version(again.map_id, "current").number == 1
    assert library.show_map_version(again.map_id, 1).current_version == 1
    with pytest.raises(ApiError, match="current"):
        library.delete_map_version(again.map_id, 1)
    with pytest.raises(ApiError, match="is part of"):
        library.delete_scene(scene_ids[0])
    library.delete_map(again.map_id)
    library.delete_scene(scene_ids[0])
    assert [scene.id for scene in library.scenes()] == scene_ids[1:]
    assert again.id in [found.id for found in library.jobs()]


def test_an_export_is_asked_for_and_downloaded(client: Owner, connect: Connect, tmp_path: Path) -> None:
    library, scene_id = connect(client), client.scene(SCENE_FILES)
    asked = ExportRequest(formats=["kitti"])
    export = library.export_scene(scene_id, asked)
    publish(client, export.job_id)
    assert watch_job(library, export.job_id).export_id == export.id
    export = library.export_scene(scene_id, asked)
    assert export.state == JobState.SUCCEEDED
    assert download(library, export, tmp_path / "out").files_received == 2
    assert (tmp_path / "out" / "kitti" / "00" / "poses.txt").read_bytes() == b"1 0 0\n"
    assert [found.id for found in library.exports()] == [export.id]
    library.delete_export(export.id)
    with pytest.raises(ApiError):
        library.export(export.id)


def test_webhooks_are_registered_and_rotated(client: Owner, connect: Connect) -> None:
    library = connect(client)
    made = library.create_webhook(WebhookRequest(url="https://example.org/", events=[WebhookEvent.JOB_CANCELLED]))
    job = client.reconstruct(client.frozen())
    library.cancel_job(job["id"])
    (message,) = library.deliveries(made.id)
    assert message.job_id == job["id"]
    with pytest.raises(ApiError, match="pending"):
        library.retry_delivery(made.id, message.id)
    assert library.rotate_webhook(made.id).secret != made.secret
    assert [webhook.id for webhook in library.webhooks()] == [made.id]
    library.delete_webhook(made.id)
    assert list(library.webhooks()) == []


def test_the_same_in_an_event_loop(client: Owner, tmp_path: Path) -> None:
    scene_ids = [client.scene({"points.ply": bytes([number])}) for number in range(3)]

    async def converse() -> None:
        async with AsyncClient(client.api.url, client.key) as library:
            shown = await asyncio.gather(*(library.scene(scene_id) for scene_id in scene_ids))
            assert [scene.id for scene in shown] == scene_ids
            assert [scene.id async for scene in library.scenes()] == scene_ids[::-1]
            done = await library.call(download, shown[0], tmp_path / "scene")
            assert done.files_received == 1
            with pytest.raises(ApiError):
                await library.drive("drv_0")
            waiting = asyncio.create_task(library.call(watch_job, client.reconstruct(client.frozen())["id"]))
            await asyncio.sleep(0.2)
            assert not waiting.done()
            library.stop()
            with pytest.raises(ClientError):
                await waiting

    asyncio.run(converse())


def test_both_clients_have_the_same_methods() -> None:
    own = {"client", "call", "stop", "close"}
    others = {"stopped", "url", "require_open", "pause", "retry_budget", "close", "stop"}
    # What sends and receives pieces is for the functions that `call` runs.
    pieces = {"open_file", "events", "poll_job", "create_upload", "upload_offset", "append_to_upload"}
    blocking = {name for name, _ in inspect.getmembers(Client) if not name.startswith("_")}
    awaited = {name for name, _ in inspect.getmembers(AsyncClient) if not name.startswith("_")}
    assert blocking - others - pieces == awaited - own


def run(client: Owner, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main([*words, "--url", client.api.url, "--json"])
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return code, told


def test_a_list_of_jobs_says_which_drive_and_why(
    client: Owner, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MRASFM_API_KEY", client.key)
    monkeypatch.setenv("MRASFM_URL", client.api.url)
    drive_ids = [client.frozen() for _ in range(3)]
    failed, runs, waits = (client.reconstruct(drive_id)["id"] for drive_id in drive_ids)
    held, running = client.claim(failed), client.claim(runs)
    detail = "no image of the drive has a keypoint"
    problem = Problem(
        type=PROBLEM_TYPE + "no-features", title="No features", detail=detail, remedy="Look.", retryable=False
    )
    with client.api.database.write() as session:
        jobs.fail(session, held, problem, limits=LIMITS, retry_delay_us=0)
    with client.api.database.write() as session:
        note = jobs.ProgressNote(
            stage="matches", done=1, total=2, unit="pairs", percent=33.4, eta_low_s=1.0, eta_high_s=2.0, reused=()
        )
        jobs.heartbeat(session, running, lease_us=60_000_000, note=note)
    assert main(["list", "jobs", "--kind", "RECONSTRUCTION", "--limit", "2"]) == 0
    shown, said = capsys.readouterr()
    newest, second = shown.splitlines()
    assert newest.split()[:3] == [waits, "RECONSTRUCTION", "QUEUED"]
    assert newest.endswith(drive_ids[2])
    assert second.endswith(f"{drive_ids[1]}  matches 33 %")
    assert "--limit" in said, "there is a third"
    assert main(["list", "jobs", "--state", "failed"]) == 0
    assert capsys.readouterr().out.strip().endswith(f"{drive_ids[0]}  no-features: {detail}")
    assert main(["retry", failed]) == 0
    assert main(["cancel", runs, waits]) == 0
    assert main(["list", "jobs", "--limit", "1"]) == 0
    assert capsys.readouterr().out.strip().endswith(f"retry of {failed}")
    assert main(["retry", waits, "job_0"]) == 2
    assert f"{client.api.url}/v1/jobs/" in capsys.readouterr().err, "the first was made, whatever becomes of the next"
    with pytest.raises(SystemExit):
        main(["list", "jobs", "--limit", "0"])
    monkeypatch.delenv("MRASFM_URL")
    assert main(["list", "jobs"]) == 2
    assert "MRASFM_URL" in capsys.readouterr().err


def test_a_list_of_drives_says_what_their_check_found(
    client: Owner, connect: Connect, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MRASFM_API_KEY", client.key)
    monkeypatch.setenv("MRASFM_URL", client.api.url)
    warned = {"severity": "warning", "code": "dark", "what": "an image is dark", "remedy": "Look."}
    wrong = {**warned, "severity": "error"}
    client.create()
    drive_ids = [client.frozen() for _ in range(6)]
    with client.api.database.write() as session:
        for drive_id, state, findings in zip(
            drive_ids,
            ("PENDING", "PENDING", "PASSED", "PASSED", "REJECTED", "UNKNOWN"),
            ([], [warned], [], [warned, warned], [wrong, wrong, warned], []),
            strict=True,
        ):
            drive = session.get_one(Drive, drive_id)
            drive.preflight_state, drive.findings = PreflightState(state), findings
        failed_check = drive.preflight_job_id
    assert main(["list", "drives"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("Z  ")[1:] for line in lines[::-1]] == [
        [],
        ["check runs"],
        ["check runs: 1 warning so far"],
        ["check passed: no finding"],
        ["check passed: 2 warnings"],
        ["check rejected: 2 errors, 1 warning"],
        [f"check failed: {failed_check}"],
    ]
    assert main(["list", "drives", "--preflight", "rejected", "--preflight", "UNKNOWN"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == drive_ids[:3:-1]
    assert main(["list", "drives", "--preflight", "bad"]) == 2
    assert main(["list", "jobs", "--preflight", "PASSED"]) == 2
    assert "list drives" in capsys.readouterr().err
    library = connect(client)
    assert [drive.id for drive in library.drives(preflight=PreflightState.PASSED)] == [drive_ids[3], drive_ids[2]]
    assert len(list(library.drives(preflight=[PreflightState.REJECTED, PreflightState.NONE]))) == 2


def test_an_export_outlives_the_record_of_its_job(
    client: Owner, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MRASFM_API_KEY", client.key)
    scene_id = client.scene({**SCENE_FILES, "report.json": b"{}"})
    (export,) = run(client, capsys, "export", scene_id, "--format", "kitti")[1]["items"]
    publish(client, export["job_id"])
    with client.api.database.write() as session:
        session.execute(delete(Job).where(Job.id == export["job_id"]))
    code, told = run(client, capsys, "export", scene_id, "--format", "kitti", "--out", str(tmp_path / "out"))
    assert (code, [item["id"] for item in told["items"]]) == (0, [export["id"]])
    assert (tmp_path / "out" / "report.json").read_bytes() == FILES["report.json"]


def test_commands(
    client: Owner, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MRASFM_API_KEY", client.key)
    scene_id = client.scene({**SCENE_FILES, "report.json": b"{}"})
    code, told = run(client, capsys, "list", "scenes")
    assert (code, [item["id"] for item in told["items"]]) == (0, [scene_id])
    assert main(["list", "scenes", "--url", client.api.url]) == 0
    assert capsys.readouterr().out.startswith(scene_id)
    code, told = run(client, capsys, "export", scene_id, "--format", "kitti")
    (export,) = told["items"]
    assert (code, export["state"]) == (0, "QUEUED")
    assert run(client, capsys, "delete", export["id"])[0] == 2, "it is being made"
    publish(client, export["job_id"])
    assert run(client, capsys, "wait", export["job_id"])[0] == 0
    code, told = run(client, capsys, "export", scene_id, "--format", "kitti", "--out", str(tmp_path / "out"))
    assert (code, (tmp_path / "out" / "report.json").read_bytes()) == (0, b"{}")
    assert run(client, capsys, "download", scene_id, "--out", str(tmp_path / "scene"))[0] == 0
    assert run(client, capsys, "show", export["id"])[1]["items"][0]["state"] == "SUCCEEDED"
    assert main(["list", "exports", "--url", client.api.url]) == 0
    assert capsys.readouterr().out.startswith(f"{export['id']}  SUCCEEDED  kitti  ")
    assert run(client, capsys, "delete", export["id"])[0] == 0
    other = run(client, capsys, "export", scene_id, "--format", "kitti", "--out", str(tmp_path / "scene"))
    assert (other[0], f"holds the scene {scene_id}" in other[1]["error"]) == (2, True), "before the wait"
    job = client.reconstruct(client.frozen())
    assert run(client, capsys, "cancel", job["id"])[1]["job_state"] == "CANCELLED"
    assert run(client, capsys, "wait", job["id"])[0] == 3
    only = ("--kind", "RECONSTRUCTION", "--state", "CANCELLED", "--state", "FAILED")
    assert [item["id"] for item in run(client, capsys, "list", "jobs", *only)[1]["items"]] == [job["id"]]
    assert run(client, capsys, "list", "jobs", *only[:2], "--state", "running")[1]["items"] == []
    assert run(client, capsys, "retry", job["id"])[1]["job_id"] != job["id"]
    code, told = run(client, capsys, "webhook", "https://example.org/", "--event", "job.failed")
    assert told["items"][0]["secret"].startswith("whsec_")
    webhook_id = told["items"][0]["id"]
    assert run(client, capsys, "rotate", webhook_id)[0] == 0
    assert run(client, capsys, "deliveries", webhook_id)[1]["items"] == []
    assert run(client, capsys, "show", webhook_id)[1]["items"][0]["events"] == ["job.failed"]
    assert run(client, capsys, "delete", webhook_id)[0] == 0
    for words in (
        ("list", "scenes", "--state", "FAILED"),
        ("list", "jobs", "--state", "broken"),
        ("show", "abc"),
        ("show", "scn_0/1"),
        ("delete", job["id"]),
        ("webhook", "ftp://x"),
        ("export", job["id"], "--format", "kitti"),
        ("export", scene_id, "--format", "kitti", "--image-size", "3"),
    ):
        assert run(client, capsys, *words)[0] == 2, words


@pytest.mark.parametrize("words", [("list", "drives"), ("show", "{drive_id}")])
def test_names_that_the_terminal_lacks_the_characters_of_are_shown(client: Owner, words: tuple[str, ...]) -> None:
    drive_id = client.create(tiny_drive("Weg zur Brücke 東京"))
    command = [
        sys.executable,
        "-m",
        "service.commands.client_program",
        *(word.format(drive_id=drive_id) for word in words),
    ]
    environment = {**os.environ, "MRASFM_API_KEY": client.key, "MRASFM_URL": client.api.url}
    environment["PYTHONIOENCODING"] = "latin-1"  # as terminals and files of other systems have it
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert r"Weg zur Brücke \u6771\u4eac" in done.stdout.decode("latin-1")


def test_who_stops_reading_gets_no_traceback(client: Owner) -> None:
    """As `mrasfm-client list drives | head -1`."""
    for _ in range(3):
        client.create()
    command = [sys.executable, "-m", "service.commands.client_program", "list", "drives", "--url", client.api.url]
    environment = {**os.environ, "MRASFM_API_KEY": client.key, "PYTHONUNBUFFERED": "1"}
    done = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert done.stdout is not None
    done.stdout.close()
    assert done.stderr is not None
    said = done.stderr.read().decode()
    done.stderr.close()
    assert done.wait(30) == 141
    assert "Traceback" not in said
