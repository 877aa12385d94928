"""Who reads a log sees which stage goes on: standard error is a pipe here."""

from __future__ import annotations

import re

import pytest

from tests.integration.conftest import Variant, mrasfm_process

STAGES = ["preflight", "features", "matches", "mapping", "refinement", "pictures", "export"]
LINE = re.compile(r"\[\d\d:\d\d\] (?P<stage>\w+): (?P<what>begins|done|reused)(?P<rest>.*)")


def run(variant: Variant) -> list[tuple[str, str, str]]:
    """Stage, what became of it, and the rest of each line, in order; the first came before the end."""
    process = mrasfm_process("reconstruct", variant.root, "--out", variant.scene)
    assert process.stderr is not None
    first = process.stderr.readline()
    was_running = process.poll() is None
    _, rest = process.communicate(timeout=300)
    assert process.returncode == 0, rest
    assert was_running
    lines = [line for line in (first + rest).splitlines() if "compiling for this machine" not in line]
    assert lines
    assert all(len(line) < 100 and "\r" not in line and "\x1b" not in line for line in lines)
    found = [LINE.fullmatch(line) for line in lines if " so far" not in line]
    assert all(found), lines
    return [(m["stage"], m["what"], m["rest"]) for m in found if m]


@pytest.fixture
def small(variant: Variant) -> Variant:
    return variant.keep(cameras=["front", "left"], units=3).save()


@pytest.mark.slow
def test_stages_begin_and_end_in_lines(small: Variant) -> None:
    lines = run(small)
    assert [(stage, what) for stage, what, _ in lines] == [(s, what) for s in STAGES for what in ("begins", "done")]
    ends = {stage: rest for stage, what, rest in lines if what == "done"}
    assert re.fullmatch(r", 6/6, \d+\.\d s", ends["features"])
    assert re.fullmatch(r", 3/3, \d+\.\d s", ends["mapping"])
    assert re.fullmatch(r", \d+\.\d s", ends["export"])
    again = run(small)
    assert [stage for stage, what, _ in again if what == "reused"] == ["features", "matches", "mapping", "refinement"]
    assert [stage for stage, what, _ in again if what == "begins"] == ["preflight", "pictures", "export"]
