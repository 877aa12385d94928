"""`mrasfm standalone` with one of its processes killed, or all, while a reconstruction runs."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from service.settings import Settings
from service.standalone.broker import JOURNAL_SET_ASIDE
from tests.helpers.service_world import TERMINAL, wait_until
from tests.helpers.standalone import Standalone, command_of

WORKER_STARTS_WITHIN_S = 90.0


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rendered") / "drive"
    options = SynthOptions(cameras=2, units=4, seed=3, width=320, height=180, texture_px=128)
    return render_drives(options, out)[0]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Standalone]:
    made = Standalone(tmp_path)
    yield made
    made.close()


@pytest.mark.slow
def test_kills(service: Standalone, drive: Path) -> None:
    """Of the stage, the worker, the API, the broker and of everything: each job ends in exactly one scene."""
    service.start()
    drive_id = service.add_drive(drive)
    victims: list[tuple[Callable[[], psutil.Process], int]] = [
        (lambda: service.process_of("worker", "reconstructions"), 2),
        (lambda: service.process_of("service", "api"), 1),
        (lambda: service.broker(), 1),
    ]
    job_ids = []
    for victim, attempts in victims:
        job_ids.append(service.ask(drive_id, seed=len(job_ids)))
        stage = service.hold(job_ids[-1])
        victim().kill()
        if attempts == 1:  # the stage is none of its business
            time.sleep(1)
            assert stage.status() == psutil.STATUS_STOPPED
            stage.resume()
        else:
            wait_until(
                lambda: len(service.job(job_ids[-1])["attempts"]) == 2,
                lambda: service.said(),
                within_s=WORKER_STARTS_WITHIN_S,
            )
        assert_one_scene(service, job_ids, attempts=attempts)

    job_ids.append(service.ask(drive_id, seed=len(job_ids)))
    service.hold(job_ids[-1]).kill()
    assert_one_scene(service, job_ids, attempts=2)

    for supervisor_last in (False, True):
        job_ids.append(service.ask(drive_id, seed=len(job_ids)))
        service.hold(job_ids[-1])
        service.kill_everything(supervisor_last=supervisor_last)
        if supervisor_last:
            service.damage_journal()
        service.start()
        assert_one_scene(service, job_ids, attempts=2)
    assert "its journal is damaged and was moved to" in service.said()
    assert (service.data / "broker" / JOURNAL_SET_ASIDE).is_dir()

    # What a worker held when it died is delivered again after this, if nobody has taken care of it by then.
    jobs = [service.job(job_id) for job_id in job_ids]
    time.sleep(Settings().visibility_timeout_seconds + 10)
    assert [service.job(job_id) for job_id in job_ids] == jobs
    assert_one_scene(service, job_ids, attempts=2)

    assert service.process is not None
    service.process.send_signal(signal.SIGINT)
    assert service.process.wait(60) == 0, service.said()
    assert service.processes() == []


@pytest.mark.slow
def test_supervisor_is_killed(service: Standalone, drive: Path) -> None:
    """Nothing that it started stays behind."""
    service.start()
    job_id = service.ask(service.add_drive(drive), seed=0)
    service.hold(job_id)
    assert len(service.processes()) >= 7
    assert service.process is not None
    service.process.kill()
    service.process.wait()
    wait_until(lambda: service.processes() == [], lambda: f"left: {service.processes()}")
    service.start()
    assert_one_scene(service, [job_id], attempts=2)


def assert_one_scene(service: Standalone, job_ids: list[str], *, attempts: int) -> None:
    """The last of the jobs ends with so many attempts, and there is one scene of each."""
    wait_until(lambda: service.job(job_ids[-1])["state"] in TERMINAL, lambda: f"{service.job(job_ids[-1])}")
    job = service.job(job_ids[-1])
    assert job["state"] == "SUCCEEDED", job
    assert len(job["attempts"]) == attempts
    assert sorted(scene["job_id"] for scene in service.request("GET", "/v1/scenes")["items"]) == sorted(job_ids)
    stages = [p for p in service.processes() if "worker.child" in command_of(p) and job_ids[-1] in str(command_of(p))]
    assert stages == []
