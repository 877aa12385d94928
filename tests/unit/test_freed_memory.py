from __future__ import annotations

import gc
import sys
from contextlib import suppress

import pytest

from mrasfm_engine.freed_memory import loading, return_freed_memory
from mrasfm_engine.subprocess_run import memory_bytes, run_in_subprocess
from mrasfm_engine.types import StageProgress

BLOCK, BLOCKS = 1 << 14, 1 << 13  # 128 MiB in pieces that do not get a mapping of their own


def before_and_after(progress: StageProgress) -> tuple[int, int]:
    blocks = [bytearray(BLOCK) for _ in range(BLOCKS)]
    del blocks[:-1]  # the last one stands at the heap's end, and holds all that is free below it
    held = memory_bytes()
    return_freed_memory()
    left = memory_bytes()
    assert held is not None
    assert left is not None
    return held, left


@pytest.mark.skipif(sys.platform != "linux", reason="other C libraries give memory back by themselves")
def test_freed_memory_goes_back_to_the_system() -> None:
    ended = run_in_subprocess(before_and_after)
    assert ended.result is not None
    held, left = ended.result
    assert held - left > 0.8 * BLOCK * BLOCKS


def test_garbage_is_looked_for_again_once_modules_are_loaded_or_fail_to() -> None:
    before = gc.get_freeze_count()
    looked_for = [gc.isenabled()]
    with suppress(ImportError), loading():
        looked_for.append(gc.isenabled())
        raise ImportError
    looked_for.append(gc.isenabled())
    kept = gc.get_freeze_count()
    gc.unfreeze()
    assert looked_for == [True, False, True]
    assert kept > before
