"""Processes killed while a job runs: it ends in exactly one scene, and nothing is left running."""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from pydantic import SecretStr
from sqlalchemy import select

from schemas.api.problems import PROBLEM_TYPE
from service.database.tables import Blob, Checkpoint, SceneFile, WorkerSeen
from service.job_queue import JobQueue
from service.settings import Settings
from tests.helpers.service_world import SHORT_TIMES, World, environment_of, is_gone, kill, wait_until
from tests.helpers.slow import slow


def assert_one_scene(world: World, job_id: str, outcomes: list[str]) -> None:
    job = world.wait_for_end(job_id)
    assert job.state == "SUCCEEDED", job.problem
    assert world.outcomes(job_id) == outcomes
    (scene,) = world.scenes()
    assert (scene.id, scene.fence) == (job.scene_id, len(outcomes))
    wait_until(lambda: world.children() == [], "the end of all stages")
    wait_until(lambda: list(world.settings.scratch_dir.iterdir()) == [], "the end of the scratch folders")


def pool_process_of(main_pid: int) -> psutil.Process:
    """The process that a worker's main process runs jobs in."""
    found: list[psutil.Process] = []

    def look() -> bool:
        found[:] = psutil.Process(main_pid).children()
        return len(found) == 1

    wait_until(look, "a pool process")
    return found[0]


def test_stage_is_killed(world: World, brief_drive: Path) -> None:
    world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id).kill()
    assert_one_scene(world, job_id, ["engine-killed", "succeeded"])


@pytest.mark.slow
def test_worker_is_killed(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """Main process alone: what it started dies with it, and another machine goes on after the last finished stage."""
    first = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.wait_for_begin(job_id)
    finished = world.settings.scratch_dir / f"{job_id}.1" / "scene" / ".stages" / "features.npz"
    wait_until(finished.exists, "a finished stage")
    child.suspend()
    wait_until(lambda: "features.npz" in checkpoints(world), "its safe-keeping")
    second = world.start_worker(settings=on_another_machine(world, tmp_path / "elsewhere"))
    first.kill()
    first.wait()
    wait_until(lambda: is_gone(child), "the end of its stage")
    took_s = wait_until(lambda: len(world.attempts(job_id)) == 2, "another attempt", within_s=60)
    assert took_s > 1.0, "nobody takes a job before its lease has ended"
    job = world.wait_for_end(job_id)
    assert job.state == "SUCCEEDED", job.problem
    assert world.outcomes(job_id) == ["worker-lost", "succeeded"]
    assert "features" in job.reused
    stages = {stage["stage"]: stage["reused"] for stage in report_of(world)["stages"]}
    assert stages["features"] is True
    assert stages["refinement"] is False
    online = known_workers(world)
    second.terminate()
    second.wait(60)
    assert len(known_workers(world)) == len(online) - 1, "one that was told to stop is not missed"


def known_workers(world: World) -> set[str]:
    with world.database.read() as session:
        return set(session.scalars(select(WorkerSeen.name)))


@pytest.mark.slow
def test_worker_is_killed_with_the_default_times(make_world: Callable[..., World], brief_drive: Path) -> None:
    defaults = {name: Settings.model_fields[name].default for name in SHORT_TIMES}
    world = make_world(**defaults)
    first = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    world.start_worker()
    first.kill()
    took_s = wait_until(lambda: len(world.attempts(job_id)) == 2, "another attempt", within_s=90)
    print(f"another attempt began {took_s:.1f} s after the worker's main process was killed")
    assert took_s > 10.0
    assert_one_scene(world, job_id, ["worker-lost", "succeeded"])


@pytest.mark.slow  # so is this
def test_worker_that_is_started_again_ends_the_lease(make_world: Callable[..., World], brief_drive: Path) -> None:
    """As its supervisor does: nobody waits for the lease, which would take ten minutes here."""
    world = make_world(lease_seconds=600)
    first = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    first.kill()
    first.wait()
    world.start_worker()
    assert_one_scene(world, job_id, ["worker-lost", "succeeded"])


@pytest.mark.slow
def test_pool_process_is_killed(make_world: Callable[..., World], brief_drive: Path) -> None:
    """The message comes back at once and finds the lease; the process that takes the dead one's place ends it.

    That one dies with the main process as its predecessor would have.
    """
    world = make_world(lease_seconds=600)
    main = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.hold(job_id)
    pool = pool_process_of(main.pid)
    assert child.parent() == pool
    pool.kill()
    wait_until(lambda: is_gone(child), "the end of its stage")
    second = world.hold(job_id)
    replacement = second.parent()
    assert replacement is not None
    assert replacement.pid not in (pool.pid, main.pid)
    main.kill()
    wait_until(lambda: is_gone(second) and is_gone(replacement), "the end of what it started")
    world.start_worker()
    assert_one_scene(world, job_id, ["worker-lost", "worker-lost", "succeeded"])


@pytest.mark.slow  # and so is this
def test_broker_is_killed(world: World, brief_drive: Path) -> None:
    """The job under way goes on, and after the broker's return the worker takes the next one."""
    worker = world.start_worker()
    world.start_reconciler()
    drive_id = world.add_drive(brief_drive)
    first = world.ask(drive_id)
    child = world.hold(first)
    world.broker.kill()
    second = world.ask(drive_id, wake=False, seed=7)
    time.sleep(world.settings.lease_seconds + 1)
    assert (world.job(first).state, world.job(first).attempt) == ("RUNNING", 1)
    assert world.children() == [child]
    child.resume()
    assert world.wait_for_end(first).state == "SUCCEEDED"  # while there is no broker
    world.broker.start()
    wait_until(lambda: world.job(second).state != "QUEUED", "the second job's begin", within_s=30)
    assert world.wait_for_end(second).state == "SUCCEEDED"
    assert world.outcomes(first) == world.outcomes(second) == ["succeeded"]
    assert {scene.job_id for scene in world.scenes()} == {first, second}
    assert worker.poll() is None


@pytest.mark.slow  # `mrasfm standalone` is tested so too
def test_everything_is_killed(world: World, brief_drive: Path) -> None:
    processes = [world.start_worker(), world.start_reconciler()]
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    world.broker.kill()
    for process in processes:
        process.kill()
    wait_until(lambda: world.processes() == [], "the end of everything")
    world.broker.start()
    world.start_worker()
    world.start_reconciler()
    assert_one_scene(world, job_id, ["worker-lost", "succeeded"])


@pytest.mark.slow
def test_killed_worker_leaves_no_temporary_files(
    world: World, brief_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Celery's pool makes some; they lie in the data folder, and the next worker removes those of dead ones."""
    of_machine, of_workers = tmp_path / "temporary", world.settings.temporary_dir
    of_machine.mkdir()
    monkeypatch.setenv("TMPDIR", str(of_machine))
    first = world.start_worker()
    world.start_reconciler()
    world.hold(world.ask(world.add_drive(brief_drive)))
    (of_first,) = of_workers.iterdir()
    first.kill()
    first.wait()
    wait_until(lambda: world.children() == [], "the end of what it started")
    second = world.start_worker()
    (of_second,) = of_workers.iterdir()
    assert of_second != of_first
    second.terminate()
    second.wait()
    assert list(of_machine.iterdir()) == list(of_workers.iterdir()) == []


@pytest.mark.slow
def test_stage_gives_way_to_the_service(world: World, brief_drive: Path) -> None:
    worker = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.hold(job_id)
    assert child.nice() > pool_process_of(worker.pid).nice()
    child.resume()
    assert_one_scene(world, job_id, ["succeeded"])


def kill_stages(world: World, job_id: str, number: int, by: signal.Signals) -> list[int]:
    """End the stages of so many attempts, one after the other, by a signal; their process ids."""
    killed: list[int] = []
    while len(killed) < number:
        child = world.wait_for_child(job_id)
        if child.pid not in killed:
            child.send_signal(by)
            killed.append(child.pid)
            wait_until(lambda: is_gone(child), "its end")  # noqa: B023 (called at once)
    return killed


def test_stage_that_dies_every_time(world: World, brief_drive: Path) -> None:
    world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    kill_stages(world, job_id, world.settings.max_attempts, signal.SIGSEGV)
    job = world.wait_for_end(job_id)
    assert (job.state, job.attempt) == ("FAILED", 3)
    assert job.problem is not None
    assert job.problem["type"] == PROBLEM_TYPE + "engine-abort"
    assert job.problem["remedy"]
    assert world.outcomes(job_id) == ["engine-abort"] * 3
    assert all(attempt.problem and attempt.finished_us for attempt in world.attempts(job_id))
    assert world.scenes() == []


@pytest.mark.slow
def test_kills_alone_fail_no_job(world: World, brief_drive: Path) -> None:
    """More of them than a job has retries."""
    world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    number = world.settings.max_attempts + 1
    assert len(kill_stages(world, job_id, number, signal.SIGKILL)) == number
    assert_one_scene(world, job_id, [*["engine-killed"] * number, "succeeded"])


@pytest.mark.slow
def test_worker_that_was_silent_publishes_nothing(world: World, brief_drive: Path) -> None:
    """It is stopped with all that it started until another has done the job, and then goes on."""
    first = world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.wait_for_child(job_id)
    stopped = [psutil.Process(first.pid), pool_process_of(first.pid), child]
    for process in stopped:
        process.suspend()
    world.start_reconciler()
    world.start_worker()
    job = world.wait_for_end(job_id)
    assert (job.state, job.fence) == ("SUCCEEDED", 2)
    assert not is_gone(child), "the other worker leaves it alone"
    for process in stopped:
        with suppress(psutil.NoSuchProcess):  # who goes on first may end the others
            process.resume()
    assert_one_scene(world, job_id, ["worker-lost", "succeeded"])
    wait_until(lambda: '"the job is not ours any more; nothing was published"' in world.log(), "the first one notices")
    assert first.poll() is None


@pytest.mark.slow
def test_worker_is_told_to_stop(world: World, brief_drive: Path) -> None:
    """The job is given back at once, and the attempt does not count."""
    first = world.start_worker()
    world.start_reconciler()
    job_id = world.ask(world.add_drive(brief_drive))
    world.wait_for_begin(job_id)
    first.terminate()
    began_s = time.monotonic()
    first.wait(60)
    assert time.monotonic() - began_s < 30  # 3 s on an idle machine
    assert first.returncode == 0
    assert (world.job(job_id).state, world.job(job_id).blame) == ("QUEUED", 0)
    world.start_worker()
    assert_one_scene(world, job_id, ["released", "succeeded"])
    assert (world.job(job_id).attempt, world.job(job_id).blame) == (2, 0)
    wait_until(lambda: not JobQueue(world.settings).waiting(), "no message is left behind")


@pytest.mark.parametrize("signals", [["SIGQUIT"], *slow(["SIGTERM", "SIGTERM"], ["SIGTERM", "SIGQUIT"])])
def test_impatient_stop(world: World, brief_drive: Path, signals: list[str]) -> None:
    """With a stage that does not listen: the job is given back all the same."""
    worker = world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    for name in signals:
        worker.send_signal(getattr(signal, name))
        time.sleep(0.3)
    worker.wait(60)
    wait_until(lambda: world.processes() == [], "the end of everything")
    assert world.outcomes(job_id) == ["released"]
    assert (world.job(job_id).state, world.job(job_id).blame) == ("QUEUED", 0)


def test_all_of_a_worker_is_told_to_stop(world: World, brief_drive: Path) -> None:
    """As a service manager does, which signals every process of a service."""
    worker = world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    for process in [*psutil.Process(worker.pid).children(recursive=True), psutil.Process(worker.pid)]:
        with contextlib.suppress(psutil.NoSuchProcess):  # it may have ended with one that was signalled before
            process.terminate()
    worker.wait(60)
    wait_until(lambda: world.processes() == [], "the end of everything")
    assert world.outcomes(job_id) == ["released"]
    assert world.job(job_id).state == "QUEUED"


def test_cancel_with_no_worker(world: World, brief_drive: Path) -> None:
    job_id = world.ask(world.add_drive(brief_drive))
    world.cancel(job_id)
    assert world.job(job_id).state == "CANCELLED"
    world.start_worker()
    world.start_reconciler()
    wait_until(lambda: "nothing to do" in world.log(), "the message's end")
    assert world.job(job_id).state == "CANCELLED"
    assert world.attempts(job_id) == []


def test_cancel_while_it_runs(world: World, brief_drive: Path) -> None:
    world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.wait_for_begin(job_id)
    world.cancel(job_id)
    assert world.wait_for_end(job_id).state == "CANCELLED"
    assert world.outcomes(job_id) == ["cancelled"]
    wait_until(lambda: is_gone(child), "the end of its stage")
    assert world.scenes() == []


@pytest.mark.slow
def test_cancel_of_a_stage_that_hangs(world: World, brief_drive: Path) -> None:
    """A stopped process acts neither on the request nor on SIGTERM."""
    world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    child = world.hold(job_id)
    world.cancel(job_id)
    assert world.wait_for_end(job_id).state == "CANCELLED"
    wait_until(lambda: is_gone(child), "the end of its stage")
    wait_until(lambda: list(world.settings.scratch_dir.iterdir()) == [], "the end of the scratch folder")


@pytest.mark.slow
def test_cancel_when_the_worker_is_dead(world: World, brief_drive: Path) -> None:
    worker = world.start_worker()
    job_id = world.ask(world.add_drive(brief_drive))
    world.hold(job_id)
    kill(worker.pid)
    worker.wait()
    world.cancel(job_id)
    assert world.job(job_id).state == "RUNNING"  # nobody knows yet that its worker is dead
    world.start_reconciler()
    assert world.wait_for_end(job_id).state == "CANCELLED"
    assert world.outcomes(job_id) == ["cancelled"]


def on_another_machine(world: World, data_dir: Path) -> Settings:
    """Settings of a worker with scratch of its own; database, broker and artifacts are the world's."""
    shared = environment_of(world.settings)
    return Settings(
        data_dir=data_dir,
        database_url=SecretStr(shared["MRASFM_DATABASE_URL"]),
        artifacts_url=shared["MRASFM_ARTIFACTS_URL"],
        redis_url=world.settings.redis_url,
        **SHORT_TIMES,
    )


def checkpoints(world: World) -> set[str]:
    with world.database.read() as session:
        return {row.name for row in session.query(Checkpoint)}


def report_of(world: World) -> dict[str, list[dict[str, object]]]:
    (scene,) = world.scenes()
    with world.database.read() as session:
        file = session.get_one(SceneFile, (scene.id, "report.json"))
        key = session.get_one(Blob, file.blob_id).key
    read: dict[str, list[dict[str, object]]] = json.loads(world.artifacts.read(key))
    return read
