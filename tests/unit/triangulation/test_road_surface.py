from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.triangulation.road_surface import (
    FittedRoad,
    KnownPatches,
    fit_road,
    most_frequent,
    rig_height_above,
)
from tests.helpers.road_shapes import SHAPES, bump
from tests.helpers.slow import slow

Profile = Callable[[np.ndarray], np.ndarray]
LENGTH_M = 60.0
NOISE_M = 0.01


def level(x: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def hill(x: np.ndarray) -> np.ndarray:
    """Waves of 1.6 m, up and down by 8 %, whose crests have a radius of 125 m: as sharp as city streets get."""
    return 0.8 * np.cos((x - 30.0) / 10.0)


def ramp(x: np.ndarray) -> np.ndarray:
    """Level, from 20 m on up by 6 %, the slope changing over 12 m."""
    fine = np.arange(-40.0, 120.0, 0.1)
    slope = 0.06 * np.clip((fine - 20.0) / 12.0, 0, 1)
    return np.interp(x, fine, np.cumsum(slope) * 0.1)


def poses(profile: Profile, rig_height_m: float, *, yaw: float = 0.0) -> np.ndarray:
    """A vehicle that follows the road, its origin at a height above it."""
    x = np.arange(0.0, LENGTH_M, 1.5)
    pitch = -np.arctan(np.gradient(profile(x), x))
    rotation = se3.exp_so3(pitch[:, None] * np.array([0.0, 1.0, 0.0]))
    up = rotation[:, :, 2]
    way = se3.transform(rotation, np.column_stack([x, np.zeros_like(x), profile(x)]) + rig_height_m * up)
    turn = se3.transform(se3.exp_so3([0.0, 0.0, yaw]), np.zeros(3))
    return turn @ way


def road_points(profile: Profile, count: int = 1500, *, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-5, LENGTH_M + 5, count), rng.uniform(-5, 5, count)
    return np.column_stack([x, y, profile(x) + rng.normal(0, NOISE_M, count)])


def fit(
    points: np.ndarray,
    world_from_rig: np.ndarray,
    sigma_m: float = NOISE_M,
    *,
    max_offset_m: float = np.inf,
    known: KnownPatches | None = None,
) -> FittedRoad | None:
    return fit_road(
        points,
        np.full(len(points), sigma_m),
        world_from_rig,
        radius_m=8.0,
        rng=np.random.default_rng(0),
        max_offset_m=max_offset_m,
        known=known,
    )


@pytest.mark.parametrize("profile", [level, hill, ramp])
@pytest.mark.parametrize("rig_height_m", [0.0, 1.65, -0.4])
def test_hills_and_ramps_survive_at_any_height_of_the_rigs_origin(profile: Profile, rig_height_m: float) -> None:
    road = fit(road_points(profile), poses(profile, rig_height_m))
    assert road is not None
    assert abs(road.rig_height_m - rig_height_m) < 0.1
    x = np.linspace(0, LENGTH_M, 200)
    distance, _ = road.surface.locate(np.column_stack([x, np.zeros_like(x), profile(x)]))
    inner = (x > 8) & (x < LENGTH_M - 8)  # at the ends patches have points on one side only
    assert 0 < np.abs(distance[inner]).max() < 0.03
    assert np.abs(distance).max() < 0.05
    assert 0 < np.median(np.abs(distance)) < 0.015
    assert 0.005 <= road.roughness_m < 0.03


def test_wrong_points_are_off_the_surface_and_the_others_on_it() -> None:
    """40 % of points hang above the road or lie below it, as those of shadows that move do."""
    points = road_points(ramp)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(points)) < 0.4
    points[wrong, 2] += rng.choice([-1, 1], int(wrong.sum())) * rng.uniform(0.1, 1.5, int(wrong.sum()))
    road = fit(points, poses(ramp, 1.5))
    assert road is not None
    distance, _ = road.surface.locate(points)
    off = np.abs(distance) > 3 * np.hypot(NOISE_M, road.roughness_m)
    assert off[wrong].mean() > 0.97
    assert 0 <= off[~wrong].mean() < 0.03


def test_kerbs_that_masks_call_road_do_not_lift_the_lane() -> None:
    points = road_points(level)
    kerb = np.abs(points[:, 1]) > 4.0
    points[kerb, 2] += 0.12
    road = fit(points, poses(level, 1.5))
    assert road is not None
    distance, _ = road.surface.locate(points)
    assert 0 < np.median(np.abs(distance[np.abs(points[:, 1]) < 3])) < 0.012
    assert np.median(road.surface.locate_on_patches(points)[0][kerb]) > 0.07


def is_on(road: FittedRoad) -> np.ndarray:
    """Points (n,) that the road has, as the mapping judges them."""
    limit = road.limits_m(np.full(len(road.offset_m), NOISE_M), sigmas=3.0, max_offset_m=0.05)
    return ~road.off(limit)


@pytest.mark.parametrize("wrong_share", [0.0, 0.2])
@pytest.mark.parametrize("a_square_metre", [2, *slow(10)])
@pytest.mark.parametrize("shape", SHAPES)
def test_bumps_bays_and_crowns_are_the_road(shape: str, a_square_metre: int, wrong_share: float) -> None:
    """Of the points that the shape moves, at most 3 % are off, 5 % beside wrong ones; of those, most are."""
    lost, left = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed + 100)
        points = road_points(level, a_square_metre * 700, seed=seed)
        raised_m = SHAPES[shape](points[:, 0], points[:, 1])
        points[:, 2] += raised_m
        wrong = rng.random(len(points)) < wrong_share
        points[wrong, 2] += rng.choice([-1, 1], int(wrong.sum())) * rng.uniform(0.1, 0.8, int(wrong.sum()))
        road = fit(points, poses(level, 1.5), max_offset_m=0.05)
        assert road is not None
        on = is_on(road)
        moved = raised_m != 0
        lost.append((~on)[moved & ~wrong].mean())
        left.append(on[wrong].mean() if wrong.any() else 0.0)
    assert 0 <= np.mean(lost) <= (0.05 if wrong_share else 0.03)
    assert 0 <= np.mean(left) < 0.05


def test_the_relief_follows_a_bump() -> None:
    points = road_points(level, 7000)
    points[:, 2] += bump(points[:, 0], points[:, 1])
    road = fit(points, poses(level, 1.5), max_offset_m=0.05)
    assert road is not None
    x = np.linspace(27, 33, 60)
    distance, _ = road.surface.locate(np.column_stack([x, np.zeros_like(x), bump(x, 0 * x)]))
    assert 0 < np.abs(distance).max() < 0.02
    assert np.abs(road.surface.locate_on_patches(np.column_stack([x, 0 * x, bump(x, 0 * x)]))[0]).max() > 0.05
    # Far from the bump there is none.
    far = np.abs(road.surface.relief.node_m[:, 0] - 30.0) > 8.0
    assert 0 < np.percentile(np.abs(road.surface.relief.height_m[far]), 95) < 0.012


def test_a_level_of_shadows_is_not_the_road() -> None:
    """Over 6 m, 30 % of the points lie on one level 15 cm above the road."""
    points = road_points(level, 3000)
    over = (np.abs(points[:, 0] - 30.0) < 3.0) & (np.random.default_rng(1).random(len(points)) < 0.3)
    points[over, 2] += 0.15
    road = fit(points, poses(level, 1.5), max_offset_m=0.05)
    assert road is not None
    on = is_on(road)
    assert 0 <= on[over].mean() < 0.25
    assert 0.97 < on[~over].mean() <= 1.0


def test_patches_of_an_earlier_fit_move_with_their_units() -> None:
    """All poses and points move and turn; what is known of the road then saves the search for it."""
    points, way = road_points(ramp), poses(ramp, 1.5)
    first = fit(points, way)
    assert first is not None
    moved = se3.transform(se3.exp_so3([0.0, 0.01, 0.3]), [5.0, -3.0, 1.0])
    again = fit(se3.apply(moved, points), moved @ way, known=first.known)
    assert again is not None
    before, after = se3.apply(moved, first.surface.centre_m), again.surface.centre_m
    np.testing.assert_allclose(after[: len(before)], before, atol=0.05)
    fewer = fit(se3.apply(moved, points), moved @ way[:20], known=first.known)
    assert fewer is not None
    assert 0 < np.abs(fewer.surface.locate(after[:10])[0]).max() < 0.05


def test_the_cost_grows_with_the_length() -> None:
    """Twice the road: at most 2.3 times the time, by the first calm one of five pairs that run one after the other."""

    def seconds(length_m: float) -> float:
        rng, count = np.random.default_rng(0), int(40 * length_m)
        points = np.column_stack(
            [rng.uniform(0, length_m, count), rng.uniform(-8, 8, count), rng.normal(0, 0.01, count)]
        )
        x = np.arange(0.0, length_m, 1.5)
        way = se3.transform(np.tile(np.eye(3), (len(x), 1, 1)), np.column_stack([x, 0 * x, np.full(len(x), 1.5)]))
        begin = time.process_time()
        assert fit(points, way) is not None
        return time.process_time() - begin

    seconds(50.0)
    assert any(0 < seconds(600.0) / seconds(300.0) <= 2.3 for _ in range(5))


def test_slanted_walls_that_masks_call_road_are_off_it() -> None:
    rng = np.random.default_rng(2)
    along, up = rng.uniform(0, LENGTH_M, 700), rng.uniform(0, 3, 700)
    wall = np.column_stack([along, 4.0 + 0.5 * up, up])
    points = np.concatenate([road_points(level, 1200), wall])
    road = fit(points, poses(level, 1.5))
    assert road is not None
    distance, _ = road.surface.locate(points)
    assert 0 < np.median(np.abs(distance[:1200])) < 0.015
    assert (distance[1200:][up > 0.3] > 0.15).mean() > 0.97


def test_neighbours_hold_a_patch_that_shadows_rule() -> None:
    """Along 8 m, seven of ten points lie on one wrong plane, 0.6 m above the road and steeper."""
    points = road_points(level)
    here = np.flatnonzero((np.abs(points[:, 0] - 30.0) < 4.0) & (np.random.default_rng(3).random(len(points)) < 0.7))
    points[here, 2] += 0.6 + 0.15 * (points[here, 0] - 30.0)
    road = fit(points, poses(level, 1.5))
    assert road is not None
    x = np.linspace(20, 40, 50)
    distance, _ = road.surface.locate(np.column_stack([x, np.zeros((50, 2))]))
    assert 0 < np.abs(distance).max() < 0.1


def test_the_surface_goes_on_where_points_lead_away_from_the_way() -> None:
    """A side street: patches spread over its points, 40 m from the way."""
    rng = np.random.default_rng(4)
    side = np.column_stack([rng.uniform(27, 33, 600), rng.uniform(5, 45, 600), rng.normal(0, NOISE_M, 600)])
    side[:, 2] += 0.04 * (side[:, 1] - 5)
    road = fit(np.concatenate([road_points(level), side]), poses(level, 1.5))
    assert road is not None
    distance, patch = road.surface.locate(side)
    assert (patch >= 0).all()
    assert 0 < np.percentile(np.abs(distance), 95) < 0.05


def test_any_heading() -> None:
    yaw = 2.3
    turn = se3.exp_so3([0.0, 0.0, yaw])
    points = road_points(ramp)
    straight, turned = fit(points, poses(ramp, 1.5)), fit(points @ turn.T, poses(ramp, 1.5, yaw=yaw))
    assert straight is not None
    assert turned is not None
    a, _ = straight.surface.locate(points)
    b, _ = turned.surface.locate(points @ turn.T)
    known = np.isfinite(a) & np.isfinite(b)
    assert known.mean() > 0.95
    assert 0 < np.abs(a[known] - b[known]).max() < 0.02


def test_no_road() -> None:
    way = poses(level, 1.5)
    few = road_points(level, 5)
    assert fit(few, way) is None
    assert fit(few[:0], way) is None
    far = road_points(level)
    far[:, 1] += 200.0
    assert fit(far, way) is None
    assert rig_height_above(few, way, reach_m=16.0) is None
    cloud = np.random.default_rng(5).uniform([0, -5, -2], [LENGTH_M, 5, 2], (60, 3))
    assert fit(cloud, way, 0.001) is None


def test_most_frequent_value_among_far_outliers() -> None:
    rng = np.random.default_rng(6)
    values = np.concatenate([rng.normal(1.6, 0.02, 100), rng.uniform(-5, 5, 80), [1e7, -1e7]])
    assert 0 < abs(most_frequent(values) - 1.6) < 0.02


def two_decks(rng: np.random.Generator, count: int) -> np.ndarray:
    """A road above another one, 5 m higher."""
    deck = np.column_stack([rng.uniform(0, LENGTH_M, count), rng.uniform(-5, 5, count), np.zeros(count)])
    points = np.concatenate([deck, deck])
    points[count:, 2] += 5.0
    points[:, 2] += rng.normal(0, NOISE_M, 2 * count)
    return points


def test_roads_above_one_another_each_have_a_surface() -> None:
    """Also where the points of one are the more precise ones, in every square."""
    rng = np.random.default_rng(7)
    points = two_decks(rng, 6000)
    sigma = np.repeat([2 * NOISE_M, NOISE_M], 6000)
    way = np.concatenate([poses(level, 1.5), poses(lambda x: 0 * x + 5.0, 1.5)])
    road = fit_road(points, sigma, way, radius_m=8.0, rng=rng, max_offset_m=0.05)
    assert road is not None
    off = road.off(road.limits_m(sigma, sigmas=3.0, max_offset_m=0.05))
    assert 0 <= off[:6000].mean() < 0.05
    assert 0 <= off[6000:].mean() < 0.05


def test_many_points_in_few_places_outvote_few_in_many() -> None:
    """True points lie in a sixth of the squares; wrong ones, a quarter of all, in every square on one wrong level."""
    rng = np.random.default_rng(8)
    square = rng.choice(600, 100, replace=False)[rng.integers(0, 100, 3600)]
    true = np.column_stack([square % 60, square // 60 - 5.0]) + rng.uniform(0, 1, (3600, 2))
    wrong = np.column_stack([rng.uniform(0, 60, 1200), rng.uniform(-5, 5, 1200)])
    points = np.column_stack([np.concatenate([true, wrong]), rng.normal(0, NOISE_M, 4800)])
    points[3600:, 2] += 0.2
    road = fit(points, poses(level, 1.5), max_offset_m=0.05)
    assert road is not None
    x = np.linspace(5, 55, 50)
    assert 0 < np.median(np.abs(road.surface.locate_on_patches(np.column_stack([x, 0 * x, 0 * x]))[0])) < 0.03
    assert 0.95 < is_on(road)[:3600].mean() <= 1.0
