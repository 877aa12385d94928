"""What a worker does with one job, in this process: only the stages are processes of their own."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr

from mrasfm_engine.cli import main
from schemas.api.problems import PROBLEM_TYPE
from service.persistence import jobs
from service.persistence.tables import Blob, Checkpoint, Drive, DriveFile, Job
from tests.worker.service_world import World, is_gone
from worker.execution import Runner
from worker.scratch import attempt_folder


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Records and files alone; messages are not needed."""
    made = World(tmp_path)
    yield made
    made.close()


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


def test_stages_are_found_again_on_another_machine(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """The drive lies elsewhere there; database and artifacts are the same. Other settings are other stages."""
    drive_id = world.add_drive(brief_drive)
    run(world, world.ask(drive_id, wake=False))
    elsewhere = {
        "data_dir": tmp_path / "another machine",
        "artifacts_url": world.settings.resolved_artifacts_url,
        "database_url": SecretStr(world.settings.resolved_database_url),
    }
    assert run(world, world.ask(drive_id, wake=False), **elsewhere).reused == ["features", "matches", "mapping"]
    with world.database.read() as session:
        assert session.query(Checkpoint).count() == 3
    other = run(world, world.ask(drive_id, wake=False, max_keypoints=500))
    assert (other.state, other.reused) == ("SUCCEEDED", [])


def test_preflight_of_a_sound_drive(world: World, brief_drive: Path) -> None:
    drive_id, job_id = world.add_unchecked_drive(brief_drive)
    assert run(world, job_id).state == "SUCCEEDED"
    drive = world.drive(drive_id)
    assert drive.preflight_state == "PASSED"
    assert all(finding["severity"] == "warning" for finding in drive.findings)


def test_unsound_drive(world: World, own_drive: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Its check rejects it; a reconstruction asked for meanwhile fails at once with the same words as the command."""
    images = sorted((own_drive / "images").rglob("*.jpg"))
    for image in images[:2]:
        image.write_bytes(image.read_bytes()[:-2000])
    assert main(["reconstruct", str(own_drive), "--out", str(tmp_path / "scene")]) == 2
    words = capfd.readouterr().err
    drive_id, check_id = world.add_unchecked_drive(own_drive)
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
    assert drive.findings == problem["findings"]
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
    assert (job.state, job.attempt, job.fence) == ("QUEUED", 0, 1)
    assert world.outcomes(job_id) == ["released"]
    assert world.children() == []


def test_job_that_was_taken_away(world: World, brief_drive: Path, caplog: pytest.LogCaptureFixture) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    thread = threading.Thread(target=run, args=(world, job_id))
    thread.start()
    child = world.wait_for_begin(job_id)
    with world.database.write() as session:
        assert jobs.end_lease(session, job_id, 1)
        assert jobs.expire_leases(session, max_attempts=3) == [job_id]
    thread.join()
    assert is_gone(child)
    assert (world.job(job_id).state, world.outcomes(job_id)) == ("QUEUED", ["worker-lost"])
    assert world.scenes() == []
    lines = [record for record in caplog.records if "not ours" in record.message]
    assert len(lines) == 1


def test_folders_left_behind(world: World, brief_drive: Path) -> None:
    """Those of live attempts stay, whatever the database says; dead ones' jobs lose their lease."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="one that died", lease_us=3600 * 1_000_000)
    assert held is not None
    scratch = world.settings.scratch_dir
    with attempt_folder(scratch, "job_of_another_worker.7") as live:
        (scratch / f"{job_id}.1" / "scene").mkdir(parents=True)
        (scratch / f"{job_id}.0").mkdir()
        (scratch / "rubbish").mkdir()
        Runner(world.settings).sweep_scratch()
        assert list(scratch.iterdir()) == [live]
        with world.database.write() as session:
            assert jobs.expire_leases(session, max_attempts=3) == [job_id]
    assert list(scratch.iterdir()) == []
