"""What a worker does with one job, in this process: only the stages are processes of their own."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr
from sqlalchemy import insert, text
from sqlalchemy.exc import IntegrityError, OperationalError
from sqlalchemy.orm import Session

from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.cli import main
from schemas import DocumentError, parse_new_manifest
from schemas.api.problems import PROBLEM_TYPE
from schemas.api.resource import Finding
from service.database.tables import Blob, Checkpoint, Drive, DriveFile, Job, SceneFile
from service.domain import jobs
from service.storage.process_folder import process_folder
from tests.helpers.damaged_images import cut
from tests.helpers.live_api import LIMITS
from tests.helpers.service_world import World, is_gone, wait_until
from tests.helpers.slow import slow
from worker.attempt import AttemptFolder
from worker.commit_with_retry import commit_with_retry
from worker.heartbeat import Heartbeat
from worker.job_execution import Runner
from worker.oom import MemoryKills, memory_kills
from worker.termination import StopReason, StopRequest


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Records and files alone; messages are not needed."""
    made = World(tmp_path)
    yield made
    made.close()


def as_accepted_before(drive: Path, folder: Path) -> Path:
    """The drive with a manifest that is refused today."""
    shutil.copytree(drive, folder)
    path = folder / "drive.json"
    document = json.loads(path.read_text())
    document["version"] = 1.0
    for image, name in zip(document["frames"][0]["images"].values(), ("images/A.png", "images/a.png"), strict=True):
        (folder / image["file"]).rename(folder / name)
        image["file"] = name
    path.write_text(json.dumps(document))
    with pytest.raises(DocumentError, match="version"):
        parse_new_manifest(path.read_bytes())
    return folder


@pytest.mark.slow
def test_a_drive_that_was_accepted_before_stricter_rules(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """It is checked and reconstructed, and its scene can be aggregated."""
    drive_id, check = world.add_unchecked_drive(as_accepted_before(brief_drive, tmp_path / "old"))
    checked = run(world, check)
    assert checked.state == "SUCCEEDED", checked.problem
    job = run(world, world.ask(drive_id, wake=False))
    assert job.state == "SUCCEEDED", job.problem
    folder = tmp_path / "scene"
    with world.database.read() as session:
        keys = {file.path: session.get_one(Blob, file.blob_id).key for file in session.query(SceneFile)}
    for path, key in keys.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(world.artifacts.read(key))
    files = {image.file for image in read_scene(folder, "old").manifest.frames[0].images.values()}
    assert files == {"images/A.png", "images/a.png"}


def run(world: World, job_id: str, **settings: object) -> Job:
    Runner(world.settings.model_copy(update=settings)).run(job_id)
    return world.job(job_id)


def test_scene_and_progress(world: World, brief_drive: Path, caplog: pytest.LogCaptureFixture) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    job = run(world, job_id)
    assert (job.state, job.percent, job.attempt) == ("SUCCEEDED", 100.0, 1)
    told = [event.data for event in world.events(job_id)]
    assert [data["state"] for data in told if "state" in data] == ["QUEUED", "RUNNING", "SUCCEEDED"]
    percents = [data["percent"] for data in told]
    assert percents == sorted(percents)
    assert percents[-1] == 100.0
    assert list(world.settings.scratch_dir.iterdir()) == []
    (scene,) = world.scenes()
    assert scene.summary["registered_units"] == 4
    caplog.clear()
    with caplog.at_level(logging.INFO, "mrasfm.worker"):  # as when its message comes twice
        assert run(world, job_id).fence == 1
    assert caplog.messages == ["nothing to do"]
    assert len(world.scenes()) == 1


@pytest.mark.slow
def test_stages_are_found_again_on_another_machine(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """The drive lies elsewhere there; database and artifacts are the same. Other settings are other stages."""
    drive_id = world.add_drive(brief_drive)
    run(world, world.ask(drive_id, wake=False))
    elsewhere = {
        "data_dir": tmp_path / "another machine",
        "artifacts_url": world.settings.resolved_artifacts_url,
        "database_url": SecretStr(world.settings.resolved_database_url),
    }
    reused = ["features", "matches", "mapping", "refinement"]
    assert run(world, world.ask(drive_id, wake=False), **elsewhere).reused == reused
    with world.database.read() as session:
        stored = sorted(row.name.removesuffix(".npz") for row in session.query(Checkpoint))
        assert stored == ["extraction-size", "features", "mapping", "matches", "own-car", "refinement"]
    other = run(world, world.ask(drive_id, wake=False, max_keypoints=500))
    assert (other.state, other.reused) == ("SUCCEEDED", [])


def test_preflight_of_a_sound_drive(world: World, brief_drive: Path) -> None:
    drive_id, job_id = world.add_unchecked_drive(brief_drive)
    assert run(world, job_id).state == "SUCCEEDED"
    drive = world.drive(drive_id)
    assert drive.preflight_state == "PASSED"
    assert all(finding["severity"] == "warning" for finding in drive.findings)


def test_unsound_drive(world: World, own_brief_drive: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Its check rejects it; a reconstruction asked for meanwhile fails at once with the same words as the command."""
    images = sorted((own_brief_drive / "images").rglob("*.jpg"))
    for image in images[:2]:
        image.write_bytes(image.read_bytes()[:-2000])
    assert main(["reconstruct", str(own_brief_drive), "--out", str(tmp_path / "scene")]) == 2
    words = capfd.readouterr().err
    drive_id, check_id = world.add_unchecked_drive(own_brief_drive)
    job_id = world.ask(drive_id, wake=False)
    job = run(world, job_id)
    assert (job.state, job.attempt) == ("FAILED", 1)
    assert world.outcomes(job_id) == ["truncated-image"]
    problem = job.problem
    assert problem is not None
    assert problem["type"] == PROBLEM_TYPE + "truncated-image"
    assert f"mrasfm: error: {problem['detail']}\n  {problem['remedy']}" in words
    assert problem["stage"] == "preflight"
    assert run(world, check_id).state == "SUCCEEDED"
    drive = world.drive(drive_id)
    assert drive.preflight_state == "REJECTED"
    of_check, of_job = ([*map(Finding.model_validate, found)] for found in (drive.findings, problem["findings"]))
    assert of_check == of_job
    assert sum(finding["severity"] == "error" for finding in drive.findings) == 2


def test_drive_that_was_deleted(world: World, brief_drive: Path) -> None:
    drive_id = world.add_drive(brief_drive)
    job_id = world.ask(drive_id, wake=False)
    with world.database.write() as session:
        session.delete(session.get_one(Drive, drive_id))
    job = run(world, job_id)
    assert (job.state, job.attempt) == ("FAILED", 1)
    assert job.problem is not None
    assert job.problem["type"] == PROBLEM_TYPE + "drive-deleted"


def test_file_that_is_gone_from_the_store(world: World, brief_drive: Path) -> None:
    drive_id = world.add_drive(brief_drive)
    with world.database.read() as session:
        file = session.query(DriveFile).filter_by(drive_id=drive_id).first()
        assert file is not None
        key = session.get_one(Blob, file.blob_id).key
    world.artifacts.delete([key])
    job_id = world.ask(drive_id, wake=False)
    job = run(world, job_id, max_attempts=1)
    assert job.state == "FAILED"
    assert job.problem is not None
    assert job.problem["type"] == PROBLEM_TYPE + "storage"
    assert job.problem["retryable"] is True
    assert str(world.settings.data_dir) not in json.dumps(job.problem)


def test_machine_without_scratch(world: World, brief_drive: Path) -> None:
    """What cannot be written there is not the drive's fault: another attempt, maybe elsewhere, may do it."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    world.settings.scratch_dir.write_text("a file where the folder belongs", encoding="utf-8")
    assert run(world, job_id).state == "QUEUED"
    (attempt,) = world.attempts(job_id)
    assert attempt.outcome == "storage"
    assert attempt.problem is not None
    assert attempt.problem["retryable"] is True
    assert str(world.settings.data_dir) not in json.dumps(attempt.problem)


def test_shutting_down(world: World, brief_drive: Path) -> None:
    """While the drive is fetched: there is no stage yet that could be stopped."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    asked: list[bool] = []

    def shutting_down() -> bool:
        asked.append(True)
        return len(asked) > 2

    Runner(world.settings, shutting_down=shutting_down).run(job_id)
    job = world.job(job_id)
    assert (job.state, job.attempt, job.fence) == ("QUEUED", 1, 1)
    assert world.outcomes(job_id) == ["released"]
    assert world.children() == []


def break_endings(
    runner: Runner, job_id: str, monkeypatch: pytest.MonkeyPatch, *, times: int, answer_lost: bool = False
) -> list[str]:
    """Make the database fail as transactions that end the job are committed; the states they would have made."""
    dialect = runner._database.engine.dialect
    commit = dialect.do_commit
    broken: list[str] = []

    def do_commit(connection: object) -> None:
        cursor = connection.cursor()  # type: ignore[attr-defined]
        (state,) = cursor.execute("SELECT state FROM jobs WHERE id = ?", (job_id,)).fetchone()
        cursor.close()
        if state == "RUNNING" or len(broken) == times:
            commit(connection)
            return
        broken.append(state)
        if answer_lost:
            commit(connection)
        raise sqlite3.OperationalError("the connection is lost")

    monkeypatch.setattr(dialect, "do_commit", do_commit)
    return broken


@pytest.mark.parametrize("answer_lost", [True, *slow(False)])
def test_database_that_is_away_when_the_scene_is_published(
    world: World,
    brief_drive: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    answer_lost: bool,
) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    runner = Runner(world.settings)
    times = 1 if answer_lost else 3
    broken = break_endings(runner, job_id, monkeypatch, times=times, answer_lost=answer_lost)
    with caplog.at_level(logging.INFO, "mrasfm.worker"):
        runner.run(job_id)
    assert "published" in caplog.messages, "the worker knows that it was itself"
    assert broken == ["SUCCEEDED"] * times
    job = world.job(job_id)
    assert (job.state, job.attempt) == ("SUCCEEDED", 1)
    assert world.outcomes(job_id) == ["succeeded"]
    (scene,) = world.scenes()
    assert scene.id == job.scene_id
    with world.database.read() as session:
        keys = [session.get_one(Blob, file.blob_id).key for file in session.query(SceneFile)]
    assert keys
    assert all(world.artifacts.read(key) is not None for key in keys)


@pytest.mark.slow
def test_database_that_is_away_when_a_check_ends(
    world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive_id, job_id = world.add_unchecked_drive(brief_drive)
    runner = Runner(world.settings)
    broken = break_endings(runner, job_id, monkeypatch, times=2)
    runner.run(job_id)
    assert broken == ["SUCCEEDED"] * 2
    assert (world.job(job_id).attempt, world.drive(drive_id).preflight_state) == (1, "PASSED")


def end_by_failing(world: World, job_id: str) -> None:
    with world.database.write() as session:
        session.delete(session.get_one(Drive, world.job(job_id).drive_id))


def end_by_cancelling(world: World, job_id: str) -> None:
    def cancel() -> None:
        world.wait_for_begin(job_id)
        world.cancel(job_id)

    threading.Thread(target=cancel).start()


@pytest.mark.parametrize(
    ("end", "stops", "states", "outcome"),
    [
        (end_by_failing, False, "FAILED", "drive-deleted"),
        (end_by_cancelling, False, "CANCELLED", "cancelled"),
        (lambda world, job_id: None, True, "QUEUED", "released"),
    ],
)
def test_database_that_is_away_when_an_attempt_ends(
    world: World,
    brief_drive: Path,
    monkeypatch: pytest.MonkeyPatch,
    end: Callable[[World, str], None],
    stops: bool,
    states: str,
    outcome: str,
) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    asked: list[bool] = []
    runner = Runner(world.settings, shutting_down=lambda: stops and (asked.append(True) or len(asked) > 2))
    broken = break_endings(runner, job_id, monkeypatch, times=2)
    end(world, job_id)
    runner.run(job_id)
    assert broken == [states] * 2
    assert (world.job(job_id).state, world.outcomes(job_id)) == (states, [outcome])


def break_statements(
    runner: Runner, monkeypatch: pytest.MonkeyPatch, *parts: str, times: int | None = None
) -> dict[str, int]:
    """Make the database fail as it is given statements with such parts, so many times each or always.

    What is left of these times is returned; it is below zero where such a statement was done.
    """
    dialect = runner._database.engine.dialect
    execute = dialect.do_execute
    left = dict.fromkeys(parts, 10**6 if times is None else times)

    def do_execute(cursor: object, statement: str, *given: object, **options: object) -> None:
        for part in parts:
            if part in statement:
                left[part] -= 1
                if left[part] >= 0:
                    raise sqlite3.OperationalError("the connection is lost")
        execute(cursor, statement, *given, **options)

    monkeypatch.setattr(dialect, "do_execute", do_execute)
    return left


DRIVE_READ, SHELF_READ, WORKERS_READ = "drives.manifest_blob_id", "FROM checkpoints", "FROM workers"


def test_database_that_is_away_when_an_attempt_begins(
    world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As what others left is removed, the drive is brought, its workers are counted, and stages are found again."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    (world.settings.scratch_dir / "job_of_a_dead_process.7").mkdir(parents=True)
    left = {SHELF_READ: 2}
    settings = world.settings.model_copy(update={"submap_workers": None})
    runner = Runner(settings, shutting_down=lambda: left[SHELF_READ] < 0)  # the engine is not needed
    left = break_statements(runner, monkeypatch, DRIVE_READ, SHELF_READ, WORKERS_READ, times=2)
    swept = runner.sweep_scratch
    tries: list[bool] = []

    def sweep_scratch() -> None:
        tries.append(True)
        if len(tries) < 3:
            raise OperationalError("SELECT", {}, sqlite3.OperationalError("the connection is lost"))
        swept()

    monkeypatch.setattr(runner, "sweep_scratch", sweep_scratch)
    runner.run(job_id)
    assert (set(left.values()), len(tries)) == ({-1}, 3), "each was asked for again"
    assert world.outcomes(job_id) == ["released"]
    assert not (world.settings.scratch_dir / "job_of_a_dead_process.7").exists()


def test_database_that_is_away_for_long_when_an_attempt_begins(
    world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is not the job's fault, and costs none of its retries."""
    monkeypatch.setattr("worker.job_execution.RETRY_BUDGET_S", 0.5)
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    runner = Runner(world.settings)
    left = break_statements(runner, monkeypatch, DRIVE_READ)
    runner.run(job_id)
    assert left[DRIVE_READ] <= 10**6 - 2
    job = world.job(job_id)
    assert (job.state, job.blame, job.losses) == ("QUEUED", 0.0, 1)
    (attempt,) = world.attempts(job_id)
    assert attempt.outcome == "database"
    assert attempt.problem is not None
    assert attempt.problem["title"] == "The database did not answer"
    assert "connection is lost" not in json.dumps(attempt.problem)


def test_what_is_not_the_databases_fault_is_not_tried_again(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    held = claimed(world, job_id)
    tries: list[bool] = []

    def wrong(session: Session) -> None:
        tries.append(True)
        session.execute(insert(Job).values(id=job_id, project_id=None, kind="x", drive_id="x"))

    with pytest.raises(IntegrityError):
        commit_with_retry(world.database, held, wrong)
    assert tries == [True]


def test_database_that_stays_away(world: World, brief_drive: Path) -> None:
    held = claimed(world, world.ask(world.add_drive(brief_drive), wake=False))

    def fails(session: Session) -> None:
        session.execute(text("SELECT * FROM nowhere"))

    with pytest.raises(OperationalError):
        commit_with_retry(world.database, held, fails, budget_s=0.5)


def claimed(world: World, job_id: str) -> jobs.Claim:
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="w", lease_us=3600 * 1_000_000)
    assert held is not None
    return held


def test_request_to_cancel_is_seen_between_heartbeats(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    rarely = world.settings.model_copy(update={"heartbeat_seconds": 600.0, "lease_seconds": 3600.0})
    held = claimed(world, job_id)
    stopping = threading.Event()
    with Heartbeat(
        world.database, held, rarely, progress=jobs.ProgressNote, shutting_down=stopping.is_set
    ) as heartbeat:
        assert reason_to_stop(heartbeat) is None
        stopping.set()
        assert reason_to_stop(heartbeat) is StopReason.SHUT_DOWN
        world.cancel(job_id)
        wait_until(lambda: reason_to_stop(heartbeat) is StopReason.CANCEL, "the heartbeat's answer")
        with world.database.write() as session:
            jobs.cancelled(session, held)
        wait_until(lambda: reason_to_stop(heartbeat) is StopReason.FENCED, "the heartbeat's end")


def reason_to_stop(heartbeat: Heartbeat) -> StopReason | None:
    try:
        heartbeat.check_stop()
    except StopRequest as request:
        return request.reason
    return None


def test_new_guess_at_the_end_is_no_news(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    often = world.settings.model_copy(update={"heartbeat_seconds": 0.05})
    note = jobs.ProgressNote(stage="features", done=1, total=2, percent=10.0, eta_low_s=1.0, eta_high_s=2.0)
    notes = [note]
    with Heartbeat(world.database, claimed(world, job_id), often, progress=lambda: notes[-1]):
        wait_until(lambda: world.events(job_id)[-1].kind == "progress", "the first progress")
        first, beaten_us = world.events(job_id)[-1], world.job(job_id).heartbeat_us or 0
        for guess_s in range(5):
            notes.append(dataclasses.replace(note, eta_high_s=3.0 + guess_s))
            time.sleep(0.1)
        wait_until(lambda: (world.job(job_id).heartbeat_us or 0) > beaten_us, "another heartbeat")
    assert world.events(job_id)[-1].id == first.id


def test_job_that_was_taken_away(world: World, brief_drive: Path, caplog: pytest.LogCaptureFixture) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    thread = threading.Thread(target=run, args=(world, job_id))
    thread.start()
    child = world.wait_for_begin(job_id)
    with world.database.write() as session:
        assert jobs.end_lease(session, job_id, 1)
        assert jobs.expire_leases(session, limits=LIMITS) == [job_id]
    thread.join()
    assert is_gone(child)
    assert (world.job(job_id).state, world.outcomes(job_id)) == ("QUEUED", ["worker-lost"])
    assert world.scenes() == []
    lines = [record for record in caplog.records if "not ours" in record.message]
    assert len(lines) == 1


@pytest.mark.parametrize(("noted", "found"), [(0, 0), (-1, 1), (None, None)])
def test_memory_kills_of_a_lost_attempt(world: World, brief_drive: Path, noted: int | None, found: int | None) -> None:
    """Whoever removes its folder compares the kernel's count with that of the attempt's begin."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    now = memory_kills()
    if now is None:
        pytest.skip("the kernel does not count what it kills for lack of memory")
    claimed(world, job_id)
    folder = AttemptFolder(world.settings.scratch_dir / f"{job_id}.1")
    folder.root.mkdir(parents=True)
    if noted is not None:
        MemoryKills(now.counter, now.count + noted).write(folder.memory_kills)
    Runner(world.settings).sweep_scratch()
    assert world.job(job_id).memory_kills == found


@pytest.mark.slow
def test_an_attempt_notes_memory_kills(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    thread = threading.Thread(target=run, args=(world, job_id))
    thread.start()
    world.wait_for_begin(job_id)
    noted = MemoryKills.read(AttemptFolder(world.settings.scratch_dir / f"{job_id}.1").memory_kills)
    wait_until(lambda: world.job(job_id).engine_ran, "the first report of the engine")
    thread.join()
    assert noted == memory_kills()
    assert world.job(job_id).state == "SUCCEEDED"


def test_folders_left_behind(world: World, brief_drive: Path) -> None:
    """Those of live attempts stay, whatever the database says; dead ones' jobs lose their lease."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="one that died", lease_us=3600 * 1_000_000)
    assert held is not None
    scratch = world.settings.scratch_dir
    with process_folder(scratch, "job_of_another_worker.7") as live:
        (scratch / f"{job_id}.1" / "scene").mkdir(parents=True)
        (scratch / f"{job_id}.0").mkdir()
        (scratch / "rubbish").mkdir()
        Runner(world.settings).sweep_scratch()
        assert list(scratch.iterdir()) == [live]
        with world.database.write() as session:
            assert jobs.expire_leases(session, limits=LIMITS) == [job_id]
    assert list(scratch.iterdir()) == []


@pytest.mark.slow
def test_truncated_images_are_named_in_findings_and_report(world: World, own_drive: Path) -> None:
    """Of three images the pixels end at a third, and the end marker is there: the job succeeds without them."""
    images = sorted((own_drive / "images").rglob("*.jpg"))[1:12:4]
    for image in images:
        image.write_bytes(cut(image.read_bytes()))
    names = [image.relative_to(own_drive).as_posix() for image in images]
    drive_id, check_id = world.add_unchecked_drive(own_drive)
    assert run(world, check_id).state == "SUCCEEDED"
    drive = world.drive(drive_id)
    assert drive.preflight_state == "PASSED"
    (found,) = [finding for finding in drive.findings if finding["code"] == "truncated-images"]
    assert all(name in found["what"] for name in names)
    assert run(world, world.ask(drive_id, wake=False)).state == "SUCCEEDED"
    with world.database.read() as session:
        written = session.query(SceneFile).filter_by(path="report.json").one()
        report = json.loads(world.artifacts.read(session.get_one(Blob, written.blob_id).key))
    (found,) = [finding for finding in report["findings"] if finding["code"] == "truncated-images"]
    assert found["severity"] == "warning"
    assert "3 of 12 images are truncated and left out: " in found["what"]
    assert all(name in found["what"] for name in names)
    (scene,) = world.scenes()
    assert scene.summary["warnings"] == len(report["findings"])
    assert scene.summary["registered_images"] == 9
