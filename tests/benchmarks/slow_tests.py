"""Lines 39 and 40: the tests that `make test` leaves out for their time."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.table import Figure, exactly

REPOSITORY = Path(__file__).resolve().parents[2]
OF_MAPS = (  # line 20f runs them
    ("tests/worker/test_map_over_http.py", "seven drives over HTTP, one broken, a worker killed: one map of six"),
    ("tests/service/test_upload_kills.py", "an upload whose API is killed at 50 random bytes has the right digest"),
)
KILLS = "tests/integration/test_service_kills.py"


def slow_tests_of_engine(data: Path, work: Path) -> Iterator[Figure]:
    """Line 39."""
    yield passed("39", "slow tests of the engine", "tests/unit", "tests/integration", f"--ignore={KILLS}", processes=2)


def slow_tests_of_service(data: Path, work: Path) -> Iterator[Figure]:
    """Line 40; one after the other, as leases, clocks and time limits are among them."""
    without = (f"--ignore={test}" for test, _ in OF_MAPS)
    folders = ("tests/service", "tests/worker", "tests/console", KILLS)
    yield passed("40", "slow tests of service, workers and console", *folders, *without)


def passed(line: str, what: str, *arguments: str, processes: int = 0) -> Figure:
    """Return the exit code of pytest on slow tests, plus one; what cannot run here fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "slow", "-n", str(processes), "--dist", "loadfile"]
    environment = {**os.environ, "MRASFM_REQUIRE_DATA": "1", "MRASFM_REQUIRE_BROWSER": "1"}
    done = subprocess.run([*command, *arguments], cwd=REPOSITORY, env=environment, check=False)
    return exactly(line, f"{what}: exit code + 1", done.returncode + 1, 1)
