"""A leap of the receiver's clock: one offset for all positions would give the scene another length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.clock_leap import ClockLeap, clock_leap_findings
from mrasfm_engine.mapping.mapping_report import describe_refinement
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_true_poses
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 90


def refined(late_s: np.ndarray, *, sigma_m: float = 0.3, wander_m: float = 0.0) -> tuple[Refinement, float]:
    """A drive along bends with a receiver whose positions are late by some seconds (units,), and may wander; also how
    much longer the scene is than the drive."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=4000)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    time_s = simulated.drive.timestamps_us / 1e6
    wave = wander_m * np.sin(2 * np.pi * (time_s - time_s[0]) / 5.0)
    track = received(simulated, sigma_m, off_m=np.stack([wave, 0.7 * wave[::-1], 0 * wave], axis=1))
    track = replace(track, sigma_m=np.hypot(track.sigma_m, wander_m))
    antenna_m = simulated.world_from_rig[:, :3, 3] + simulated.world_from_rig[:, :3, :3] @ ARM_M
    velocity_mps = np.gradient(antenna_m, time_s, axis=0)
    by_late = late_s[:, None]
    lag_m = by_late * velocity_mps - 0.5 * by_late**2 * np.gradient(velocity_mps, time_s, axis=0)
    result = refine(
        mapper, AbsolutePriors(gnss=replace(track, position_m=track.position_m - lag_m), antenna_in_rig_m=ARM_M)
    )
    report = describe_refinement(mapper, result)["gnss"]
    leap = result.absolute.clock_leap
    assert ("clock_leap" in report) == (leap is not None)
    if leap is not None:
        assert report["clock_leap"]["leap_s"] == leap.seconds
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    return result, scale - 1.0


@pytest.mark.parametrize(("place", "leap_s"), [(25, 0.4), (60, -0.8), (50, 0.5)])
def test_a_leap_is_found_and_does_not_change_the_length_of_the_scene(place: int, leap_s: float) -> None:
    result, scale_error = refined(np.where(np.arange(UNITS) < place, 0.0, -leap_s))
    leap = result.absolute.clock_leap
    assert leap is not None
    assert leap.seconds == pytest.approx(leap_s, rel=0.3)
    assert leap.later_is_used == (place < UNITS // 2)
    times_us = result.absolute.gnss.timestamps_us if result.absolute.gnss else np.zeros(0)
    assert leap.last_before_us < times_us[place] < leap.first_behind_us
    assert result.placement is not None
    assert result.placement.prior is not None
    used = result.placement.prior.unit
    assert (used >= place).all() if leap.later_is_used else (used < place).all()
    assert result.certainty is not None
    assert abs(scale_error) < 3 * result.certainty.sigma_scale


@pytest.mark.parametrize("late_s", [0.0, 0.4, -0.8])
def test_one_offset_is_no_leap(late_s: float) -> None:
    result, _ = refined(np.full(UNITS, late_s))
    assert result.absolute.clock_leap is None
    assert (result.absolute.clock is not None) == (late_s != 0.0)


def test_an_error_that_wanders_is_no_leap() -> None:
    for late_s in (0.0, 0.4):
        assert refined(np.full(UNITS, late_s), wander_m=0.5)[0].absolute.clock_leap is None


@pytest.mark.parametrize("later_is_used", [False, True])
def test_the_finding_names_when_and_what_is_used(later_is_used: bool) -> None:
    leap = ClockLeap(last_before_us=5_000_000, first_behind_us=7_500_000, seconds=-1.04, later_is_used=later_is_used)
    (found,) = clock_leap_findings(leap, 1_000_000)
    assert (found.code, found.severity) == ("gnss-clock-leap", "warning")
    assert "between 4.0 and 6.5 s" in found.what
    assert "about 1 s" in found.what
    assert f"those {'before' if later_is_used else 'after'} it are not used" in found.what
    assert clock_leap_findings(None, 0) == []
