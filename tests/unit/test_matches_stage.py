"""Findings that the stage of the matches leaves in its report."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from mrasfm_engine.stages._matches import require_matches

FOUND = {"code": "cameras-backwards"}


@pytest.mark.parametrize(
    ("stored", "findings"),
    [({}, []), ({"exchanged_cameras": None}, []), ({"exchanged_cameras": FOUND}, [FOUND])],
    ids=["of an earlier installation", "none", "one"],
)
def test_exchanged_cameras_are_among_the_findings(stored: dict[str, Any], findings: list[Any]) -> None:
    run: Any = SimpleNamespace(report={"findings": []})
    require_matches(run, {"contradiction": None, "verified_pairs": 1, **stored})
    assert run.report["findings"] == findings
