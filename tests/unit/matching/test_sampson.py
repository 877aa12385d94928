"""Errors of matches, and the most likely pose of two images under them and a prior."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.small_cholesky import factorise, log_determinant, solve
from mrasfm_engine.matching.sampson import SMALL_RAD, _turn, epipolar_derivatives, most_likely_pose
from mrasfm_engine.types import Floats

SIGMA_RAD = 1e-3
ROOT = np.diag([0.02] * 6 + [0.1] * 3)  # of a prior


def views(rng: np.random.Generator, points: int) -> tuple[Floats, list[Floats]]:
    """Poses (2, 4, 4) a metre apart, and noisy rays of each to points before them."""
    poses = np.stack([se3.transform(se3.exp_so3(rng.normal(0, 0.1, 3)), [k, 0.1 * k, 0.0]) for k in (0.0, 1.0)])
    points_m = rng.uniform(-4, 4, (points, 3)) + np.array([0, 0, 10])
    rays = [se3.apply(se3.inverse(pose), points_m) for pose in poses]
    rays = [r / np.linalg.norm(r, axis=1, keepdims=True) + rng.normal(0, SIGMA_RAD / 2, r.shape) for r in rays]
    return poses, [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]


def test_derivatives_are_those_of_the_error() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([se3.transform(se3.exp_so3(rng.normal(0, 0.2, 3)), rng.normal(0, 0.5, 3)) for _ in range(2)])
    points = rng.uniform(-2, 2, (20, 3)) + np.array([0, 0, 8])
    rays = [se3.apply(se3.inverse(pose), points) for pose in poses]
    rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]
    rays[0] = rays[0] @ se3.exp_so3(np.array([0.1, 0.2, -0.1])).T  # as far off as wrong matches are
    at, derivatives, _ = epipolar_derivatives(*poses, *rays)
    step = 1e-7
    for axis in range(3):
        delta = step * np.eye(3)[axis]
        for camera in range(2):
            moved = poses.copy()
            moved[camera, :3, :3] = se3.exp_so3(delta) @ moved[camera, :3, :3]
            change = (epipolar_derivatives(*moved, *rays)[0] - at) / step
            np.testing.assert_allclose(derivatives[:, 3 * camera + axis], change, atol=1e-5)
        moved = poses.copy()
        moved[0, :3, 3] += delta
        change = (epipolar_derivatives(*moved, *rays)[0] - at) / step
        np.testing.assert_allclose(derivatives[:, 6 + axis], change, atol=1e-5)


def test_a_pose_as_far_off_as_its_prior_allows_is_corrected() -> None:
    """What is left of the errors is their noise, and the information is that of the errors there."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        poses, (rays_a, rays_b) = views(rng, 120)
        given_a, given_b = moved(poses, ROOT @ rng.normal(0, 1, 9))
        before, _, _ = epipolar_derivatives(given_a, given_b, rays_a, rays_b)
        assert np.median(np.abs(before)) > SIGMA_RAD
        x, information = most_likely_pose(given_a, given_b, rays_a, rays_b, ROOT, SIGMA_RAD)
        corrected_a, corrected_b = moved(np.stack([given_a, given_b]), ROOT @ x)
        error, derivatives, _ = epipolar_derivatives(corrected_a, corrected_b, rays_a, rays_b)
        assert np.median(np.abs(error)) < 0.5 * SIGMA_RAD
        rows, weight = derivatives @ ROOT, 1 / (SIGMA_RAD**2 + error**2)
        np.testing.assert_allclose(information, rows.T @ (weight[:, None] * rows), rtol=1e-9, atol=1e-9)


def test_wrong_matches_do_not_hold_a_pose_where_it_is() -> None:
    """Three in ten are wrong: the derivatives must be exact for matches far from their lines, too."""
    rng = np.random.default_rng(5)
    noise = []
    for _ in range(40):
        poses, (rays_a, rays_b) = views(rng, 120)
        given_a, given_b = moved(poses, ROOT @ rng.normal(0, 1, 9))
        rays_b[:36] = rng.permutation(rays_b)[:36]
        x, _ = most_likely_pose(given_a, given_b, rays_a, rays_b, ROOT, SIGMA_RAD)
        found_a, found_b = moved(np.stack([given_a, given_b]), ROOT @ x)
        error, _, _ = epipolar_derivatives(found_a, found_b, rays_a[36:], rays_b[36:])
        noise.append(np.median(np.abs(error)))
    assert np.percentile(noise, 90) < 0.5 * SIGMA_RAD


def moved(poses: Floats, correction: Floats) -> Floats:
    result = poses.copy()
    result[:, :3, :3] = se3.exp_so3(correction[:6].reshape(2, 3)) @ poses[:, :3, :3]
    result[0, :3, 3] += correction[6:]
    return result


def test_matches_of_no_numbers_have_no_pose() -> None:
    (pose_a, pose_b), (rays_a, rays_b) = views(np.random.default_rng(2), 20)
    rays_a[3] = np.nan
    assert np.isnan(most_likely_pose(pose_a, pose_b, rays_a, rays_b, ROOT, SIGMA_RAD)[0]).all()


def test_no_matches_leave_the_pose_as_it_is() -> None:
    (pose_a, pose_b), _ = views(np.random.default_rng(2), 20)
    x, information = most_likely_pose(pose_a, pose_b, np.zeros((0, 3)), np.zeros((0, 3)), ROOT, SIGMA_RAD)
    assert not x.any()
    assert not information.any()


def test_poses_are_turned_by_rotation_vectors() -> None:
    pose = se3.transform(se3.exp_so3([0.3, -0.2, 0.5]), [1.0, 2.0, 3.0])
    for by in ([0.4, -1.0, 0.2], [0.5 * SMALL_RAD, 0.0, 0.2 * SMALL_RAD], [0.0, 0.0, 0.0], [0.0, np.pi, 0.0]):
        out = pose.copy()
        _turn(pose, np.array(by), out)
        np.testing.assert_allclose(out[:3, :3], se3.exp_so3(by) @ pose[:3, :3], atol=1e-14)
        np.testing.assert_array_equal(out[:, 3], pose[:, 3])


def test_cholesky_of_few_unknowns() -> None:
    root = np.random.default_rng(3).normal(0, 1, (5, 5))
    matrix, right, factor = root @ root.T + np.eye(5), np.arange(5.0), np.zeros((5, 5))
    assert factorise(matrix, 5, factor)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix))
    np.testing.assert_allclose(log_determinant(factor, 5), np.linalg.slogdet(matrix)[1])
    expected = np.linalg.solve(matrix, right)
    solve(factor, right, 5, right)  # in place
    np.testing.assert_allclose(right, expected)
    assert not factorise(-matrix, 5, factor)
