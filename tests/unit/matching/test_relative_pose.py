from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.relative_pose import RelativePose, UncertainRig

DEG = np.pi / 180
PIXEL_RAD = 1 / 700


def views(rng: np.random.Generator, count: int, noise_px: float) -> tuple[RelativePose, np.ndarray, np.ndarray]:
    """Two cameras a metre apart, looking across their path, and their rays to points beside it."""
    poses = [np.eye(4), se3.transform(se3.exp_so3([0.01, 0.04, -0.01]), [1.0, 0.05, 0.3])]
    points = rng.uniform([-6, -4, 5], [6, 4, 15], (count, 3))
    rays = [se3.apply(se3.inverse(pose), points) for pose in poses]
    rays = [r / r[:, 2:] + rng.normal(0, noise_px * PIXEL_RAD, (count, 3)) * [1, 1, 0] for r in rays]
    rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]
    sigma = np.array([2.0 * DEG] * 6 + [0.1] * 3)
    return RelativePose(base_from_a=poses[0], base_from_b=poses[1], covariance=np.diag(sigma**2)), rays[0], rays[1]


@pytest.mark.parametrize("sigmas", [0.0, 1.0])
def test_matches_correct_a_pose_within_its_covariance(sigmas: float) -> None:
    """A pose that is off by its own sigma is corrected: all matches fit, and wrong ones don't."""
    rng = np.random.default_rng(0)
    true, rays_a, rays_b = views(rng, 200, 0.4)
    rays_b[180:] = rays_b[rng.permutation(np.arange(180, 200))]
    start = true.corrected(sigmas * np.sqrt(np.diag(true.covariance)) * rng.choice([-1, 1], 9))
    refined, correction = start.refined(rays_a, rays_b, sigma_rad=0.7 * PIXEL_RAD)
    assert correction < 9.0 * sigmas + 5.0  # nine directions were off by a sigma each
    fits = refined.fits(rays_a, rays_b, max_error=2 * PIXEL_RAD)
    assert fits[:180].mean() > 0.97
    assert fits[180:].mean() < 0.3
    # As predicted, without the matches' own correction, the gate is as wide as the covariance.
    wide = start.fits(rays_a, rays_b, max_error=2 * PIXEL_RAD)
    assert wide[:180].mean() > 0.97
    assert wide[180:].mean() > fits[180:].mean() + 0.1
    rotation = (true.b_from_a @ se3.inverse(refined.b_from_a))[:3, :3]
    assert 0.0 < se3.rotation_angle_deg(rotation) < 0.2
    assert np.trace(refined.covariance[:3, :3]) < np.trace(start.covariance[:3, :3])


@pytest.mark.parametrize("off_m", [0.0, 0.8])
def test_a_pose_that_matches_contradict_needs_an_unlikely_correction(off_m: float) -> None:
    true, rays_a, rays_b = views(np.random.default_rng(1), 200, 0.4)
    start = true.corrected(np.array([0.0] * 7 + [off_m, 0.0]))
    correction = start.refined(rays_a, rays_b, sigma_rad=0.7 * PIXEL_RAD)[1]
    assert correction < 5.0 if off_m == 0 else correction > 20.0


def test_what_is_known_of_units_and_cameras_becomes_the_covariance_of_their_relative_pose() -> None:
    """The covariance is that of units and rigs at sigma points: a step along each column of the root, both ways."""
    rng = np.random.default_rng(2)
    units = np.stack(
        [se3.transform(se3.exp_so3([0.0, 0.1, yaw]), [x, 1.0, 0.0]) for yaw, x in ((0.5, 0.0), (0.9, 4.0))]
    )
    mounts = np.stack([se3.transform(se3.exp_so3([0.0, 0.0, c]), [1.0 + c, 0.5, 1.5]) for c in (0.0, 1.0)])
    roots = 1e-4 * rng.normal(size=(2, 12, 12))
    of_units, of_rig = (root @ root.T for root in roots)
    rig = UncertainRig(rig_from_cam=mounts, covariance=of_rig)

    def moved(pose: np.ndarray, by: np.ndarray) -> np.ndarray:
        return se3.transform(se3.exp_so3(by[:3]) @ pose[:3, :3], pose[:3, 3] + by[3:])

    for a, b in ((0, 1), (1, 1)):
        sample, between = [], (units[0] @ mounts[a] - units[1] @ mounts[b])[:3, 3]
        for step in np.concatenate([np.eye(24), -np.eye(24)]) * np.sqrt(24):
            unit, cam = ((root @ part).reshape(2, 6) for root, part in zip(roots, np.split(step, 2), strict=True))
            ends = [moved(units[k], unit[k]) @ moved(mounts[c], cam[c]) for k, c in ((0, a), (1, b))]
            turns = [
                se3.log_so3(end[:3, :3] @ (units[k] @ mounts[c])[:3, :3].T)
                for end, (k, c) in zip(ends, ((0, a), (1, b)), strict=True)
            ]
            sample.append(np.concatenate([*turns, ends[0][:3, 3] - ends[1][:3, 3] - between]))
        found = rig.relative_pose_between(a, b, units, of_units)
        expected = np.array(sample).T @ np.array(sample) / len(sample)
        assert np.abs(found.covariance - expected).max() < 0.01 * np.abs(expected).max()
        np.testing.assert_allclose(found.base_from_a, units[0] @ mounts[a])
    # Cameras of one unit: its motion plays no part.
    inside = rig.relative_pose(0, 1)
    np.testing.assert_allclose(inside.b_from_a, se3.inverse(mounts[1]) @ mounts[0])
    np.testing.assert_allclose(inside.covariance[:3, :3], of_rig[:3, :3])


@pytest.mark.parametrize("apart_m", [0.0, 1e-16, 1e-9])
def test_cameras_in_one_place_have_a_relative_pose(apart_m: float) -> None:
    """A standing vehicle's: their epipolar lines have no direction."""
    true, rays_a, rays_b = views(np.random.default_rng(3), 200, 0.4)
    at_a = true.base_from_a.copy()
    at_a[:3, 3] = true.base_from_b[:3, 3] + [apart_m, 0.0, 0.0]
    start = replace(true, base_from_a=at_a, covariance=np.diag(np.array([4.0 * DEG] * 6 + [0.9] * 3) ** 2))
    refined, correction = start.refined(rays_a, rays_b, sigma_rad=0.7 * PIXEL_RAD)
    assert np.isfinite(correction)
    assert np.isfinite(refined.b_from_a).all()
    assert (np.diag(refined.covariance) <= np.diag(start.covariance) * (1 + 1e-9)).all()


def test_matches_that_no_motion_explains_do_not_draw_cameras_together() -> None:
    """With no baseline at all any two rays would be on one epipolar line."""
    rng = np.random.default_rng(4)
    rays_a, rays_b = (np.c_[rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)] for _ in range(2))
    rays_b[:140] = rays_a[:140] + rng.normal(0, 0.01, (140, 3)) * [1, 1, 0]
    rays_a, rays_b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (rays_a, rays_b))
    sigma = np.array([4.0 * DEG, 4.0 * DEG, 9.0 * DEG] * 2 + [0.9, 0.9, 1.2])
    at_a = se3.transform(np.eye(3), [-0.96, -1.15, 0.0])
    start = RelativePose(base_from_a=at_a, base_from_b=np.eye(4), covariance=np.diag(sigma**2))
    refined, _ = start.refined(rays_a, rays_b, sigma_rad=PIXEL_RAD)
    assert refined.fits(rays_a, rays_b, max_error=3 * PIXEL_RAD)[140:].mean() < 0.5
