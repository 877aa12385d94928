from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import FISHEYE, PERSPECTIVE, packed, project_points, unproject_pixels
from mrasfm_engine.scene.state import State
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks
from mrasfm_engine.triangulation.triangulate import Triangulator, cam_from_world

PARAMS = packed(PERSPECTIVE, [500.0, 505.0, 480.0, 270.0])[1]
RIG_FROM_FORWARD_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass
class Setting:
    """A forward camera that drives along x, one track a point that all units see, and the result's arrays."""

    state: State
    keypoints: Keypoints
    tracks: Tracks
    triangulator: Triangulator
    points_m: np.ndarray
    triangulated: np.ndarray
    is_inlier: np.ndarray

    def run(self, registered: np.ndarray | None = None) -> None:
        units = len(self.state.unit_rotation)
        self.triangulator.triangulate(
            self.state,
            self.tracks,
            np.ones(units, dtype=np.bool_) if registered is None else registered,
            which=np.arange(len(self.tracks), dtype=np.int64),
            points_m=self.points_m,
            triangulated=self.triangulated,
            is_inlier=self.is_inlier,
        )


def setting(
    points: np.ndarray,
    *,
    units: int = 6,
    step_m: float = 1.0,
    noise_px: float = 0.0,
    move: dict[tuple[int, int], tuple[float, float]] | None = None,
    min_angle_deg: float = 1.0,
    max_error_px: float = 4.0,
    kind: int = 0,
    params: np.ndarray = PARAMS,
    seed: int = 0,
) -> Setting:
    """`move` shifts the observation of (point, unit) by so many pixels."""
    rng, n = np.random.default_rng(seed), len(points)
    state = State(
        unit_rotation=se3.exp_so3(np.linspace(0, 0.05, units)[:, None] * [0.0, 0.0, 1.0]),
        unit_position_m=np.arange(units)[:, None] * np.array([step_m, 0.02, 0.0]),
        camera_rotation=RIG_FROM_FORWARD_CAM[None],
        camera_position_m=np.array([[1.5, 0.2, 1.5]]),
        camera_params=params[None],
        camera_time_offset_s=np.zeros(1),
        points_m=np.zeros((n, 3)),
    )
    poses = se3.inverse(state.world_from_rig @ state.rig_from_cam[0])
    xy = np.stack([project_points(kind, params, se3.apply(pose, points)) for pose in poses])  # (units, n, 2)
    # What lies behind the camera is imaged as if mirrored, as a wrong match would have it.
    behind = np.isnan(xy[..., 0])
    if behind.any():
        mirrored = np.stack([project_points(kind, params, -se3.apply(pose, points)) for pose in poses])
        xy[behind] = mirrored[behind]
    xy += rng.normal(size=xy.shape) * noise_px
    for (p, u), shift in (move or {}).items():
        xy[u, p] += shift
    image = np.repeat(np.arange(units), n).astype(np.int64)
    flat = np.ascontiguousarray(xy.reshape(-1, 2))
    keypoints = Keypoints(
        first=(n * np.arange(units + 1)).astype(np.int64),
        number=np.tile(np.arange(n), units).astype(np.int64),
        image=image,
        unit=image,
        camera=np.zeros(len(image), dtype=np.int64),
        band=image,
        xy_px=flat,
        rays=unproject_pixels(kind, params, flat),
    )
    tracks = Tracks.from_labels(np.tile(np.arange(n), units).astype(np.int64))
    triangulator = Triangulator(
        keypoints,
        np.arange(units, dtype=np.int64),
        np.zeros(units, dtype=np.int64),
        np.array([kind], dtype=np.int64),
        max_error_px=max_error_px,
        min_angle_deg=min_angle_deg,
    )
    return Setting(
        state,
        keypoints,
        tracks,
        triangulator,
        np.full((n, 3), np.nan),
        np.zeros(n, dtype=np.bool_),
        np.zeros(len(image), dtype=np.bool_),
    )


def some_points(count: int = 60, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0], count)
    return np.stack([rng.uniform(14, 30, count), side * rng.uniform(3, 7, count), rng.uniform(-0.5, 6, count)], 1)


@pytest.mark.parametrize(
    ("kind", "params"), [(0, PARAMS), packed(FISHEYE, [300.0, 300, 480, 270, 0.02, -0.008, 0.002, -0.0005])]
)
def test_exact_points_are_recovered(kind: int, params: np.ndarray) -> None:
    points = some_points()
    s = setting(points, kind=kind, params=params)
    s.run()
    assert s.triangulated.all()
    assert s.is_inlier.all()
    np.testing.assert_allclose(s.points_m, points, atol=1e-4)


def test_noise_leaves_the_error_that_it_should() -> None:
    points = some_points(200)
    s = setting(points, noise_px=0.5)
    s.run()
    assert s.triangulated.mean() > 0.98
    assert s.is_inlier.mean() > 0.98
    off = np.linalg.norm(s.points_m - points, axis=1)[s.triangulated]
    assert 0.01 < np.median(off) < 0.3


@pytest.mark.parametrize("wrong_unit", range(6))
def test_an_outlier_is_dropped_and_the_point_stays(wrong_unit: int) -> None:
    points = some_points(20)
    s = setting(points, move={(p, wrong_unit): (40.0, -25.0) for p in range(20)})
    s.run()
    assert s.triangulated.all()
    is_inlier = s.is_inlier.reshape(6, 20)
    assert not is_inlier[wrong_unit].any()
    assert np.delete(is_inlier, wrong_unit, axis=0).mean() > 0.98
    np.testing.assert_allclose(s.points_m, points, atol=0.05)


def test_two_of_six_wrong_ones_are_outvoted() -> None:
    points = some_points(20)
    move = {(p, u): (30.0 + 20 * u, 60.0 - 17 * p) for p in range(20) for u in (1, 4)}
    s = setting(points, move=move)
    s.run()
    right = np.linalg.norm(s.points_m - points, axis=1) < 0.1
    assert (s.triangulated & right).sum() >= 18


def test_too_small_an_angle_gives_no_point() -> None:
    far = np.array([[400.0, 5.0, 3.0], [450.0, -3.0, 6.0]])
    s = setting(far)
    s.run()
    assert not s.triangulated.any()
    assert not s.is_inlier.any()
    near = setting(some_points(10))
    near.run()
    assert near.triangulated.all()
    strict = setting(some_points(10), min_angle_deg=45.0)
    strict.run()
    assert not strict.triangulated.any()


def test_a_standing_car_gives_no_points() -> None:
    s = setting(some_points(20), step_m=0.0, noise_px=0.3)
    s.state.unit_position_m[:] = 0.0
    s.run()
    assert not s.triangulated.any()


def test_behind_the_camera_there_is_no_point() -> None:
    # Rays that meet behind the cameras: what a mirrored match looks like.
    s = setting(some_points(20) * [-1.0, 1.0, 1.0])
    s.run()
    assert not s.triangulated.any()


def test_only_registered_units_take_part() -> None:
    points = some_points(15)
    s = setting(points, move={(p, 2): (100.0, 100.0) for p in range(15)})
    registered = np.array([True, True, False, True, False, True])
    s.run(registered)
    assert s.triangulated.all()
    is_inlier = s.is_inlier.reshape(6, 15)
    assert is_inlier[registered].all()
    assert not is_inlier[~registered].any()
    s.run(np.array([True, False, False, False, False, False]))
    assert not s.triangulated.any()
    assert not s.is_inlier.any()


def test_tracks_not_asked_for_are_left_alone() -> None:
    points = some_points(10)
    s = setting(points)
    s.triangulator.triangulate(
        s.state,
        s.tracks,
        np.ones(6, dtype=np.bool_),
        which=np.array([2, 7], dtype=np.int64),
        points_m=s.points_m,
        triangulated=s.triangulated,
        is_inlier=s.is_inlier,
    )
    assert np.flatnonzero(s.triangulated).tolist() == [2, 7]
    assert sorted(set(s.tracks.of_keypoint[s.is_inlier].tolist())) == [2, 7]
    assert np.isnan(s.points_m[[0, 1, 3]]).all()


@pytest.mark.parametrize("units", [45, 280])
def test_long_tracks_of_many_images_are_solved(units: int) -> None:
    points = some_points(30) + np.array([30.0, 0.0, 0.0])
    s = setting(points, units=units, step_m=40.0 / units, noise_px=0.3)
    s.run()
    assert s.triangulated.all()
    assert 1e-4 < np.median(np.linalg.norm(s.points_m - points, axis=1)) < 0.3
    assert s.is_inlier.reshape(units, 30).sum(0).min() > 0.8 * min(units, 256)


def test_errors_px_agree_with_projection() -> None:
    points = some_points(12)
    s = setting(points, noise_px=0.0, move={(3, 1): (3.0, 4.0)})
    rows = np.arange(len(s.keypoints.image), dtype=np.int64)
    errors = s.triangulator.errors_px(s.state, rows, points, s.tracks.of_keypoint)
    expected = np.zeros(len(rows))
    expected[12 + 3] = 5.0
    np.testing.assert_allclose(errors, expected, atol=1e-9)
    behind = points * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(s.triangulator.errors_px(s.state, rows, behind, s.tracks.of_keypoint), 1e6)


def test_cam_from_world_composes_unit_and_camera() -> None:
    s = setting(some_points(3))
    units, cameras = np.array([0, 4], dtype=np.int64), np.zeros(2, dtype=np.int64)
    rotation, translation = cam_from_world(s.state, units, cameras)
    expected = se3.inverse(s.state.world_from_rig[units] @ s.state.rig_from_cam[cameras])
    np.testing.assert_allclose(se3.transform(rotation, translation), expected, atol=1e-12)
