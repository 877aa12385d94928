"""Findings on what the refinement could not finish."""

from __future__ import annotations

import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.mapping import adjustment_rounds, refinement_result
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.unfinished_refinement import unfinished_findings
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_cameras, with_true_poses

UNITS = 12
LATE_MS = [60, -60, 0, 0]  # by twelve sigmas of what is declared


def codes(late_ms: list[int], config: EngineConfig | None = None) -> list[str]:
    """Codes of the findings on a short drive at its true poses, whose cameras are late."""
    travelled_m = [0.1 * k**2 for k in range(UNITS)]  # at one speed they would look like cameras mounted elsewhere
    simulated = make_simulated_drive(
        units=UNITS, cameras=4, points=1500, travelled_m=travelled_m, time_offset_ms=[0] * 4, late_ms=late_ms
    )
    given = [
        camera.model_copy(update={"readout_us": 0, "sigma_time_offset_us": 5000.0})
        for camera in simulated.drive.manifest.rig.cameras
    ]
    simulated = with_cameras(simulated, given)
    mapper = with_true_poses(make_model(simulated, config=config), simulated, range(UNITS))
    return [finding.code for finding in unfinished_findings(mapper, refine(mapper))]


def test_times_that_still_change_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    assert codes(LATE_MS) == [], "the rounds settle them"
    monkeypatch.setattr(adjustment_rounds, "MAX_ROUNDS", 1)
    assert codes([0] * 4) == []
    assert codes(LATE_MS) == ["refinement-unsteady"]


def test_sigmas_of_too_many_unknowns_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement_result, "MAX_UNKNOWNS_FOR_COVARIANCE", 6 * UNITS - 1)
    assert codes([0] * 4) == ["sigmas-unknown"]
    without = EngineConfig(bundle_adjustment=BundleAdjustmentConfig(priors=False))
    assert codes([0] * 4, without) == [], "whoever switches priors off asks for none"
