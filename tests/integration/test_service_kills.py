"""`mrasfm standalone` with one of its processes killed, or all, while a reconstruction runs."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions
from service.settings import Settings
from service.standalone.broker import JOURNAL, JOURNAL_SET_ASIDE

DEADLINE_S = 120.0
WORKER_STARTS_WITHIN_S = 90.0
TERMINAL = ("SUCCEEDED", "FAILED", "CANCELLED")
ORDER_SEED = 5  # of killing everything


class Standalone:
    """The service, with nothing set but what keeps it small: all times are the defaults."""

    def __init__(self, folder: Path) -> None:
        self.data = folder / "data"
        self.output = folder / "output"
        self.url = ""
        self._key = ""
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = {
            **os.environ,
            "MRASFM_DATA_DIR": str(self.data),
            "MRASFM_ENGINE_THREADS": "1",
            "MRASFM_MIN_FREE_DISK_BYTES": "0",
        }
        with self.output.open("wb") as output:
            command = [sys.executable, "-m", "service", "standalone", "--data", str(self.data), "--port", "0"]
            self.process = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
        wait_until(lambda: "ready at" in self.said(), self.said)
        self.url = found(r"ready at (\S+)", self.said())
        if not self._key:
            self._key = found(r"API key, shown this once: (\S+)", self.said())

    def said(self) -> str:
        return self.output.read_text(encoding="utf-8")

    def request(self, method: str, path: str, **arguments: Any) -> Any:
        """The answer; an API that is just being started again is asked again."""
        deadline_s = time.monotonic() + DEADLINE_S
        while True:
            try:
                headers = {"Authorization": f"Bearer {self._key}"}
                answer = httpx.request(method, self.url + path, headers=headers, timeout=30, **arguments)
            except httpx.TransportError:
                assert time.monotonic() < deadline_s, "the API does not answer"
                time.sleep(0.1)
            else:
                assert answer.is_success, answer.text
                return answer.json()

    def add_drive(self, folder: Path) -> str:
        drive_id = self.request("POST", "/v1/drives", content=(folder / "drive.json").read_bytes())["id"]
        for path in [*(folder / "images").rglob("*.jpg"), *(folder / "masks").rglob("*.png")]:
            name = path.relative_to(folder).as_posix()
            self.request("PUT", f"/v1/drives/{drive_id}/files/{name}", content=path.read_bytes())
        self.request("POST", f"/v1/drives/{drive_id}:commit")
        return str(drive_id)

    def ask(self, drive_id: str, seed: int) -> str:
        """Ask for a reconstruction that differs from all with other seeds, so that it has no finished stage."""
        settings = {"max_keypoints": 600 + seed, "seed": seed}
        return str(self.request("POST", "/v1/reconstructions", json={"drive_id": drive_id, "settings": settings})["id"])

    def job(self, job_id: str) -> dict[str, Any]:
        return dict(self.request("GET", f"/v1/jobs/{job_id}"))

    def processes(self) -> list[psutil.Process]:
        """Everything that belongs to it."""
        mine = []
        for process in psutil.process_iter():
            try:
                if process.status() == psutil.STATUS_ZOMBIE or process.pid == os.getpid():
                    continue
                # The broker writes its title over both of the others.
                words = [*process.cmdline(), process.environ().get("MRASFM_DATA_DIR", ""), process.cwd()]
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
            if any(str(self.data) in word for word in words):
                mine.append(process)
        return mine

    def process_of(self, *words: str) -> psutil.Process:
        """The one with these words in its command, and of several the one that started the others."""
        matching = [process for process in self.processes() if set(words) <= set(process.cmdline())]
        return next(process for process in matching if process.parent() not in matching)

    def broker(self) -> psutil.Process:
        """The broker's only process."""
        (process,) = [process for process in self.processes() if process.cwd() == str(self.data / "broker")]
        return process

    def kill_everything(self, *, supervisor_last: bool) -> None:
        """Every process there is, in an order of its own each time; the supervisor has time to start some again."""
        assert self.process is not None
        victims = self.processes()
        random.Random(ORDER_SEED).shuffle(victims)
        victims.sort(key=lambda process: (process.pid == self.process.pid) == supervisor_last)
        for process in victims:
            with suppress(psutil.NoSuchProcess):  # gone with another
                process.kill()
            time.sleep(0.1)
        self.process.wait()
        wait_until(lambda: self.processes() == [], lambda: f"left: {self.processes()}")

    def damage_journal(self) -> None:
        """As a power cut does: the file has its size, and not its data."""
        (journal,) = (self.data / "broker" / JOURNAL).glob("*.incr.aof")
        with journal.open("ab") as file:
            file.write(bytes(512))

    def hold(self, job_id: str) -> psutil.Process:
        """Stop a job's stage in its tracks once it works."""
        stage: list[psutil.Process] = []

        def look() -> bool:
            stage[:] = [p for p in self.processes() if any(job_id in word for word in command_of(p))]
            return bool(stage) and any("numpy" in mapped.path for mapped in stage[0].memory_maps())

        wait_until(look, lambda: f"{self.job(job_id)}\n{self.said()}")
        stage[0].suspend()
        return stage[0]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rendered") / "drive"
    options = SynthOptions(cameras=2, units=4, seed=3, width=320, height=180, texture_px=128)
    return render_drives(options, out)[0]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Standalone]:
    made = Standalone(tmp_path)
    yield made
    for process in made.processes():
        process.kill()
    if made.process is not None:
        made.process.wait()


@pytest.mark.slow
def test_kills(service: Standalone, drive: Path) -> None:
    """Of the stage, the worker, the API, the broker and of everything: each job ends in exactly one scene."""
    service.start()
    drive_id = service.add_drive(drive)
    victims: list[tuple[Callable[[], psutil.Process], int]] = [
        (lambda: service.process_of("worker", "reconstructions"), 2),
        (lambda: service.process_of("service", "api"), 1),
        (lambda: service.standalone.broker(), 1),
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


def command_of(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def found(pattern: str, text: str) -> str:
    match = re.search(pattern, text)
    assert match is not None, text
    return match[1]


def wait_until(is_so: Callable[[], bool], told: Callable[[], str], *, within_s: float = DEADLINE_S) -> None:
    end_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < end_s, told()
        time.sleep(0.05)
