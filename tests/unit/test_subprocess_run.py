from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.subprocess_run import memory_bytes, peak_memory_bytes, run_in_subprocess

MEGABYTE = 1_000_000
linux = pytest.mark.skipif(sys.platform != "linux", reason="/proc tells the memory of a process")


def allocate(progress: Any, megabytes: int) -> int:
    progress("allocating", 1, 2)
    block = np.ones(megabytes * MEGABYTE, dtype=np.uint8)
    progress("allocating", 2, 2)
    return int(block[-1]) + megabytes


def refuse(progress: Any) -> None:
    raise InputError("the file is bad", remedy="Write it again.", code="bad-file")


def leave(progress: Any, code: int) -> None:
    os._exit(code)


def die(progress: Any, number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(60)


def sleep(progress: Any) -> None:
    progress("sleeping", 0, 1)
    time.sleep(600)


@linux
def test_result_progress_and_peak_memory() -> None:
    # What the parent has is not the child's: `ru_maxrss` would count it.
    mine = np.ones(150 * MEGABYTE, dtype=np.uint8)
    seen: list[tuple[str, int, int]] = []
    small = run_in_subprocess(allocate, 1)
    large = run_in_subprocess(allocate, 100, progress=lambda *step: seen.append(step))
    assert (small.result, large.result, large.failure) == (2, 101, "")
    assert seen == [("allocating", 1, 2), ("allocating", 2, 2)]
    assert small.peak_memory_bytes is not None
    assert large.peak_memory_bytes is not None
    assert 10 * MEGABYTE < small.peak_memory_bytes < len(mine)
    assert 85 * MEGABYTE < large.peak_memory_bytes - small.peak_memory_bytes < 120 * MEGABYTE
    now, peak = memory_bytes(), peak_memory_bytes()
    assert now is not None
    assert peak is not None
    assert len(mine) < now <= peak


def test_what_the_work_refuses_is_raised_here() -> None:
    with pytest.raises(InputError) as caught:
        run_in_subprocess(refuse)
    assert (caught.value.what, caught.value.remedy, caught.value.code) == (
        "the file is bad",
        "Write it again.",
        "bad-file",
    )


@pytest.mark.parametrize(
    ("work", "argument", "failure"),
    [
        (leave, 3, "exit code 3"),
        (die, signal.SIGTERM, "SIGTERM"),
        (die, signal.SIGKILL, "SIGKILL, maybe because memory"),
    ],
)
def test_a_process_that_dies_is_told(work: Any, argument: int, failure: str) -> None:
    ran = run_in_subprocess(work, argument)
    assert ran.result is None
    assert failure in ran.failure


def test_timeout() -> None:
    started = time.monotonic()
    ran = run_in_subprocess(sleep, timeout_s=0.5)
    assert ran.result is None
    assert ran.failure == "not finished within 0.5 s"
    assert time.monotonic() - started < 60


def test_cancel_kills_the_process() -> None:
    seen: list[str] = []
    with pytest.raises(CancelledError):
        run_in_subprocess(sleep, progress=lambda stage, done, total: seen.append(stage), cancel=lambda: bool(seen))
    assert seen == ["sleeping"]
