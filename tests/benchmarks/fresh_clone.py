"""Line 4: what a newcomer does first, in a clone of its own."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.table import Figure, exactly

REPOSITORY = Path(__file__).resolve().parents[2]
TEST_LIMIT_S = 600.0


def fresh_clone(data: Path, work: Path) -> Iterator[Figure]:
    """Line 4: clone what is committed, run the tests and the demo."""
    clone = work / "clone"
    subprocess.run(["git", "clone", "--quiet", REPOSITORY, clone], check=True)
    environment = {"MRASFM_TEST_DATA": str(data.parent.resolve())}
    for target in ("setup", "test", "demo"):
        seconds, code = _make(clone, target, environment)
        yield exactly("4", f"make {target} in a fresh clone: exit code + 1", code + 1, 1)
        yield Figure(
            line="4",
            what=f"make {target} in a fresh clone",
            value=seconds,
            unit="s",
            most=TEST_LIMIT_S if target == "test" else None,
        )


def _make(clone: Path, target: str, environment: dict[str, str]) -> tuple[float, int]:
    started = time.perf_counter()
    variables = [f"{name}={value}" for name, value in environment.items()]
    result = subprocess.run(["env", *variables, "make", target], cwd=clone, check=False)
    return time.perf_counter() - started, result.returncode
