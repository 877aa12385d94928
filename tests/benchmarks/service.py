"""Line 5: the service gives what the command gives, bears load, and answers what it says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from mrasfm_engine.io.trajectory_file import read_tum
from service.data_folder import write_private_file
from tests.benchmarks.commands import CommandFailed, mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.service_load import FUZZED_REQUESTS, MAX_RSS_BYTES, MIN_RATE_RATIO
from tests.benchmarks.table import Figure, exactly
from tests.service.live_api import free_port, wait_until

REPOSITORY = Path(__file__).resolve().parents[2]
DRIVE = "kitti06"
DIFFERENCE_M = 0.02
OF_MAPS = (
    ("tests/worker/test_map_over_http.py", "seven drives over HTTP, one broken, a worker killed: one map of six"),
    ("tests/service/test_upload_kills.py", "an upload whose API is killed at 50 random bytes has the right digest"),
)


def service(data: Path, work: Path) -> Iterator[Figure]:
    """Line 5."""
    yield from _same_scene(data, work)
    load = _figures_of("tests.benchmarks.service_load")
    yield Figure(
        line="5",
        what="500 files, 1 GB: rate against one process that hashes and writes",
        value=load["rate_ratio"],
        above=MIN_RATE_RATIO,
        most=10.0,
        remark=f"{load['upload_mb_per_s']} against {load['hash_and_write_mb_per_s']} MB/s; with fsync "
        f"{load['hash_write_and_sync_mb_per_s']} MB/s",
    )
    yield Figure(
        line="5",
        what="the same: peak memory of the API",
        value=load["api_peak_rss_mb"],
        unit="MB",
        most=MAX_RSS_BYTES / 1e6,
    )
    yield exactly("5", "50 clients at once: failures + 1", len(load["clients_failures"]) + 1, 1)
    fuzzed = _figures_of("tests.benchmarks.service_load", "--fuzz")
    yield Figure(
        line="5",
        what="requests made by schemathesis, all answered as documented",
        value=fuzzed["fuzzed_requests"] if fuzzed["passed"] else 0,
        above=FUZZED_REQUESTS - 1,
        most=1e6,
    )
    yield _passed("5", "long tests, of crashes and leases among them", "tests", *(f"--ignore={t}" for t, _ in OF_MAPS))


def maps_over_http(data: Path, work: Path) -> Iterator[Figure]:
    """Line 20f: the service's part of aggregation."""
    for test, what in OF_MAPS:
        yield _passed("20f", what, test)


def _passed(line: str, what: str, *arguments: str) -> Figure:
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-m", "slow", *arguments], cwd=REPOSITORY, check=False)
    return exactly(line, f"{what}: exit code + 1", done.returncode + 1, 1)


def _same_scene(data: Path, work: Path) -> Iterator[Figure]:
    drive = imported(data, DRIVE, work)
    by_command = reconstructed(drive, work / f"{DRIVE}-no-gnss", "--no-gnss")
    by_service = work / f"{DRIVE}-service"
    with _standalone(work / "service") as (url, key_file):
        mrasfm("upload", drive, "--url", url, "--key-file", key_file, "--out", by_service, "--no-gnss")
    images = [read_report(scene)["summary"]["registered_images"] for scene in (by_command, by_service)]
    yield exactly("5", f"{DRIVE} over HTTP: images registered, as by the command", images[1], images[0])
    a, b = (read_tum(scene / "poses.tum") for scene in (by_command, by_service))
    farthest_m = float(np.linalg.norm((a.world_from_rig - b.world_from_rig)[:, :3, 3], axis=1).max())
    yield Figure(
        line="5",
        what=f"{DRIVE} over HTTP: farthest pose from the command's",
        value=farthest_m,
        unit="m",
        above=-1.0,  # exactly the same poses are what to hope for
        most=DIFFERENCE_M,
    )


@contextmanager
def _standalone(folder: Path) -> Iterator[tuple[str, Path]]:
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


def _figures_of(module: str, *arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    try:
        figures: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        raise CommandFailed(f"{module} {' '.join(arguments)}: {done.stderr.strip()[-300:]}") from None
    return figures
