"""The simulator without images."""

import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic import simulate_observations
from mrasfm_engine.synthetic.simulate import poses_along, simulate_trajectory


def test_cameras_and_rows_have_their_own_times() -> None:
    offset_s = np.array([0.0, 0.04, -0.03])
    rng = np.random.default_rng(0)
    s = simulate_observations(
        units=5, cameras=3, points=300, noise_px=0.0, time_offset_s=offset_s, readout_s=0.03, rng=rng
    )
    time_s = s.unit / 10 + offset_s[s.camera] + (s.xy_px[:, 1] / s.image_size_px[1] - 0.5) * 0.03
    then = poses_along(time_s * 10 * 1.1)
    local = se3.apply(se3.inverse(then @ s.rig_from_cam[s.camera]), s.points_m[s.point][:, None])[:, 0]
    pixels = local[:, :2] / local[:, 2:] * s.camera_params[s.camera, :2] + s.camera_params[s.camera, 2:]
    np.testing.assert_allclose(pixels, s.xy_px, atol=0.01)
    world_from_cam = s.world_from_rig[s.unit] @ s.rig_from_cam[s.camera]
    at_unit = se3.apply(se3.inverse(world_from_cam), s.points_m[s.point][:, None])[:, 0]
    skewed = np.abs(at_unit[:, :2] / at_unit[:, 2:] - local[:, :2] / local[:, 2:]).max(1) * s.camera_params[0, 0]
    assert np.median(skewed[s.camera == 1]) > 3


def test_exact_observations_are_projections() -> None:
    s = simulate_observations(units=8, points=300, rng=np.random.default_rng(0))
    cam_from_world = se3.inverse(s.world_from_rig[s.unit] @ s.rig_from_cam[s.camera])
    x = se3.apply(cam_from_world, s.points_m[s.point][:, None])[:, 0]
    k = s.camera_params[s.camera]
    xy = x[:, :2] / x[:, 2:] * k[:, :2] + k[:, 2:]
    assert len(xy) > 1000
    np.testing.assert_allclose(xy, s.exact_xy_px, atol=1e-8)
    assert x[:, 2].min() > 0.3


def test_noise_and_outliers_are_as_asked() -> None:
    s = simulate_observations(units=20, noise_px=0.7, outlier_fraction=0.1, rng=np.random.default_rng(1))
    error = (s.xy_px - s.exact_xy_px)[~s.is_outlier]
    assert 0.68 < error.std() < 0.72
    assert 0.09 < s.is_outlier.mean() < 0.11
    assert np.abs(s.xy_px - s.exact_xy_px)[s.is_outlier].mean() > 50


def test_every_point_is_seen_twice_and_all_cameras_see() -> None:
    s = simulate_observations(units=12, points=500, rng=np.random.default_rng(2))
    assert np.bincount(s.point, minlength=len(s.points_m)).min() >= 2
    assert (np.bincount(s.camera, minlength=6) > 50).all()


def test_same_seed_same_numbers() -> None:
    a, b = (simulate_observations(units=3, points=100, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a.xy_px, b.xy_px)


def test_winding_street_turns_and_straight_one_does_not() -> None:
    for straight, low, high in ((False, 20.0, 40.0), (True, -1e-9, 1.0)):
        poses = simulate_trajectory(40, straight=straight)
        heading = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
        assert low <= np.ptp(heading) < high
        assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) == pytest.approx(1.1, abs=0.01)


def test_nonsense_is_refused() -> None:
    with pytest.raises(InputError, match="cannot simulate"):
        simulate_observations(units=0, rng=np.random.default_rng(0))


def test_a_car_that_drives_round_a_circle_is_back_with_its_heading() -> None:
    radius_m = 5.0
    poses = poses_along(np.linspace(0.0, 2.0 * np.pi * radius_m, 9), spacing_m=0.1, radius_m=radius_m)
    np.testing.assert_allclose(poses[-1, :2, 3], poses[0, :2, 3], atol=0.02)
    np.testing.assert_allclose(poses[-1, :2, 0], poses[0, :2, 0], atol=0.03)
    across_m = np.linalg.norm(poses[4, :2, 3] - poses[0, :2, 3])
    assert across_m == pytest.approx(2.0 * radius_m, abs=0.02)
    left = poses[0, :2, 1]  # the circle's middle lies to the left
    assert left @ (poses[4, :2, 3] - poses[0, :2, 3]) > 1.9 * radius_m
