from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.evaluation.trajectory import compare_trajectories, match_timestamps
from mrasfm_engine.geometry import se3


def drive(*, bend: float = 1.0, n: int = 60) -> np.ndarray:
    """True poses along a bend (0: straight along x), 120 m."""
    s = np.linspace(0, 1, n)
    yaw = bend * s
    positions = np.column_stack([120 * s, bend * 40 * s**2, 0 * s])
    return se3.transform(se3.exp_so3(np.column_stack([0 * s, 0 * s, yaw])), positions)


WORLD = se3.transform(se3.exp_so3([0.3, -0.4, 2.0]), [1000.0, -500.0, 20.0])


def test_a_trajectory_in_another_world_has_no_error() -> None:
    truth = drive()
    errors = compare_trajectories(WORLD @ truth, truth)
    assert errors.poses == 60
    assert errors.metric_rmse_m < 1e-9
    assert errors.similarity_rmse_m < 1e-9
    assert errors.rotation_median_deg < 1e-6
    assert errors.similarity_scale == pytest.approx(1.0, abs=1e-12)


def test_position_noise_is_measured() -> None:
    truth, rng = drive(n=500), np.random.default_rng(0)
    noise = rng.normal(size=(500, 3)) * 0.02
    errors = compare_trajectories(WORLD @ se3.transform(truth[:, :3, :3], truth[:, :3, 3] + noise), truth)
    assert 0.033 < errors.metric_rmse_m < 0.036  # sqrt(3) * 0.02
    assert 0.029 < errors.metric_median_m < 0.033
    assert errors.similarity_rmse_m <= errors.metric_rmse_m
    assert errors.rotation_median_deg < 1e-6


def test_scale_is_truth_over_estimate() -> None:
    truth = drive()
    shrunk = se3.transform(truth[:, :3, :3], truth[:, :3, 3] / 1.25)
    errors = compare_trajectories(WORLD @ shrunk, truth)
    assert errors.similarity_scale == pytest.approx(1.25)
    assert errors.similarity_rmse_m < 1e-9
    assert 5 < errors.metric_rmse_m < 15


def test_rotation_noise_is_measured_and_a_few_wrong_ones_do_not_decide() -> None:
    truth, rng = drive(n=400), np.random.default_rng(1)
    turned = truth.copy()
    turned[:, :3, :3] = se3.exp_so3(np.radians(0.5) * rng.normal(size=(400, 3))) @ truth[:, :3, :3]
    turned[:40, :3, :3] = se3.exp_so3(rng.normal(size=(40, 3))) @ turned[:40, :3, :3]
    errors = compare_trajectories(WORLD @ turned, truth)
    assert 0.7 < errors.rotation_median_deg < 1.0  # median of a chi distribution with 3 degrees, 1.54 sigma
    assert errors.metric_rmse_m < 1e-9


def test_a_straight_line_does_not_decide_about_roll() -> None:
    truth = drive(bend=0.0)
    errors = compare_trajectories(WORLD @ truth, truth)
    assert errors.metric_rmse_m < 1e-9
    assert errors.rotation_median_deg < 1e-6
    assert errors.similarity_scale == pytest.approx(1.0)


def test_a_nearly_straight_line_is_aligned_best() -> None:
    truth, rng = drive(bend=0.0, n=300), np.random.default_rng(2)
    truth[:, :3, 3] += rng.normal(size=(300, 3)) * 0.02
    assert compare_trajectories(WORLD @ truth, truth).metric_rmse_m < 1e-9


def test_a_wrong_roll_of_one_half_shows() -> None:
    truth = drive(bend=0.0)
    half = truth.copy()
    half[30:, :3, :3] = half[30:, :3, :3] @ se3.exp_so3([np.radians(4.0), 0, 0])
    assert 0.1 < compare_trajectories(half, truth).rotation_median_deg <= 4.0


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 3"):
        compare_trajectories(drive(n=2), drive(n=2))
    with pytest.raises(ValueError, match="at least 3"):
        compare_trajectories(drive(n=5), drive(n=6))


def test_timestamps_are_matched_to_the_nearest() -> None:
    estimate = np.array([0, 1000, 2000, 3000, 9000])
    truth = np.array([-400, 300, 1900, 2200, 4500])
    kept, matched = match_timestamps(estimate, truth, tolerance_us=1000)
    assert kept.tolist() == [0, 2, 3]
    assert matched.tolist() == [1, 2, 3]


def test_a_truth_is_used_once_and_by_the_nearest() -> None:
    kept, matched = match_timestamps(np.array([0, 400, 900]), np.array([500]), tolerance_us=1000)
    assert (kept.tolist(), matched.tolist()) == ([1], [0])


@pytest.mark.parametrize("tolerance_us", [0, 1000])
def test_equal_and_empty_timestamps(tolerance_us: int) -> None:
    times = np.arange(10) * 100_000
    kept, matched = match_timestamps(times, times, tolerance_us=tolerance_us)
    assert kept.tolist() == matched.tolist() == list(range(10))
    assert not len(match_timestamps(times, times[:0], tolerance_us=tolerance_us)[0])
    assert not len(match_timestamps(times[:0], times, tolerance_us=tolerance_us)[0])
    assert not len(match_timestamps(times, times + 50_000_000, tolerance_us=tolerance_us)[0])
