from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.triangulation.road_prior import points_below_trajectory, standing_is_impossible

CAMERA_M = 0.3  # of the lowest camera over the rig's origin


def way(rig_height_m: float) -> np.ndarray:
    x = np.arange(0.0, 30.0)
    return se3.transform(np.tile(np.eye(3), (len(x), 1, 1)), np.column_stack([x, 0 * x, np.full(len(x), rig_height_m)]))


def street(count: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the road and on facades, and which are on the road of the vehicle's lane."""
    rng = np.random.default_rng(seed)
    road = np.column_stack([rng.uniform(-5, 35, count), rng.uniform(-2.5, 2.5, count), rng.normal(0, 0.02, count)])
    side = rng.choice([-1.0, 1.0], count)
    wall = np.column_stack([rng.uniform(-5, 60, count), side * rng.uniform(8, 10, count), rng.uniform(0, 8, count)])
    return np.concatenate([road, wall]), np.arange(2 * count) < count


@pytest.mark.parametrize("rig_height_m", [0.0, 1.6])
def test_the_lane_is_found_at_any_height_of_the_rigs_origin(rig_height_m: float) -> None:
    points, on_road = street()
    camera_m = CAMERA_M + (1.6 - rig_height_m)
    found = points_below_trajectory(points, way(rig_height_m), camera_m)
    assert found is not None
    assert (found == on_road).all()


def test_wrong_points_near_the_level_are_taken_too() -> None:
    points, on_road = street()
    points[:40, 2] += np.linspace(-0.4, 0.4, 40)
    found = points_below_trajectory(points, way(1.6), CAMERA_M)
    assert found is not None
    assert found[:40].all()
    assert not found[~on_road].any()


def test_bonnets_of_parked_cars_are_not_the_road() -> None:
    """Beside the lane, more than twice as many points lie on one level 1 m above the road as on it."""
    rng = np.random.default_rng(2)
    road = np.column_stack([rng.uniform(0, 29, 60), rng.uniform(-1.9, 1.9, 60), rng.normal(0, 0.03, 60)])
    bonnets = np.column_stack([rng.uniform(0, 29, 150), rng.uniform(2.3, 2.9, 150), rng.normal(0.9, 0.05, 150)])
    sides = np.column_stack([rng.uniform(0, 29, 60), rng.uniform(2.1, 2.3, 60), rng.uniform(0.2, 0.9, 60)])
    found = points_below_trajectory(np.concatenate([road, bonnets, sides]), way(1.6), CAMERA_M)
    assert found is not None
    assert found[:60].all()
    assert not found[60:210].any()


def test_cameras_that_do_not_see_the_road() -> None:
    points, on_road = street()
    assert points_below_trajectory(points[~on_road], way(1.6), CAMERA_M) is None
    assert points_below_trajectory(points[:0], way(1.6), CAMERA_M) is None
    # What hangs in the lane at all heights is no road.
    rng = np.random.default_rng(1)
    cloud = np.column_stack([rng.uniform(0, 30, 300), rng.uniform(-2, 2, 300), rng.uniform(-40, 1, 300)])
    assert points_below_trajectory(cloud, way(1.6), CAMERA_M) is None


def test_only_what_cannot_stand_is_judged() -> None:
    points = np.array(
        [
            [10.0, 2.5, -0.2],  # below the road, beside the way
            [10.0, 2.5, 0.2],  # a kerb
            [10.0, 0.3, 0.2],  # where the vehicle drove
            [10.0, 0.3, 2.5],  # a wire above it
            [60.0, 0.3, 0.2],  # far ahead, where it has not driven
        ]
    )
    impossible = standing_is_impossible(points, points[:, 2], way(1.6))
    assert impossible.tolist() == [True, False, True, False, False]
