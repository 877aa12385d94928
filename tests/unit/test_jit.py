"""Compiled kernels on the disk are those of the sources as they are."""

from __future__ import annotations

import gc
import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher

import mrasfm_engine
from mrasfm_engine import jit
from mrasfm_engine.bundle_adjustment import kernels, point_refinement
from mrasfm_engine.matching import sampson
from tests.helpers.slow import slow

OUTER = """
from mrasfm_engine.constants import SHIFT
from mrasfm_engine.inner import times
from mrasfm_engine.jit import njit
from mrasfm_engine.other import of_python

@njit(cache=True)
def result(pair):
    return times(pair.other) + SHIFT
"""
INNER = """
from mrasfm_engine.jit import njit
from mrasfm_engine.pair import Pair

@njit(cache=True)
def times(x):
    return Pair(FACTOR, x).factor * x
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    factor: int
    other: int

def made(other):
    return Pair(0, other)
"""
# A file's time is that of the kernel's last tick, up to 10 ms ago: in the same one, it would not seem to have changed.
CHANGED = """
import pathlib, time
constants = pathlib.Path("mrasfm_engine/constants.py")
import mrasfm_engine.constants, mrasfm_engine.jit
time.sleep(0.02)
constants.write_text("SHIFT = 5")
"""
# To import numba takes most of a process's time: each run is a fork of one that has.
RUNS = """
import os, sys, numba
for code in sys.stdin:
    if os.fork() == 0:
        exec(eval(code))
        sys.stdout.flush()
        os._exit(0)
    os.wait()
    print("end", flush=True)
"""
RUN = """
from mrasfm_engine.outer import result
from mrasfm_engine.pair import made
print(result(made(10)), sum(result.stats.cache_hits.values()))
"""


def test_sources_are_those_of_kernels_and_constants() -> None:
    def names(module: str) -> set[str]:
        return {path.name for path in jit.source_files(module)}

    assert names(kernels.__name__) == {"kernels.py", "camera_model.py"}
    assert names(sampson.__name__) == {"sampson.py", "small_cholesky.py", "robust_correction.py"}
    of_others = {"point_elimination.py", "image_sums.py", "kernels.py", "schur_structure.py", "camera_model.py"}
    assert names(point_refinement.__name__) == {"point_refinement.py", *of_others}, "also of those of others"


@pytest.mark.parametrize("given_folder", [False, *slow(True)])
def test_a_kernel_is_renewed_with_what_it_calls_and_its_constants(tmp_path: Path, given_folder: bool) -> None:
    package = tmp_path / "mrasfm_engine"
    package.mkdir()
    (package / "__init__.py").touch()
    shutil.copy(jit.__file__, package / "jit.py")
    (package / "outer.py").write_text(OUTER)

    def run(
        factor: int, shift: int, other: str = "", pair: str = PAIR, inner: str = INNER, first: str = ""
    ) -> list[int]:
        (package / "inner.py").write_text(inner.replace("FACTOR", str(factor)))
        (package / "constants.py").write_text(f"SHIFT = {shift}")
        (package / "pair.py").write_text(pair)
        (package / "other.py").write_text(f"def of_python(): {other or 'pass'}")
        assert runs.stdin is not None
        assert runs.stdout is not None
        runs.stdin.write(repr(first + RUN) + "\n")
        runs.stdin.flush()
        return [int(word) for line in iter(runs.stdout.readline, "end\n") for word in line.split()]

    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    if given_folder:
        environment["NUMBA_CACHE_DIR"] = str(tmp_path / "kept")
    renamed = PAIR.replace("class Pair", "class Two").replace("return Pair", "return Two")
    inner = INNER.replace("Pair", "Two")
    with subprocess.Popen(
        [sys.executable, "-c", RUNS], stdin=PIPE, stdout=PIPE, text=True, env=environment, cwd=tmp_path
    ) as runs:
        assert run(2, 1) == [21, 0]
        assert run(2, 1, other="return 1") == [21, 1], "it is kept, whatever Python does"
        assert run(3, 1) == [31, 0]
        assert run(3, 2) == [32, 0]
        assert run(3, 2) == [32, 1]
        assert run(3, 2, pair=PAIR + "# changed") == [32, 0]
        assert run(3, 4, first=CHANGED) == [34, 0], "as it was imported, not as it is by now"
        assert run(3, 5) == [35, 0], "nobody else takes that"
        assert run(3, 5, pair=renamed, inner=inner) == [35, 0], "what is kept names a tuple that is not there any more"
        assert run(3, 5, pair=renamed, inner=inner) == [35, 1]
    assert any((tmp_path / "kept" if given_folder else package).rglob("*.nbi"))


def test_what_counts_no_references_returns_none() -> None:
    """An array that such a function returned would be freed while it is in use."""
    numbers = {"None", "bool", "int", "float", "tuple", "..."}
    found = 0
    for module in pkgutil.walk_packages(mrasfm_engine.__path__, "mrasfm_engine."):
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, CPUDispatcher) and value.targetoptions.get("_nrt") is False:
                words = value.py_func.__annotations__["return"].replace("[", " ").replace("]", " ").replace(",", " ")
                assert set(words.split()) <= numbers, f"{value.py_func.__qualname__} returns {words}"
                for compiled in value.overloads.values():
                    assert "array" not in str(compiled.signature.return_type), value.py_func.__qualname__
                found += 1
    assert found > 40


def test_what_counts_no_references_leaves_those_of_its_arguments() -> None:
    @jit.uncounted()
    def total(rows: np.ndarray, which: int) -> float:
        row, result = rows[which], 0.0
        for i in range(len(row)):
            result += row[i]
        return result

    rows = np.arange(12.0).reshape(3, 4)
    before = sys.getrefcount(rows)
    assert [total(rows, i) for i in range(3)] == [6.0, 22.0, 38.0]
    gc.collect()
    assert sys.getrefcount(rows) == before


def test_what_counts_no_references_cannot_make_an_array() -> None:
    @jit.uncounted()
    def made(count: int) -> float:
        return float(np.zeros(count)[0])

    with pytest.raises(NumbaError, match=r"empty|NRT"):
        made(3)
