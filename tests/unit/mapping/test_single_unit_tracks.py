from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import betabinom

from mrasfm_engine.mapping import single_unit_tracks
from mrasfm_engine.mapping.ground_path import ground_path
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.motion_groups import BESIDE
from mrasfm_engine.mapping.moving_objects import IN_ONE_UNIT, drop_moving
from mrasfm_engine.mapping.single_unit_tracks import MOVING, log_odds_in_single_units, log_odds_of_moving
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    shown_points,
    true_matches,
    with_true_poses,
)
from tests.helpers.simulated_traffic import Car, with_cars

ONCOMING = Car(place_m=(25.0, 3.5), velocity_m_s=(-9.0, 0.0))
PARKED = Car(place_m=(8.0, 3.5), velocity_m_s=(0.0, 0.0))


def street(car: Car) -> SimulatedDrive:
    """A straight street: what one camera sees of a car that comes along it, an object that stands explains as well."""
    return with_cars(make_simulated_drive(units=12, points=6000, straight=True), [car], points=80)


def mapped(simulated: SimulatedDrive, only_within_units: Callable[[np.ndarray], np.ndarray]) -> Mapper:
    """The mapper at the true poses. Between units no point (n,) is matched for which `only_within_units` is true, as
    matches between units contradict the poses where something moves."""

    def kept(pair: PairMatches) -> PairMatches:
        units = [simulated.drive.images[i].unit for i in (pair.image_a, pair.image_b)]
        shown = simulated.point_of_keypoint[pair.image_a][pair.matches[:, 0]]
        return pair if units[0] == units[1] else replace(pair, inliers=pair.inliers & ~only_within_units(shown))

    pairs = [pair for pair in map(kept, true_matches(simulated, min_matches=4)) if pair.inliers.any()]
    return with_true_poses(make_model(simulated, pairs), simulated, range(len(simulated.world_from_rig)))


def found_in(mapper: Mapper) -> np.ndarray:
    """Tracks (n,) that move by what is around them."""
    none = np.zeros(len(mapper.tracks), np.bool_)
    return np.flatnonzero(log_odds_in_single_units(mapper, none, ground_path(mapper)) > 0.0)


def on_car(mapper: Mapper, simulated: SimulatedDrive) -> np.ndarray:
    """Which tracks (tracks,) show the car."""
    result: np.ndarray = shown_points(mapper, simulated) >= len(simulated.truth.points_m)
    return result


def test_points_of_a_car_that_two_cameras_see_at_one_instant_go() -> None:
    simulated = street(ONCOMING)
    mapper = mapped(simulated, lambda shown: shown >= len(simulated.truth.points_m))
    before, shows_car = mapper.triangulated.copy(), on_car(mapper, simulated)
    # What is as low as the ground may be is not judged by what is around it, but goes with its neighbours.
    low = shows_car & (mapper.state.points_m[:, 2] < 0.3)
    assert (before & shows_car).sum() > 100
    assert (before & low).sum() > 20
    found = drop_moving(mapper, for_map=True)
    assert (mapper.triangulated & shows_car).sum() <= 0.1 * (before & shows_car).sum()
    assert (mapper.triangulated & low).sum() <= 0.5 * (before & low).sum()
    assert (before & ~mapper.triangulated & ~shows_car).sum() <= 0.02 * (before & ~shows_car).sum()
    assert {IN_ONE_UNIT, BESIDE} <= set(found.reason.tolist())


def test_for_poses_what_one_unit_sees_at_one_instant_stays_and_else_goes() -> None:
    simulated = street(ONCOMING)
    mapper = mapped(simulated, lambda shown: shown >= len(simulated.truth.points_m))
    assert IN_ONE_UNIT not in drop_moving(mapper, for_map=False).reason
    mapper.place_bands()  # as where cameras are triggered apart
    assert IN_ONE_UNIT in drop_moving(mapper, for_map=False).reason


@pytest.mark.parametrize("moving", [0, 60, 600])
@pytest.mark.parametrize(("mean", "correlation"), [(0.3, 0.2), (0.5, 0.3), (0.7, 0.2), (0.85, 0.4), (0.95, 0.1)])
def test_how_many_move_is_told_by_all_neighbourhoods(mean: float, correlation: float, moving: int) -> None:
    """3000 neighbourhoods of points that stand, and some that move, beside who knows how many and how they differ."""
    rng, both = np.random.default_rng(5), (1.0 - correlation) / correlation
    stands = (mean * both, (1.0 - mean) * both)
    going_on = rng.binomial(13, np.concatenate([rng.beta(*stands, 3000), rng.beta(*MOVING, moving)]))
    found = log_odds_of_moving(np.full(len(going_on), 13), going_on) > 0.0
    true_gain = betabinom.logpmf(going_on, 13, *MOVING) - betabinom.logpmf(going_on, 13, *stands)
    ideal = true_gain + np.log(max(moving, 1) / 3000) > 0.0
    assert found[:3000].mean() <= ideal[:3000].mean() + 0.02
    if mean > 0.9:  # else what stands looks much as what moves
        assert found[3000:].sum() >= 0.8 * ideal[3000:].sum()


def test_points_of_a_parked_car_stay_as_other_units_see_it_too() -> None:
    simulated = street(PARKED)
    mapper = mapped(simulated, lambda shown: np.random.default_rng(3).random(len(shown)) < 0.3)
    assert len(found_in(mapper)) <= 0.01 * len(mapper.tracks)


def test_nothing_is_said_where_hardly_any_point_is_seen_by_two_units() -> None:
    """Units far apart, as of a vehicle that is fast and takes few images."""
    simulated = street(PARKED)
    lucky = np.random.default_rng(4).random(len(simulated.truth.points_m) + 80) < 0.1
    mapper = mapped(simulated, lambda shown: ~lucky[shown])
    assert mapper.triangulated.sum() > 500
    assert not len(found_in(mapper))


def test_points_alone_in_their_surroundings_stay() -> None:
    simulated = make_simulated_drive(units=12, points=300, straight=True)
    mapper = mapped(simulated, lambda shown: shown % 4 == 0)
    assert not len(found_in(mapper))


def test_the_road_in_front_of_the_vehicle_stays_though_few_of_its_points_go_on() -> None:
    """Of what is on the ground no point is matched between units, of all else every one is."""
    simulated = make_simulated_drive(units=12, points=6000, straight=True)
    first, points_m = simulated.truth.world_from_rig[0], simulated.truth.points_m
    height_m = (points_m - first[:3, 3]) @ first[:3, 2]
    on_ground = height_m < np.quantile(height_m, 0.01) + 0.1
    mapper = mapped(simulated, lambda shown: on_ground[shown])
    shown = shown_points(mapper, simulated)
    assert (mapper.triangulated & on_ground[shown]).sum() > 100
    assert not on_ground[shown[found_in(mapper)]].any()


@pytest.mark.parametrize("points", [1, 5, 400])
def test_neighbours_are_the_nearest_within_reach(points: int) -> None:
    rng = np.random.default_rng(points)
    points_m = rng.normal(size=(points, 3)) * [2.0, 6.0, 1.0]
    goes_on = rng.random(points) < 0.5
    asked = np.flatnonzero(rng.random(points) < 0.7)
    neighbours, going_on = np.zeros(len(asked), dtype=np.int64), np.zeros(len(asked), dtype=np.int64)
    begins, first = np.array([0, points]), np.array([0, len(asked)])
    axis, order = single_unit_tracks._sorted_in_units(points_m, begins, first)
    single_unit_tracks._count_in_units(points_m, goes_on, axis, order, begins, asked, first, 0, 1, neighbours, going_on)
    tree = cKDTree(points_m)
    for row, own in enumerate(asked):
        inside = [m for m in tree.query_ball_point(points_m[own], single_unit_tracks.REACH_M) if m != own]
        inside.sort(key=lambda m: float(np.linalg.norm(points_m[m] - points_m[own])))
        nearest = inside[: single_unit_tracks.NEIGHBOURS]
        assert neighbours[row] == len(nearest)
        assert going_on[row] == goes_on[nearest].sum()
    assert len(asked) < 100 or 0 < (neighbours == single_unit_tracks.NEIGHBOURS).sum() < len(asked)
