from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry.height_plane import HeightPlane, fit_height_plane

LEVEL = np.zeros(2)


def fit(
    xy: np.ndarray,
    height: np.ndarray,
    sigma: np.ndarray | float = 0.01,
    *,
    expected_slope: np.ndarray = LEVEL,
    sigma_slope: float = 0.05,
    max_slope_change: float = 0.2,
    min_points: int = 8,
) -> HeightPlane | None:
    return fit_height_plane(
        xy,
        height,
        np.broadcast_to(np.asarray(sigma, dtype=float), height.shape).copy(),
        np.ones(len(height)),
        expected_slope=expected_slope,
        sigma_slope=sigma_slope,
        max_slope_change=max_slope_change,
        min_points=min_points,
        rng=np.random.default_rng(0),
    )


def plane_points(count: int, noise_m: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points of the plane 1.5 + 0.06 x - 0.02 y."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-8, 8, (count, 2))
    return xy, 1.5 + xy @ [0.06, -0.02] + rng.normal(0, noise_m, count)


def test_plane_among_outliers_of_both_sides() -> None:
    xy, height = plane_points(200, 0.01)
    rng = np.random.default_rng(2)
    wrong = rng.random(200) < 0.4
    height[wrong] += rng.uniform(0.1, 2.0, int(wrong.sum())) * rng.choice([-1, 1], int(wrong.sum()))
    plane = fit(xy, height)
    assert plane is not None
    assert 0 < abs(plane.offset_m - 1.5) < 0.005
    assert 0 < np.abs(plane.slope - [0.06, -0.02]).max() < 0.002
    assert (plane.inliers & wrong).sum() <= 2
    assert plane.inliers[~wrong].mean() > 0.97
    assert 0.55 < plane.support < 0.65


def test_more_outliers_than_points_if_they_do_not_agree() -> None:
    xy, height = plane_points(200, 0.01)
    wrong = np.arange(200) < 120
    height[wrong] += np.random.default_rng(3).uniform(-2, 2, 120)
    plane = fit(xy, height)
    assert plane is not None
    assert 0 < abs(plane.offset_m - 1.5) < 0.01


def test_uncertain_points_hardly_count() -> None:
    xy, height = plane_points(60, 0.005)
    far_xy, far = plane_points(60, 0.005, seed=4)
    plane = fit(np.concatenate([xy, far_xy]), np.concatenate([height, far + 0.3]), np.repeat([0.005, 0.3], 60))
    assert plane is not None
    assert 0 < abs(plane.offset_m - 1.5) < 0.01


def test_points_on_a_line_get_the_expected_slope_across_it() -> None:
    along = np.linspace(-8, 8, 50)
    xy = np.column_stack([along, np.zeros(50)])
    plane = fit(xy, 0.05 * along + np.random.default_rng(5).normal(0, 0.01, 50), expected_slope=np.array([0.0, 0.03]))
    assert plane is not None
    assert 0 < abs(plane.slope[0] - 0.05) < 0.005
    assert abs(plane.slope[1] - 0.03) < 1e-6


@pytest.mark.parametrize("slope", [0.8, 3.0])
def test_walls_are_no_plane_of_a_road(slope: float) -> None:
    rng = np.random.default_rng(6)
    xy = np.column_stack([rng.uniform(-4, 4, 100), rng.uniform(-4, 4, 100)])
    plane = fit(xy, slope * xy[:, 0] + rng.normal(0, 0.01, 100))
    assert plane is None or (np.hypot(*plane.slope) <= 0.2 and plane.support < 0.3)


def test_too_few_points() -> None:
    xy, height = plane_points(7, 0.01)
    assert fit(xy, height) is None
    assert fit(xy[:0], height[:0]) is None
    xy, height = plane_points(30, 2.0)
    assert fit(xy, height, 0.001) is None
