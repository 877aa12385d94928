"""`mrasfm standalone` as an operator runs it: started, started again where it ended, and stopped in the end."""

from __future__ import annotations

import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import httpx

REPOSITORY = Path(__file__).resolve().parents[3]
HOST = "127.0.0.1"
PORTS = range(30_000, 32_000)  # below those of outgoing connections: a client must not take it while nobody listens
WORKERS = 2
START_WITHIN_S = 180.0
STOP_WITHIN_S = 120.0
_KEY = re.compile(r"API key, shown this once: (\S+)")


class DidNotStartError(Exception):
    """The service is not ready after its time; the message has its last words."""


class Installation:
    """One data folder, and the service that works in it. All times are the defaults."""

    def __init__(self, folder: Path, rng: random.Random, *, workers: int = WORKERS) -> None:
        self._workers = workers
        self.data = folder / "data"
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        self._output = folder / "output"
        self._port = _free_port(rng)
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self._port}"

    @property
    def port(self) -> int:
        return self._port

    @property
    def pid(self) -> int | None:
        """Of the supervisor; None where there is none."""
        with self._lock:
            return None if self._process is None or self._process.poll() is not None else self._process.pid

    @property
    def key(self) -> str:
        """The API key that the first start has printed."""
        found = _KEY.search(self.output)
        assert found is not None, self.output
        return found[1]

    @property
    def output(self) -> str:
        """All that it has printed."""
        return self._output.read_text(encoding="utf-8", errors="replace")

    def start(self) -> float:
        """Start it, again where it cannot be had yet; after how many seconds it was ready.

        Raises
        ------
        DidNotStartError
            Where it is not in time.
        """
        began_s = time.monotonic()
        while time.monotonic() < began_s + START_WITHIN_S:
            if self.pid is None:
                self._launch()
            if self._is_ready():
                return time.monotonic() - began_s
            time.sleep(0.1)
        raise DidNotStartError(self.output[-3000:])

    def _launch(self) -> None:
        own = {name: value for name, value in os.environ.items() if not name.startswith("MRASFM_")}
        given = {"MRASFM_ENGINE_THREADS": "1", "MRASFM_MIN_FREE_DISK_BYTES": "0", "TMPDIR": str(self.temporary)}
        argv = [sys.executable, "-m", "service", "standalone", "--data", str(self.data)]
        argv += ["--port", str(self._port), "--workers", str(self._workers)]
        with self._lock, self._output.open("ab") as output:
            self._process = subprocess.Popen(
                argv, cwd=REPOSITORY, env={**own, **given}, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )

    def _is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=5, trust_env=False).is_success
        except httpx.TransportError:
            return False

    def stop(self) -> int:
        """Stop it in order; its exit code.

        Raises
        ------
        subprocess.TimeoutExpired
            Where it does not end.
        """
        assert self._process is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        return self._process.wait(STOP_WITHIN_S)

    def reap(self) -> None:
        """Take note that the supervisor was killed."""
        assert self._process is not None
        self._process.wait()

    def kill(self) -> None:
        """End the supervisor, where it runs: what it started ends with it."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()


def _free_port(rng: random.Random) -> int:
    while True:
        port = rng.choice(PORTS)
        with closing(socket.socket()) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((HOST, port))
            except OSError:
                continue
            return port
