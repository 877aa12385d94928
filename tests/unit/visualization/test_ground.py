"""The ground's height from points."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.visualization.ground import BLEND_SIGMA_M, HEIGHT_STEP_M, GroundPatches, GroundTiles, estimate_ground

CAMERAS = np.array([[1.5, 0.5, 1.5], [1.5, -0.5, 1.6]])


def hill(xy: np.ndarray) -> np.ndarray:
    """A road that begins to climb by 6 % and bends over some metres."""
    result: np.ndarray = 0.03 * (xy[:, 0] - 15 + np.sqrt((xy[:, 0] - 15) ** 2 + 30))
    return result


def street(rng: np.random.Generator, *, on_road: int = 1500) -> np.ndarray:
    """Points of a road with kerbs of 12 cm, house fronts, and clutter above the ground."""
    road = np.column_stack([rng.uniform(-10, 45, on_road), rng.uniform(-4, 4, on_road)])
    beside = np.column_stack([rng.uniform(-10, 45, 1200), rng.choice([-1, 1], 1200) * rng.uniform(4.2, 8, 1200)])
    front = np.column_stack([rng.uniform(-10, 45, 2000), np.repeat([-8.5, 8.5], 1000)])
    ground = np.concatenate([road, beside, front])
    height = hill(ground) + rng.normal(0, 0.02, len(ground))
    height[len(road) :] += 0.12
    height[len(road) + len(beside) :] += rng.uniform(0, 6, 2000)
    clutter = np.column_stack([rng.uniform(-10, 45, 300), rng.uniform(-8, 8, 300)])
    cloud = np.column_stack([clutter, hill(clutter) + rng.uniform(0.3, 2.5, 300)])
    return np.concatenate([np.column_stack([ground, height]), cloud])


def drive_over(pitch_deg: float, height_m: float) -> np.ndarray:
    """Poses of a rig that is mounted with a pitch, its origin that far above the road."""
    x = np.arange(0.0, 30.0, 1.0)
    slope = np.gradient(hill(np.column_stack([x, 0 * x])), x)
    rotation = se3.exp_so3(np.column_stack([0 * x, np.radians(pitch_deg) - np.arctan(slope), 0 * x]))
    return se3.transform(rotation, np.column_stack([x, 0 * x, hill(np.column_stack([x, 0 * x])) + height_m]))


@pytest.mark.parametrize(("pitch_deg", "height_m"), [(0.0, 0.0), (1.5, 0.4), (-1.0, -0.5)])
def test_the_road_is_found_on_a_hill_between_kerbs(pitch_deg: float, height_m: float) -> None:
    rng = np.random.default_rng(1)
    ground = estimate_ground(street(rng), drive_over(pitch_deg, height_m), CAMERAS, rng=rng)
    assert ground is not None
    xy = np.column_stack([np.linspace(1, 28, 60), np.tile([-3.0, 0.0, 3.0], 20)])
    error = np.abs(ground.height_m(xy) - hill(xy))
    assert 1e-4 < np.median(error) < 0.015
    assert error.max() < 0.05


def test_without_a_ground_there_is_none() -> None:
    rng = np.random.default_rng(2)
    poses = drive_over(0.0, 0.0)
    cloud = np.column_stack([rng.uniform(-10, 45, 800), rng.uniform(-8, 8, 800), rng.uniform(-4, 8, 800)])
    assert estimate_ground(cloud, poses, CAMERAS, rng=rng) is None
    assert estimate_ground(street(rng)[:30], poses, CAMERAS, rng=rng) is None
    assert estimate_ground(np.zeros((0, 3)), poses, CAMERAS, rng=rng) is None
    high = street(rng)
    high[:, 2] += 5.0
    assert estimate_ground(high, poses, CAMERAS, rng=rng) is None


def test_the_nearest_patches_say_what_all_of_them_say() -> None:
    rng = np.random.default_rng(3)
    once = np.column_stack([np.arange(0.0, 300.0, 2.0), 5 * np.sin(np.arange(150) / 15)])
    way = np.concatenate([once, once + np.array([0.9, 0.3])])  # there and again
    height = hill(way) + 0.01 * np.sin(way[:, 0] / 7)
    patches = GroundPatches(
        centre_m=way, plane=np.column_stack([height, rng.normal(0.06, 0.003, 300), rng.normal(0, 0.003, 300)])
    )
    xy = way[rng.integers(0, len(way), 500)] + rng.uniform(-12, 12, (500, 2))
    offset = xy[:, None] - way
    squared = (offset**2).sum(-1)
    weight = np.exp(-0.5 * (squared - squared.min(1, keepdims=True)) / BLEND_SIGMA_M**2)
    planes = patches.plane[:, 0] + (offset * patches.plane[:, 1:]).sum(-1)
    error = np.abs(patches.height_m(xy) - (weight * planes).sum(1) / weight.sum(1))
    assert 0 < error.max() < 0.002


def test_heights_far_from_all_patches_are_finite_and_one_patch_is_enough() -> None:
    patch = GroundPatches(centre_m=np.array([[1.0, 2.0]]), plane=np.array([[3.0, 0.1, 0.0]]))
    np.testing.assert_allclose(patch.height_m(np.array([[11.0, 2.0], [1e4, 0.0]])), [4.0, 3.0 + 0.1 * 9999])


def test_tiles_cover_what_is_asked_for() -> None:
    class Bowl:
        def height_m(self, xy_m: np.ndarray) -> np.ndarray:
            result: np.ndarray = 0.01 * xy_m[:, 0] ** 2 - 0.3 * xy_m[:, 1]
            return result

    tiles = GroundTiles(Bowl())
    for centre in ([0.0, 0.0], [-37.3, 12.9], [103.9, -55.55]):
        heights, first = tiles.around(np.array(centre), 17.0)
        last = first + HEIGHT_STEP_M * (np.array(heights.shape[::-1]) - 1)
        assert (first <= np.array(centre) - 17).all()
        assert (last >= np.array(centre) + 17).all()
        x, y = (first[k] + HEIGHT_STEP_M * np.arange(heights.shape[1 - k]) for k in (0, 1))
        np.testing.assert_allclose(heights, 0.01 * x[None] ** 2 - 0.3 * y[:, None], atol=1e-9)


def test_tiles_that_are_remembered_are_those_of_the_place() -> None:
    """The last square is kept: it may be another one's only where both cover the same tiles."""

    class Slope:
        def height_m(self, xy_m: np.ndarray) -> np.ndarray:
            result: np.ndarray = xy_m[:, 0] + 1000.0 * xy_m[:, 1]
            return result

    tiles = GroundTiles(Slope())
    # Within a tile, of other last tiles, of other first ones, farther, larger, and back again.
    places = [(3.0, 3.0, 2.0), (3.4, 3.1, 2.0), (6.0, 3.0, 2.0), (3.0, 3.0, 2.0), (3.0, 6.0, 2.0), (3.0, 3.0, 2.0)]
    places += [(11.0, 3.0, 2.0), (9.0, 3.0, 2.0), (3.0, 11.0, 2.0), (3.0, 9.0, 2.0), (-5.0, 3.0, 2.0), (3.0, 3.0, 9.0)]
    for x, y, reach_m in places:
        heights, first = tiles.around(np.array([x, y]), reach_m)
        rows, columns = np.indices(heights.shape)
        expected = first[0] + HEIGHT_STEP_M * columns + 1000.0 * (first[1] + HEIGHT_STEP_M * rows)
        np.testing.assert_array_equal(heights, expected)
        last = first + HEIGHT_STEP_M * np.array([heights.shape[1] - 1, heights.shape[0] - 1])
        assert (first <= [x - reach_m, y - reach_m]).all()
        assert (last >= [x + reach_m, y + reach_m]).all()
    one, other = (tiles.around(np.array([x, 3.0]), 2.0)[0] for x in (3.0, 3.4))
    assert other is one  # not put together again


def test_bonnets_of_cars_in_a_line_are_not_the_ground() -> None:
    rng = np.random.default_rng(4)
    road = street(rng, on_road=400)
    cars = np.column_stack([rng.uniform(-10, 45, 2500), rng.choice([-2.5, 2.5], 2500) + rng.normal(0, 0.4, 2500)])
    bonnets = np.column_stack([cars, hill(cars) + 0.9 + rng.normal(0, 0.03, 2500)])
    points = np.concatenate([road, bonnets])
    for seed in range(3):
        ground = estimate_ground(points, drive_over(0.0, 0.0), CAMERAS, rng=np.random.default_rng(seed))
        assert ground is not None
        xy = np.column_stack([np.linspace(1, 28, 60), np.zeros(60)])
        assert np.median(np.abs(ground.height_m(xy) - hill(xy))) < 0.05
