"""`mrasfm upload` as a program: killed in the middle, the service killed in the middle, and what it prints."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.api.problems import PROBLEM_TYPE, Problem
from schemas.file_names import UPLOAD_RECORD_NAME
from service.api.context import Context
from service.domain import jobs
from tests.helpers.bad_network import Cut, bad_network
from tests.helpers.live_api import (
    DEADLINE_S,
    ONE_ATTEMPT,
    REPOSITORY,
    ApiProcess,
    Client,
    api_process,
    free_port,
    settings_of,
    wait_until,
)
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import written

# -P: the repository may hold the metadata of an older build, which names fewer commands.
MRASFM = (sys.executable, "-P", "-c", "from mrasfm_engine.cli import main; raise SystemExit(main())")
MANY_FRAMES = 80


_running: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def _none_left() -> Iterator[None]:
    """Ends what a failed test leaves running."""
    yield
    while _running:
        process = _running.pop()
        if process.poll() is None:
            process.kill()
            process.communicate()


class Upload:
    """A running `mrasfm upload`."""

    def __init__(self, drive: Path, *options: str, url: str, key: str | None) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("MRASFM_")}
        if key is not None:
            environment["MRASFM_API_KEY"] = key
        self.process = subprocess.Popen(
            [*MRASFM, "upload", str(drive), "--url", url, "--json", *options],
            cwd=REPOSITORY,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        _running.append(self.process)

    def ended(self) -> tuple[int, dict[str, Any], str]:
        """Exit code, what it printed as JSON, and what it told."""
        printed, told = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, json.loads(printed), told

    def end(self, number: int) -> None:
        self.process.send_signal(number)


def upload(client: Client, drive: Path, *options: str) -> tuple[int, dict[str, Any], str]:
    code, summary, told = Upload(drive, *options, url=client.api.url, key=client.key).ended()
    assert client.key not in told + json.dumps(summary)
    return code, summary, told


@pytest.fixture
def large_drive(tmp_path: Path) -> Path:
    """A drive of 160 files: long enough to be interrupted."""
    return written(tiny_drive(seed=tmp_path.name, frames=MANY_FRAMES), tmp_path / "large")


@pytest.fixture
def killable(tmp_path: Path) -> Iterator[ApiProcess]:
    """An API in a process of its own."""
    with api_process(settings_of(tmp_path / "data"), tmp_path) as running:
        running.context = Context.open(running.settings)
        yield running
        running.context.database.close()


def stored_of(client: Client) -> int:
    items = client.get("/v1/drives").json()["items"]
    return int(items[0]["files_stored"]) if items else 0


def test_from_drive_to_scene(client: Client, drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    running = Upload(drive, "--no-gnss", "--out", str(out), url=client.api.url, key=client.key)
    wait_until(lambda: _reconstructions(client), "the job's start")
    (job,) = _reconstructions(client)
    assert job["settings"]["use_gnss"] is False
    scene_id = client.publish(client.claim(job["id"]), {"points.ply": b"ply", "report.json": b"{}"})
    code, summary, told = running.ended()
    assert code == 0, told
    assert (out / "points.ply").read_bytes() == b"ply"
    expected = {"drive_id": job["drive_id"], "job_id": job["id"], "scene_id": scene_id, "out": str(out)}
    assert {name: summary[name] for name in expected} == expected
    assert (summary["files_sent"], summary["files_skipped"], summary["error"]) == (6, 0, None)
    assert {"hash", "send", "commit", "wait", "download"} <= set(summary["seconds"])
    assert f"{client.api.url}/v1/jobs/{job['id']}" in told
    code, again, told = upload(client, drive, "--no-gnss", "--out", str(out))
    assert (code, again["scene_id"], again["bytes_sent"]) == (0, scene_id, 0)
    assert "0 files received, 2 were there" in told


def test_the_reports_findings_are_told(client: Client, drive: Path) -> None:
    """Those of a job that succeeded; a report that is none tells nothing."""
    running = Upload(drive, "--wait", url=client.api.url, key=client.key)
    wait_until(lambda: _reconstructions(client), "the job's start")
    what = "1 of 6 images are truncated and left out: front/000001.png"
    finding = {"severity": "warning", "code": "truncated-images", "what": what, "remedy": "Copy them again."}
    report = json.dumps({"stages": [], "findings": [finding]}).encode()
    client.publish(client.claim(_reconstructions(client)[0]["id"]), {"report.json": report})
    code, summary, told = running.ended()
    assert code == 0, told
    assert f"  warning: {what}. Copy them again." in told.splitlines()
    assert [(found["code"], found["what"]) for found in summary["findings"]] == [("truncated-images", what)]


def _reconstructions(client: Client) -> list[dict[str, Any]]:
    return [job for job in client.get("/v1/jobs").json()["items"] if job["kind"] == "RECONSTRUCTION"]


def test_killed_in_the_middle_it_sends_only_the_rest(client: Client, large_drive: Path) -> None:
    first = Upload(large_drive, "--parallel", "1", url=client.api.url, key=client.key)
    wait_until(lambda: stored_of(client) >= 10, "the first files")
    first.end(signal.SIGKILL)
    first.process.communicate()
    there = stored_of(client)
    assert 10 <= there < 2 * MANY_FRAMES
    code, summary, told = upload(client, large_drive)
    assert code == 0, told
    assert there <= summary["files_skipped"] <= there + 1  # one may have been under way
    assert summary["files_sent"] + summary["files_skipped"] == 2 * MANY_FRAMES
    assert [(drive["id"], drive["state"]) for drive in client.get("/v1/drives").json()["items"]] == [
        (summary["drive_id"], "COMMITTED")
    ]


def test_interrupted_it_says_how_to_go_on(client: Client, large_drive: Path) -> None:
    running = Upload(large_drive, "--parallel", "1", url=client.api.url, key=client.key)
    wait_until(lambda: stored_of(client) >= 5, "the first files")
    running.end(signal.SIGINT)
    code, _, told = running.ended()
    assert code == 130
    assert "The same command goes on from here." in told
    assert "Traceback" not in told


@pytest.mark.slow
def test_interrupted_while_the_service_is_silent_it_ends_at_once(client: Client, drive: Path) -> None:
    with bad_network(client.api.url, silent := Cut(b"PUT ", answer_bytes=0, times=4, silent=True)) as network:
        running = Upload(drive, url=network.url, key=client.key)
        wait_until(lambda: len(silent.seen) == 4, "the files")
        running.end(signal.SIGINT)
        began_s = time.monotonic()
        code, _, told = running.ended()
    assert time.monotonic() - began_s < 10, "an answer is waited for 60 s"
    assert code == 130
    assert "The same command goes on from here." in told
    assert "Traceback" not in told
    assert upload(client, drive)[0] == 0


@pytest.mark.slow
def test_interrupted_while_waiting_the_job_goes_on(client: Client, drive: Path) -> None:
    running = Upload(drive, "--wait", url=client.api.url, key=client.key)
    wait_until(lambda: _reconstructions(client), "the job's start")
    (job,) = _reconstructions(client)
    held = client.claim(job["id"])
    assert running.process.stderr is not None
    while "RUNNING" not in running.process.stderr.readline():
        assert running.process.poll() is None
    running.end(signal.SIGINT)
    code, summary, told = running.ended()
    assert (code, summary["job_id"]) == (130, job["id"])
    assert f"Job {job['id']} goes on." in told
    shown = client.get(f"/v1/jobs/{job['id']}").json()
    assert (shown["state"], shown["cancel_requested"]) == ("RUNNING", False)
    client.publish(held, {"report.json": b"{}"})
    assert upload(client, drive, "--wait")[1]["job_id"] == job["id"]


@pytest.mark.slow
def test_the_service_killed_while_sending_and_while_waiting(killable: ApiProcess, large_drive: Path) -> None:
    client = killable.client()
    running = Upload(large_drive, "--wait", "--parallel", "1", url=killable.url, key=client.key)
    wait_until(lambda: stored_of(client) >= 20, "the first files")
    assert stored_of(client) < 2 * MANY_FRAMES
    killable.kill()
    assert running.process.poll() is None
    killable.start()
    wait_until(lambda: _reconstructions(client), "the job's start")
    killable.kill()
    killable.start()
    (job,) = _reconstructions(client)
    scene_id = client.publish(client.claim(job["id"]), {"report.json": b"{}"})
    code, summary, told = running.ended()
    assert (code, summary["scene_id"]) == (0, scene_id), told
    assert len(client.get("/v1/drives").json()["items"]) == 1


def test_missing_files_are_listed_before_anything_is_sent(drive: Path) -> None:
    (drive / "front" / "000001.png").unlink()
    code, summary, told = Upload(drive, url=f"http://127.0.0.1:{free_port()}", key="key").ended()
    assert code == 2
    assert "1 of 6 files" in told
    assert "  front/000001.png" in told
    assert "Nothing was sent." in told
    assert summary["drive_id"] is None
    assert not (drive / UPLOAD_RECORD_NAME).exists()


def test_a_wrong_key_says_what_to_do(client: Client, drive: Path, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("mrasfm_wrong\n")
    code, summary, told = Upload(drive, "--key-file", str(tmp_path / "key"), url=client.api.url, key=None).ended()
    assert code == 2
    assert "API key is not valid" in told
    assert "mrasfm keys create" in told
    assert f"--key-file {tmp_path / 'key'}" in told
    assert "MRASFM_API_KEY" in told
    assert "Authorization" not in told, "who gives a command writes no headers"
    assert "mrasfm_wrong" not in told
    assert summary["problem"]["type"] == PROBLEM_TYPE + "unauthorized"


def test_a_wrong_key_of_the_environment_is_said_to_be_that(client: Client, drive: Path) -> None:
    code, _, told = Upload(drive, url=client.api.url, key="mrasfm_wrong").ended()
    assert code == 2
    assert "The key is that of MRASFM_API_KEY" in told
    assert "--key-file" in told
    assert "mrasfm_wrong" not in told


def test_without_a_key_it_says_where_to_put_one(drive: Path) -> None:
    code, _, told = Upload(drive, url="http://127.0.0.1:1", key=None).ended()
    assert code == 2
    assert "MRASFM_API_KEY" in told


@pytest.mark.slow
def test_a_service_that_is_not_there_is_4(drive: Path) -> None:
    url = f"http://127.0.0.1:{free_port()}"
    code, summary, told = Upload(drive, url=url, key="key").ended()
    assert code == 4
    assert url in told
    assert "Check the URL" in summary["error"]


def test_a_folder_that_is_taken_is_refused_before_the_upload(client: Client, drive: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").write_text("mine")
    code, _, told = upload(client, drive, "--out", str(tmp_path / "mine"))
    assert code == 2
    assert "not empty" in told
    assert client.get("/v1/drives").json()["items"] == []


def test_a_folder_that_cannot_be_made_is_refused_before_the_upload(client: Client, drive: Path, tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("mine")
    code, _, told = upload(client, drive, "--out", str(tmp_path / "notes" / "of" / "scene"))
    assert code == 2
    assert f"cannot be made: {tmp_path / 'notes'} is a file" in told
    assert client.get("/v1/drives").json()["items"] == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_refused_before_the_upload(
    client: Client, drive: Path, tmp_path: Path
) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(0o500)
    for out in (closed, closed / "scene"):
        code, _, told = upload(client, drive, "--out", str(out))
        assert code == 2
        assert f"cannot be written: {closed} is not yours to write" in told
    assert client.get("/v1/drives").json()["items"] == []


def test_a_folder_of_another_scene_is_refused_before_the_upload(client: Client, drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    running = Upload(drive, "--out", str(out), url=client.api.url, key=client.key)
    wait_until(lambda: _reconstructions(client), "the job's start")
    scene_id = client.publish(client.claim(_reconstructions(client)[0]["id"]), {"report.json": b"{}"})
    assert running.ended()[0] == 0
    drive_ids = [drive["id"] for drive in client.get("/v1/drives").json()["items"]]
    code, summary, told = upload(client, drive, "--no-gnss", "--out", str(out))
    assert (code, summary["job_id"]) == (2, None)
    assert f"{out} holds the scene {scene_id}, and this gives another one. Give another folder" in told
    other = written(tiny_drive("other", seed=f"{tmp_path} other"), tmp_path / "other")
    assert upload(client, other, "--out", str(out))[0] == 2
    assert [drive["id"] for drive in client.get("/v1/drives").json()["items"]] == drive_ids
    assert len(_reconstructions(client)) == 1


def test_a_failed_job_is_3_with_its_problem(client: Client, drive: Path) -> None:
    running = Upload(drive, "--wait", url=client.api.url, key=client.key)
    wait_until(lambda: _reconstructions(client), "the job's start")
    held = client.claim(_reconstructions(client)[0]["id"])
    finding = {"severity": "error", "code": "blur", "what": "front/000001.png is blurred", "remedy": "Focus."}
    problem = Problem(
        type=PROBLEM_TYPE + "engine-abort",
        title="t",
        detail="the stage 'mapping' ended",
        remedy="Send better images.",
        findings=[finding],
        log_tail="first line\nlast line",
        retryable=False,
    )
    with client.api.database.write() as session:
        jobs.fail(session, held, problem, limits=ONE_ATTEMPT, retry_delay_us=0)
    code, summary, told = running.ended()
    assert (code, summary["job_state"]) == (3, "FAILED")
    for what in (problem.detail, problem.remedy, "front/000001.png is blurred", "    last line"):
        assert what in told
    assert summary["problem"]["log_tail"] == problem.log_tail


@pytest.mark.parametrize("options", [("--parallel", "0"), ("--parallel", "x"), ("--key", "secret")])
def test_options_that_make_no_sense_are_refused(drive: Path, options: tuple[str, str]) -> None:
    command = [*MRASFM, "upload", str(drive), "--url", "http://127.0.0.1:1", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "usage:" in done.stderr
