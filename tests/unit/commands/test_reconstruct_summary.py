from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.commands.reconstruct import _say


def report(between: dict[str, Any], *, missing: list[dict[str, Any]], standing: int) -> dict[str, Any]:
    """What the summary reads of a report of a scene without positions."""
    mapping = {
        "stage": "mapping",
        "registered_units": 10,
        "units_not_registered": missing,
        "components": [{"units": 10}],
        "images_occluded": [],
    }
    refinement = {
        "stage": "refinement",
        "points": 300,
        "georeferenced": False,
        "calibration": {"adjusted": False, "reason": "few units"},
        "between_keyframes": between,
    }
    return {"stages": [mapping, refinement], "standing": {"units": standing}, "findings": []}


def test_units_that_hardly_moved_are_counted_with_those_that_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A vehicle that creeps has units that neither took part while the scene grew nor stand."""
    lost = {"unit": 7, "source_frame": 7, "reason": "it sees 4 points of the scene, 20 are needed"}
    between = {"units": 8, "registered": 7, "units_not_registered": [lost]}
    missing = [{"unit": 9, "source_frame": 9, "reason": "it sees no point of the scene"}]
    _say(report(between, missing=missing, standing=12), tmp_path)
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "units registered: 17 of 19" in lines
    assert "units standing:   12 more, posed between the ends of their stops" in lines
    assert [line for line in lines if line.startswith("not registered")] == [
        "not registered:   frame 7: it sees 4 points of the scene, 20 are needed",
        "not registered:   frame 9: it sees no point of the scene",
    ]
