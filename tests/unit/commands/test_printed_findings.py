"""Findings and seams in the summaries of commands."""

from __future__ import annotations

import pytest

from mrasfm_engine.commands.aggregate import seam_line
from mrasfm_engine.commands.reconstruct import print_findings
from schemas.findings import as_json, warning


def test_each_finding_has_its_remedy_below_it(capsys: pytest.CaptureFixture[str]) -> None:
    print_findings([as_json(warning("code", "it is off", "Turn it on.")), as_json(warning("code", "so be it", ""))])
    assert capsys.readouterr().out == "  warning: it is off\n    Turn it on.\n  warning: so be it\n"


def test_a_seam_says_that_its_sigma_is_of_before_the_last_adjustment() -> None:
    """Lengths that differ make most of it, and the last adjustment takes this away."""
    seam = {
        "a": "one",
        "b": "two",
        "inliers": 3163,
        "residual_before_px": 17.58,
        "residual_after_px": 0.427,
        "sigma_translation_m": 0.148,
        "sigma_rotation_deg": 0.0348,
        "scale": 0.98972,
        "sigma_scale": 0.00006,
        "positions_off_m": 0.175,
    }
    line = (
        "seam one - two: 3163 shared points, residual 17.6 -> 0.43 px, "
        "before the last adjustment sigma 14.8 cm 0.035 deg{}, positions were 0.17 m off"
    )
    assert seam_line(seam) == line.format(", lengths differ by 1.0 %")
    assert seam_line(seam | {"sigma_scale": 0.01}) == line.format("")
    assert seam_line(seam | {"scale": 0.9998}) == line.format("")
