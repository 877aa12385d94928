"""Figures of the acceptance are saved whatever kind of number was measured."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.table import Figure, exactly, failed, load, save


def test_figures_are_saved_as_they_were_measured(tmp_path: Path) -> None:
    figures = [
        Figure(line="1", what="error", value=np.float64(0.5), most=np.float64(0.4)),
        exactly("1", "images", np.int64(3), 3),
        Figure(line="1", what="time", value=np.float32(2.5)),
        failed("1", "map", "there is none"),
    ]
    save(figures, tmp_path / "deep" / "figures.json", {"cores": 2})
    saved = json.loads((tmp_path / "deep" / "figures.json").read_text())
    assert saved["cores"] == 2
    rows = [(row["value"], row["most"], row["passed"]) for row in saved["figures"]]
    assert rows == [(0.5, 0.4, False), (3, 3, True), (2.5, None, None), (None, None, False)]
    about, again = load(tmp_path / "deep" / "figures.json")
    assert about == {"cores": 2}
    assert [(f.what, f.bounded, f.passed) for f in again] == [(f.what, f.bounded, f.passed) for f in figures]


@pytest.mark.parametrize("value", [0.0, -0.1, 0.11, math.nan, math.inf])
def test_what_is_out_of_bounds_does_not_pass(value: float) -> None:
    assert Figure(line="1", what="error", value=0.1, most=0.1).passed
    assert not Figure(line="1", what="error", value=value, most=0.1).passed
