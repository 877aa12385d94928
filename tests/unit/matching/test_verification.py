from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.verification import epipolar_errors, essential_inliers, fit_essential, in_front_of_both

FOCAL_PX = 700.0


def two_views(count: int = 150, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """b_from_a, points in camera a, and exact unit rays of both."""
    rng = np.random.default_rng(seed)
    b_from_a = se3.transform(se3.exp_so3(rng.normal(size=3) * 0.05), [0.3, -0.1, -1.1])
    points = np.stack([rng.uniform(-8, 8, count), rng.uniform(-4, 4, count), rng.uniform(6, 40, count)], 1)
    rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, se3.apply(b_from_a, points))]
    return b_from_a, points, rays[0], rays[1]


def noisy(rays: np.ndarray, sigma_px: float, rng: np.random.Generator) -> np.ndarray:
    plane = rays / rays[:, 2:]
    plane[:, :2] += rng.normal(size=(len(rays), 2)) * sigma_px / FOCAL_PX
    return plane / np.linalg.norm(plane, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(4))
def test_planted_inliers_are_found_and_outliers_rejected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b_from_a, _, a, b = two_views(300, seed)
    a, b = noisy(a, 0.4, rng), noisy(b, 0.4, rng)
    wrong = rng.choice(300, 100, replace=False)
    b[wrong] = b[rng.permutation(wrong)]
    # A wrong match may lie on the right line by chance: those are no outliers of an epipolar test.
    clearly_wrong = wrong[epipolar_errors(b_from_a, a[wrong], b[wrong]) > 6.0 / FOCAL_PX]
    inliers = essential_inliers(a, b, max_error=2.0 / FOCAL_PX)
    assert inliers.shape == (300,)
    right = np.setdiff1d(np.arange(300), wrong)
    assert inliers[right].mean() > 0.97
    assert len(clearly_wrong) > 60
    assert inliers[clearly_wrong].mean() < 0.05


def test_random_matches_have_few_inliers() -> None:
    rng = np.random.default_rng(5)
    _, _, a, b = two_views(200)
    inliers = essential_inliers(a, b[rng.permutation(200)], max_error=2.0 / FOCAL_PX)
    assert inliers.mean() < 0.25


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_matches_have_no_inliers(count: int) -> None:
    _, _, a, b = two_views(20)
    assert not essential_inliers(a[:count], b[:count], max_error=0.01).any()


def test_rays_far_off_axis_are_left_out_not_blown_up() -> None:
    _, _, a, b = two_views(100)
    a[:10], b[10:20] = [1.0, 0.0, 0.0], [0.0, 0.6, -0.8]
    inliers = essential_inliers(a, b, max_error=2.0 / FOCAL_PX)
    assert not inliers[:20].any()
    assert inliers[20:].mean() > 0.97


def fisheye_views(count: int, seed: int, *, looks_aside: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """b_from_a of two fisheyes of 190 deg on a street, and rays of points around them with noise of 0.4 px at 300 px
    per radian."""
    rng = np.random.default_rng(seed)
    motion = [-1.0, 0.02, 0.1] if looks_aside else [0.05, 0.02, -1.0]
    b_from_a = se3.transform(se3.exp_so3(rng.normal(size=3) * 0.02), motion)
    points = rng.normal(size=(20 * count, 3)) * [9.0, 3.0, 9.0]
    rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, se3.apply(b_from_a, points))]
    seen = (np.minimum(rays[0][:, 2], rays[1][:, 2]) > np.cos(np.radians(95.0))) & (np.linalg.norm(points, axis=1) > 3)
    a, b = (ray[np.flatnonzero(seen)[:count]] for ray in rays)
    a, b = (ray + rng.normal(size=ray.shape) * 0.4 / 300.0 for ray in (a, b))
    return b_from_a, *(ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in (a, b))


@pytest.mark.parametrize("looks_aside", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_true_matches_at_the_rim_of_fisheyes_survive(seed: int, looks_aside: bool) -> None:
    b_from_a, a, b = fisheye_views(1000, seed, looks_aside=looks_aside)
    rng = np.random.default_rng(seed)
    wrong = rng.choice(1000, 250, replace=False)
    b[wrong] = b[rng.permutation(wrong)]
    right = np.setdiff1d(np.arange(1000), wrong)
    inliers = essential_inliers(a, b, max_error=2.0 / 300.0)
    angle = np.degrees(np.arccos(np.minimum(a[:, 2], b[:, 2])))
    rim = right[(angle[right] > 75.0) & (angle[right] < 90.0)]
    beyond = right[angle[right] > 90.0]
    assert len(rim) > 80
    assert inliers[rim].mean() >= 0.97
    assert len(beyond) > 20
    assert inliers[beyond].mean() >= 0.97
    clearly_wrong = wrong[epipolar_errors(b_from_a, a[wrong], b[wrong]) > 6.0 / 300.0]
    assert len(clearly_wrong) > 60
    assert inliers[clearly_wrong].mean() < 0.08


@pytest.mark.parametrize("looks_aside", [None, False, True])
def test_the_essential_matrix_is_that_of_the_motion(looks_aside: bool | None) -> None:
    """Of usual views and of fisheyes, which are judged in turned planes."""
    if looks_aside is None:
        b_from_a, _, a, b = two_views(300)
        a, b = noisy(a, 0.4, np.random.default_rng(0)), noisy(b, 0.4, np.random.default_rng(1))
    else:
        b_from_a, a, b = fisheye_views(1000, 0, looks_aside=looks_aside)
    essential = fit_essential(a, b, max_error=2.0 / 300.0).essential
    assert essential is not None
    true = se3.skew(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    cosine = (essential * true).sum() / np.linalg.norm(essential) / np.linalg.norm(true)
    assert abs(cosine) > 0.9998


def test_without_an_essential_matrix_there_is_none() -> None:
    _, _, a, b = two_views(5)
    assert fit_essential(a, b, max_error=0.01).essential is None


def test_exact_rays_have_no_epipolar_error() -> None:
    b_from_a, _, a, b = two_views()
    assert epipolar_errors(b_from_a, a, b).max() < 1e-12


def test_epipolar_errors_are_angles() -> None:
    # Side by side: a ray lifted out of the common plane by an angle has that error.
    b_from_a = se3.transform(np.eye(3), [-0.5, 0.0, 0.0])
    a = np.array([[0.1, 0.0, 1.0]]) / np.sqrt(1.01)
    for angle in (0.0, 1e-4, 0.05):
        b = np.array([[0.0, np.sin(angle), np.cos(angle)]])
        assert epipolar_errors(b_from_a, a, b)[0] == pytest.approx(angle, abs=1e-12)
    b_from_a, _, a, b = two_views(400)
    b = noisy(b, 1.0, np.random.default_rng(0))
    assert 0.2 / FOCAL_PX < np.median(epipolar_errors(b_from_a, a, b)) < 1.2 / FOCAL_PX


def test_without_a_baseline_epipolar_errors_are_zero_not_nan() -> None:
    _, _, a, b = two_views(10)
    np.testing.assert_array_equal(epipolar_errors(np.eye(4), a, b), np.zeros(10))


def test_in_front_of_both_knows_the_direction_of_the_baseline() -> None:
    b_from_a, _, a, b = two_views()
    assert in_front_of_both(b_from_a, a, b).all()
    reversed_baseline = b_from_a.copy()
    reversed_baseline[:3, 3] *= -1
    assert not in_front_of_both(reversed_baseline, a, b).any()


def test_in_front_of_both_is_not_fooled_by_one_camera_alone() -> None:
    # The rays meet in front of a but behind b.
    b_from_a = se3.transform(np.eye(3), [0.0, 0.0, -10.0])
    point = np.array([[1.0, 0.5, 5.0]])
    a = point / np.linalg.norm(point)
    b = se3.apply(b_from_a, point)
    b = -b / np.linalg.norm(b)
    assert not in_front_of_both(b_from_a, a, b)[0]
    assert in_front_of_both(b_from_a, a, -b)[0]


def test_parallel_rays_are_given_the_benefit_of_the_doubt() -> None:
    b_from_a = se3.transform(np.eye(3), [-0.5, 0.0, 0.0])
    ray = np.array([[0.0, 0.0, 1.0]])
    assert in_front_of_both(b_from_a, ray, ray).all()
