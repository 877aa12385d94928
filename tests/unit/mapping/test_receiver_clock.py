"""The receiver's clock: told from the shape of the way, and corrected where it is clearly wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping import absolute_priors
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.mapping_report import describe_refinement
from mrasfm_engine.mapping.receiver_clock import ReceiverClock, clock_offset
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from tests.helpers.simulated_drive import SimulatedDrive, make_model, make_simulated_drive, with_true_poses
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 40


def driven(times_s: np.ndarray) -> np.ndarray:
    """A bend at changing speed."""
    way = 8.0 * times_s + 10.0 * np.sin(0.5 * times_s)
    return np.stack([60 * np.sin(way / 60), 60 * (1 - np.cos(way / 60)), 0 * way], 1)


def measured(position_m: np.ndarray, times_s: np.ndarray, *, white_m: float, wander_m: float) -> ReceiverPositions:
    return ReceiverPositions.from_samples(
        unit=np.arange(len(times_s)),
        time_s=times_s,
        position_m=position_m,
        white_m=np.full((len(times_s), 3), white_m),
        wander_m=np.full((len(times_s), 3), wander_m),
        lever_arm_m=np.zeros(3),
        wander_time_s=60.0,
        least_spacing_s=1.0,
    )


@pytest.mark.parametrize("offset_s", [-0.4, 0.0, 0.15])
def test_a_clock_that_is_off_is_told_with_its_sign(offset_s: float) -> None:
    times_s = np.arange(80) * 0.2
    noise = np.random.default_rng(0).normal(size=(80, 3)) * 0.05
    sigma_s = []
    for wander_m in (0.0, 0.3):
        positions = measured(driven(times_s + offset_s) + noise, times_s, white_m=0.05, wander_m=wander_m)
        found = clock_offset(driven(times_s), positions)
        assert found is not None
        assert found.offset_s == pytest.approx(offset_s, abs=max(0.02, 0.1 * abs(offset_s)))
        sigma_s.append(found.sigma_s)
    assert 1e-4 < sigma_s[0] < 0.05
    assert 1.5 * sigma_s[0] < sigma_s[1] < 0.2  # a receiver that wanders knows it less well


def test_a_clock_cannot_be_told_on_a_straight_way_at_one_speed() -> None:
    times_s = np.arange(40) * 0.2
    way = times_s[:, None] * np.array([10.0, 0.0, 0.0])
    noise = np.random.default_rng(0).normal(size=(40, 3)) * 0.05
    found = clock_offset(way, measured(way + noise, times_s, white_m=0.05, wander_m=0.0))
    assert found is None or found.sigma_s > 1.0
    assert clock_offset(way[:4], measured(way[:4], times_s[:4], white_m=1.0, wander_m=0.0)) is None


def test_a_scale_that_is_known_otherwise_tells_the_clock_better() -> None:
    """A vehicle that brakes steadily along a straight line."""
    times_s = np.arange(40) * 0.1
    way = np.stack([12.0 * times_s - 0.5 * times_s**2, 0 * times_s, 0 * times_s], 1)
    positions = measured(way + np.random.default_rng(1).normal(size=(40, 3)) * 0.02, times_s, white_m=0.02, wander_m=0)
    free, known = (clock_offset(way, positions, sigma_factor=sigma) for sigma in (np.inf, 1e-4))
    assert free is not None
    assert known is not None
    assert abs(free.offset_s) < 3 * free.sigma_s
    assert abs(known.offset_s) < 3 * known.sigma_s
    assert 0.001 < known.sigma_s < 0.3 * free.sigma_s
    # A way that is 2 % too long belongs to another clock, unless it is known to be too long.
    longer, grown = (clock_offset(1.02 * way, positions, factor=by, sigma_factor=1e-4) for by in (1.0, 1 / 1.02))
    assert longer is not None
    assert grown is not None
    assert abs(longer.offset_s) > 0.1
    assert abs(grown.offset_s) < 3 * grown.sigma_s


@pytest.mark.parametrize(
    ("offset_s", "sigma_s", "is_wrong"),
    [
        (0.0, 0.01, False),
        (0.03, 0.01, False),  # as one right clock of 400 seems to be
        (0.05, 0.01, True),
        (-0.3, 0.05, True),
        (-0.3, 0.15, False),
        (3.0, 1.0, False),  # next to nothing is known of it
        (18.0, 1.0, True),
    ],
)
def test_a_clock_is_right_until_it_is_more_probable_that_it_is_wrong(
    offset_s: float, sigma_s: float, is_wrong: bool
) -> None:
    assert ReceiverClock(offset_s=offset_s, sigma_s=sigma_s).is_wrong is is_wrong


def placed_by_late_receiver(late_s: float) -> tuple[SimulatedDrive, Refinement, float]:
    """A refined drive through a bend with a receiver whose positions are late; the scale error of the scene."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    track = received(simulated, 0.02)
    time_s = track.timestamps_us / 1e6
    antenna_m = simulated.world_from_rig[:, :3, 3] + simulated.world_from_rig[:, :3, :3] @ ARM_M
    velocity_mps = np.gradient(antenna_m, time_s, axis=0)
    acceleration = np.gradient(velocity_mps, time_s, axis=0)
    gnss = replace(track, position_m=track.position_m - late_s * velocity_mps + 0.5 * late_s**2 * acceleration)
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    report = describe_refinement(mapper, result)["gnss"]
    if late_s:
        assert report["clock_offset_s"] == pytest.approx(-late_s, abs=4 * report["sigma_clock_offset_s"])
    else:
        assert "clock_offset_s" not in report
    return simulated, result, scale - 1.0


@pytest.mark.parametrize("late_s", [0.0, 0.4])
def test_a_late_receiver_is_found_and_does_not_change_the_length_of_the_scene(late_s: float) -> None:
    _, result, scale_error = placed_by_late_receiver(late_s)
    assert result.georeferenced
    assert result.placement is not None
    assert [f.code for f in result.placement.findings] == (["gnss-clock-offset"] if late_s else [])
    assert result.certainty is not None
    assert abs(scale_error) < 3 * result.certainty.sigma_scale
    assert 1e-5 < result.certainty.sigma_scale < 0.01


def test_a_clock_that_positions_let_go_once_they_have_its_times_is_not_taken_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The scene would be reported at one of two clocks by chance."""
    simulated = make_simulated_drive(units=20, cameras=2, points=800)
    mapper = with_true_poses(make_model(simulated), simulated, range(20))
    priors = AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M)
    assert priors.gnss is not None
    as_given_us = priors.gnss.timestamps_us.copy()
    wrong = ReceiverClock(offset_s=-0.08, sigma_s=0.02)
    says = iter([wrong, None, *[wrong] * 10])
    monkeypatch.setattr(absolute_priors, "find_clock", lambda *_: next(says))
    priors.place(mapper)
    priors.reassess(mapper)
    assert priors.clock is None
    np.testing.assert_array_equal(priors.gnss.timestamps_us, as_given_us)
