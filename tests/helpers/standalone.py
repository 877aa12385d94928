"""`mrasfm standalone` as its user starts it, and all of its processes."""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil

from service.standalone.broker import JOURNAL
from tests.helpers.live_api import NO_CERTIFICATES
from tests.helpers.service_world import DEADLINE_S, wait_until

ORDER_SEED = 5  # of killing everything


class Standalone:
    """The service over `FOLDER/data`, with nothing set but what keeps it small: all times are the defaults.

    Parameters
    ----------
    key
        An API key that the data folder knows; without one, the folder is new.
    python
        That of the version to start.
    environment
        Further variables of the service.
    """

    def __init__(
        self, folder: Path, *, key: str = "", workers: int = 1, python: Path = Path(sys.executable), **environment: str
    ) -> None:
        self.data = folder / "data"
        self.output = folder / "output"
        self.url = ""
        self.key = key
        self._command = [python, "-P", "-m", "service", "standalone", "--data", self.data, "--port", "0"]
        self._command += ["--workers", str(workers)]
        self._environment = environment
        self.process: subprocess.Popen[bytes] | None = None
        self._client = httpx.Client(timeout=30, trust_env=False, verify=NO_CERTIFICATES)

    def start(self) -> None:
        environment = {
            **os.environ,
            "MRASFM_DATA_DIR": str(self.data),
            "MRASFM_ENGINE_THREADS": "1",
            "MRASFM_MIN_FREE_DISK_BYTES": "0",
            **self._environment,
        }
        with self.output.open("wb") as output:
            process = self.process = subprocess.Popen(self._command, env=environment, stdout=output, stderr=output)
        wait_until(lambda: "ready at" in self.said() or process.poll() is not None, self.said)
        self.url = found(r"ready at (\S+)", self.said())
        if not self.key:
            self.key = found(r"API key, shown this once: (\S+)", self.said())

    def said(self) -> str:
        return self.output.read_text(encoding="utf-8")

    def request(self, method: str, path: str, **arguments: Any) -> Any:
        """The answer's JSON."""
        answer = self.answer(method, path, **arguments)
        assert answer.is_success, answer.text
        return answer.json()

    def answer(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """The answer; an API that is just being started again is asked again."""
        deadline_s = time.monotonic() + DEADLINE_S
        while True:
            try:
                headers = {"Authorization": f"Bearer {self.key}"}
                return self._client.request(method, self.url + path, headers=headers, **arguments)
            except httpx.TransportError:
                assert time.monotonic() < deadline_s, "the API does not answer"
                time.sleep(0.1)

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

    def close(self) -> None:
        """Kill what is left."""
        self._client.close()
        for process in self.processes():
            process.kill()
        if self.process is not None:
            self.process.wait()


def command_of(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def found(pattern: str, text: str) -> str:
    match = re.search(pattern, text)
    assert match is not None, text
    return match[1]
