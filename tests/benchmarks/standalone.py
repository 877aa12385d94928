"""A whole service of its own for a measurement."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from service.storage.data_folder import write_private_file
from tests.benchmarks.commands import mrasfm
from tests.helpers.live_api import free_port, wait_until

REPOSITORY = Path(__file__).resolve().parents[2]


@contextmanager
def standalone(folder: Path) -> Iterator[tuple[str, Path]]:
    """A whole service, and the file with a key for it."""
    folder.mkdir()
    key_file = folder / "key"
    write_private_file(key_file, mrasfm("keys", "--data", folder / "data", "create"))
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    argv = [sys.executable, "-m", "service", "standalone", "--data", str(folder / "data"), "--port", str(port)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MRASFM_")}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(argv, cwd=REPOSITORY, env=environment, stdout=log, stderr=log)
    try:
        wait_until(lambda: _is_ready(url), "the service's start")
        yield url, key_file
    finally:
        process.terminate()
        process.wait(timeout=120)


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz").is_success
    except httpx.TransportError:
        return False  # nobody listens yet
