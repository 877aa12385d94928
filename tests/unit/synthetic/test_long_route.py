"""The city, the route through it, and what its cameras see."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.city import BLOCK_M, HOUSES_M, city_route, ground_m, in_sight, points_beside, walk
from mrasfm_engine.synthetic.long_route import KEYPOINTS, NOISE_PX, LongRoute, simulate_long_route


@pytest.fixture(scope="module")
def route() -> LongRoute:
    return simulate_long_route("stereo", 30, seed=4)


def in_houses(xy_m: np.ndarray) -> np.ndarray:
    place = xy_m - np.floor(xy_m / BLOCK_M) * BLOCK_M
    return np.all((place > HOUSES_M) & (place < BLOCK_M - HOUSES_M), axis=-1)


def test_walks_return_to_streets_they_know() -> None:
    for seed in range(4):
        junctions = walk(40, np.random.default_rng(seed))
        assert len(junctions) == 41
        streets = list(pairwise(junctions))
        assert all(abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 for a, b in streets)
        assert all(a != c for (a, _), (_, c) in pairwise(streets)), "it never turns round"
        assert streets[0] == streets[4]
        same = sum(street in streets[:i] for i, street in enumerate(streets))
        opposite = sum(street[::-1] in streets[:i] for i, street in enumerate(streets))
        assert 3 <= same <= 20
        assert opposite <= 20
        crossed = [j for j in set(junctions[1:-1]) if len({a[0] == b[0] for a, b in streets if j in (a, b)}) == 2]
        assert len(crossed) >= 3


def test_routes_stay_on_streets_and_come_back() -> None:
    travelled_m = np.arange(900.0)
    poses = city_route(900.0, np.random.default_rng(1)).world_from_rig(travelled_m)
    place = poses[:, :3, 3]
    step_m = np.linalg.norm(np.diff(place, axis=0), axis=1)
    assert 0.98 < step_m.min() <= step_m.max() < 1.02
    np.testing.assert_allclose(place[:, 2], ground_m(place[:, :2]))
    assert not in_houses(place[:, :2]).any()
    turn_deg = se3.rotation_angle_deg(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    assert 5.0 < turn_deg.max() < 12.0
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    assert poses[:, 2, 2].min() > 0.99
    pairs = cKDTree(place).query_pairs(2.0, output_type="ndarray")
    far = pairs[pairs[:, 1] - pairs[:, 0] > 100]
    same = (poses[far[:, 0], :3, 0] * poses[far[:, 1], :3, 0]).sum(1)
    assert (same > 0.95).sum() > 60


def test_houses_hide_what_is_behind_them() -> None:
    assert in_sight(60.0, 0.0, 100.0, 8.0)
    assert not in_sight(60.0, 0.0, 119.0, 50.0)
    assert not in_sight(119.0, 50.0, 60.0, 0.0)
    assert not in_sight(60.0, 0.0, 60.0, 100.0)
    assert in_sight(0.0, 0.0, 0.0, 60.0)


def test_points_are_on_and_before_houses() -> None:
    points = points_beside(np.array([[20.0, 0.0], [60.0, 0.0]]), np.random.default_rng(0))
    assert len(points) > 100_000
    assert not in_houses(points[:, :2]).any()
    above_m = points[:, 2] - ground_m(points[:, :2])
    assert 0.15 < (above_m < 1e-9).mean() < 0.25
    assert 10.0 < above_m.max() <= 11.0


def test_observations_are_projections_with_noise(route: LongRoute) -> None:
    errors, counts = [], []
    for image, (xy, point) in enumerate(zip(route.xy_px, route.point, strict=True)):
        unit, c = divmod(image, 2)
        camera = route.cameras[c]
        cam_from_world = se3.inverse(route.world_from_rig[unit] @ camera.rig_from_cam)
        local = se3.apply(cam_from_world, route.points_m[point])
        assert local[:, 2].min() > 1.0
        params = np.array(camera.params)
        errors.append(xy - (local[:, :2] / local[:, 2:] * params[:2] + params[2:]))
        assert np.all((xy > 0) & (xy < [camera.width, camera.height]))
        assert len(np.unique(point)) == len(point)
        counts.append(len(point))
        place = (route.world_from_rig[unit] @ camera.rig_from_cam)[:2, 3]
        assert all(in_sight(*place, *xy_m) for xy_m in route.points_m[point[:20], :2])
    spread = np.concatenate(errors).std(axis=0)
    assert np.all((spread > 0.95 * NOISE_PX) & (spread < 1.05 * NOISE_PX))
    assert 0.95 * KEYPOINTS < np.mean(counts) < 1.05 * KEYPOINTS
    assert min(counts) > 0.8 * KEYPOINTS


def test_neighbours_share_most_points_and_far_units_few(route: LongRoute) -> None:
    shared = [len(np.intersect1d(route.point[0], route.point[2 * unit])) for unit in (1, 8, 29)]
    assert 0.6 * KEYPOINTS < shared[0] < 0.9 * KEYPOINTS
    assert shared[0] > shared[1] > shared[2]
    np.testing.assert_allclose(route.travelled_m, np.arange(30), atol=0.2)


def test_all_six_cameras_see_enough() -> None:
    surround = simulate_long_route("surround", 3)
    assert len(surround.point) == 18
    assert min(len(point) for point in surround.point) > 200


def test_the_seed_decides(route: LongRoute) -> None:
    again, other = simulate_long_route("stereo", 30, seed=4), simulate_long_route("stereo", 30, seed=5)
    assert all(np.array_equal(a, b) for a, b in zip(route.xy_px, again.xy_px, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(route.point, again.point, strict=True))
    assert not np.array_equal(route.xy_px[0], other.xy_px[0])


@pytest.mark.parametrize(
    ("rig", "units", "message"), [("tricycle", 10, "'tricycle'"), ("stereo", 1, "1 units"), ("stereo", -5, "-5 units")]
)
def test_what_makes_no_sense_is_refused(rig: str, units: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate_long_route(rig, units)
