"""The reconstruction of a long drive as a tree of jobs, with the real engine."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from mrasfm_engine.pipeline import reconstruct
from schemas.artifacts import SUBMAP_STAGES, checkpoint_file, submap_checkpoint
from service.database.tables import Blob, Checkpoint, Job, SceneFile, now_us
from service.domain.jobs import number_of
from tests.helpers.service_world import FAST, World, is_gone, wait_until
from tests.helpers.submap_stages import stages_run_in_join
from worker.engine_settings import engine_config
from worker.job_execution import Runner

SUBMAPS = 3


def submaps_of(world: World, job_id: str) -> list[Job]:
    with world.database.read() as session:
        found = session.scalars(select(Job).where(Job.parent_id == job_id)).all()
    return sorted(found, key=number_of)


def report_of(world: World) -> dict[str, Any]:
    with world.database.read() as session:
        key = session.scalars(select(Blob.key).join(SceneFile).where(SceneFile.path == "report.json")).one()
    found: dict[str, Any] = json.loads(world.artifacts.read(key))
    return found


def checkpoints(world: World) -> set[str]:
    with world.database.read() as session:
        return set(session.scalars(select(Checkpoint.name)))


def own_stages(submap: Job) -> set[str]:
    return {checkpoint_file(submap_checkpoint(number_of(submap), stage)) for stage in SUBMAP_STAGES}


def in_one_piece(drive: Path, out: Path) -> dict[str, Any]:
    """The report of the same reconstruction by one process."""
    reconstruct(drive, out, engine_config({**FAST, "submaps": SUBMAPS}, threads=1))
    found: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    return found


def assert_same_scene(world: World, job: Job, whole: dict[str, Any]) -> None:
    (scene,) = world.scenes()
    assert scene.id == job.scene_id
    report = report_of(world)
    assert stages_run_in_join(report) == []
    assert report["summary"]["registered_units"] == whole["summary"]["registered_units"] > 30
    assert report["summary"]["points"] == whole["summary"]["points"]


@pytest.mark.slow
def test_a_tree_of_jobs(make_world: Callable[..., World], long_drive: Path, tmp_path: Path) -> None:
    """Every sub-map needs its own files alone, and the join repeats nothing."""
    world = make_world(submap_workers=2)
    drive_id = world.add_drive(long_drive)
    job_id = world.ask(drive_id, wake=False, submaps=SUBMAPS)
    Runner(world.settings).run(job_id)
    parent = world.job(job_id)
    assert (parent.state, parent.waiting_for, parent.stage, parent.blame) == ("QUEUED", SUBMAPS, "submaps", 0)
    found = submaps_of(world, job_id)
    assert [number_of(job) for job in found] == [1, 2, 3]
    for submap in reversed(found):
        assert world.job(job_id).waiting_for > 0
        Runner(world.settings).run(submap.id)
        ended = world.job(submap.id)
        assert (ended.state, ended.percent) == ("SUCCEEDED", 100.0), ended.problem
        assert own_stages(submap) <= checkpoints(world)
    Runner(world.settings).run(job_id)
    parent = world.job(job_id)
    assert parent.state == "SUCCEEDED", parent.problem
    assert world.outcomes(job_id) == ["planned", "succeeded"]
    percents = [event.data["percent"] for event in world.events(job_id)]
    assert percents == sorted(percents)
    assert_same_scene(world, parent, in_one_piece(long_drive, tmp_path / "whole"))
    assert list(world.settings.scratch_dir.iterdir()) == []


@pytest.mark.slow
def test_workers_wake_one_another_up(make_world: Callable[..., World], long_drive: Path) -> None:
    """A tree gets to its end by the workers alone: no job of it waits for the next pass of the reconciler."""
    world = make_world(submap_workers=2)
    world.start_worker()
    job_id = world.ask(world.add_drive(long_drive), submaps=2)
    assert world.wait_for_end(job_id).state == "SUCCEEDED"
    assert world.outcomes(job_id) == ["planned", "succeeded"]
    assert [job.enqueued_us is not None for job in submaps_of(world, job_id)] == [True] * 2


@pytest.mark.slow
def test_a_worker_is_killed_in_a_sub_map(make_world: Callable[..., World], long_drive: Path, tmp_path: Path) -> None:
    """It costs the stage that was under way: what the sub-map had finished is found again, elsewhere too."""
    world = make_world()  # the drive is cut for the workers that are there
    first, second = world.start_worker(), world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(long_drive), submaps=SUBMAPS)
    wait_until(lambda: submaps_of(world, job_id) != [], lambda: f"the plan\n{world.log()}")
    assert len(submaps_of(world, job_id)) == SUBMAPS

    def extracted() -> list[Job]:
        """Sub-maps whose features are safe, and which go on."""
        kept = checkpoints(world)
        return [
            job
            for job in submaps_of(world, job_id)
            if job.state == "RUNNING" and checkpoint_file(submap_checkpoint(number_of(job), "features")) in kept
        ]

    wait_until(lambda: extracted() != [], lambda: f"a finished stage\n{world.log()}")
    victim = extracted()[0]
    child = world.wait_for_child(victim.id)
    child.suspend()
    owner = int((victim.owner or "").rpartition(":")[2])
    for worker in (first, second):
        if owner in {process.pid for process in world.processes() if process.ppid() == worker.pid}:
            worker.kill()
            worker.wait()
    wait_until(lambda: is_gone(child), "the end of its stage")
    job = world.wait_for_end(job_id)
    assert job.state == "SUCCEEDED", job.problem
    assert world.outcomes(job_id) == ["planned", "succeeded"]
    outcomes = {submap.id: world.outcomes(submap.id) for submap in submaps_of(world, job_id)}
    assert outcomes.pop(victim.id) == ["worker-lost", "succeeded"]
    assert list(outcomes.values()) == [["succeeded"]] * (SUBMAPS - 1)
    assert "features" in world.job(victim.id).reused
    assert_same_scene(world, job, in_one_piece(long_drive, tmp_path / "whole"))


@pytest.mark.slow
def test_a_store_that_is_away_as_a_sub_map_ends(make_world: Callable[..., World], long_drive: Path) -> None:
    """What others would not find is not finished: the attempt failed, and the next one ends the job."""
    world = make_world(submap_workers=2)
    job_id = world.ask(world.add_drive(long_drive), wake=False, submaps=SUBMAPS)
    Runner(world.settings).run(job_id)
    submap = submaps_of(world, job_id)[0]
    thread = threading.Thread(target=Runner(world.settings).run, args=(submap.id,))
    thread.start()
    child = world.hold(submap.id)
    store = world.settings.data_dir / "artifacts"
    store.rename(store.with_name("away"))
    store.touch()
    child.resume()
    thread.join()
    assert (world.job(submap.id).state, world.outcomes(submap.id)) == ("QUEUED", ["storage"])
    assert own_stages(submap) & checkpoints(world) == set()
    assert world.job(job_id).state == "QUEUED"
    store.unlink()
    store.with_name("away").rename(store)
    wait_until(lambda: world.job(submap.id).not_before_us < now_us(), "its turn")
    Runner(world.settings).run(submap.id)
    assert world.outcomes(submap.id) == ["storage", "succeeded"]
    assert own_stages(submap) <= checkpoints(world)
