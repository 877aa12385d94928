from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.matching.image_motion import (
    Motion,
    are_following,
    following_units,
    motion_from_images,
    next_in_time,
    spacing_m,
)
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.pair_choice import PairChoice
from mrasfm_engine.matching.pair_matching import NO_PRIOR, match_pairs
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import SimulatedDrive, make_simulated_drive

CONFIG = EngineConfig(threads=1)
Rays = Callable[[PairMatches], tuple[np.ndarray, np.ndarray]]


def motion_of(simulated: SimulatedDrive) -> Motion:
    result = []

    def further(found: list[PairMatches], rays_of: Rays) -> np.ndarray:
        result.append(motion_from_images(simulated.drive, found, rays_of, max_depth_m=50.0))
        return np.zeros((0, 2), dtype=np.int64)

    match_pairs(
        simulated.drive, simulated.features, next_in_time(simulated.drive), NearestNeighbourMatcher(CONFIG.matching),
        CONFIG.matching, CONFIG.bundle_adjustment, threads=1, further=further,
    )  # fmt: skip
    return result[0]


@pytest.mark.parametrize("step_m", [0.17, 1.1, 2.0])
def test_images_tell_the_distance_to_a_factor_of_two(step_m: float) -> None:
    """The street of the simulation is nearer or farther than what fills a view evenly, the ratio is the same."""
    motion = motion_of(make_simulated_drive(units=8, cameras=2, points=3000, spacing_m=step_m))
    steps_m = np.diff(motion.travelled_m)
    assert 0.5 * step_m < np.median(steps_m) < 2.0 * step_m
    assert 0.0 < np.std(steps_m) < 0.4 * step_m


def test_a_standing_car_stays() -> None:
    travelled_m = np.array([0.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 3.0])
    motion = motion_of(make_simulated_drive(units=8, cameras=2, points=1500, travelled_m=travelled_m))
    steps_m = np.diff(motion.travelled_m)
    assert steps_m[2:6].max() < 0.1
    assert steps_m[[0, 1, 6]].min() > 0.5


def test_matches_get_fewer_with_distance() -> None:
    motion = motion_of(make_simulated_drive(units=12, cameras=1, points=2500, spacing_m=2.0))
    expected = [motion.expected_matches(0, 5, other) for other in (6, 7, 9, 11)]
    assert expected == sorted(expected, reverse=True)
    assert 15 < expected[1] < expected[0] < 1000
    unknown = Motion.from_travelled(make_simulated_drive(units=3, cameras=1, points=100).drive, np.arange(3.0))
    assert unknown.expected_matches(0, 0, 2) == np.inf


def candidate_gaps(simulated: SimulatedDrive) -> np.ndarray:
    choice = PairChoice(simulated.drive, simulated.features, NO_PRIOR, CONFIG)
    assert choice.further is not None
    result = match_pairs(
        simulated.drive, simulated.features, choice.first, NearestNeighbourMatcher(CONFIG.matching), CONFIG.matching,
        CONFIG.bundle_adjustment, threads=1, further=choice.further,
    )  # fmt: skip
    unit = [image.unit for image in simulated.drive.images]
    pairs = choice.with_revisits(result.pairs)
    assert not any(pair.is_revisit for pair in pairs)
    return np.array([unit[pair.image_b] - unit[pair.image_a] for pair in pairs])


def test_windows_without_a_prior_count_motion() -> None:
    """A slow car at 30 Hz, a car in town at 10 Hz, a fast one at 2 Hz."""
    slow, town, fast = (
        candidate_gaps(make_simulated_drive(units=units, cameras=1, points=points, spacing_m=step_m))
        for step_m, units, points in ((0.17, 40, 1500), (1.1, 20, 1500), (12.0, 10, 350))
    )
    assert slow.max() > 10
    assert 3 not in slow.tolist()  # nor more of the same
    assert 4 <= town.max() <= 6
    assert fast.max() <= 3
    assert 2 * 40 - 3 < len(slow) <= 4 * 40
    assert 2 * 20 < len(town) <= 4 * 20


def test_following_units_are_spaced_and_few() -> None:
    path = np.concatenate([np.arange(0, 3, 0.1), np.full(20, 3.0), np.arange(3, 30, 1.5)])
    ahead = following_units(path, spacing_m=0.9, count=4)
    assert [len(units) for units in ahead[:3]] == [4, 4, 4]
    for unit, units in enumerate(ahead):
        assert units[:2].tolist() == list(range(unit + 1, min(unit + 3, len(path))))
        assert (np.diff(path[units[1:]]) > 0.899).all()
    assert ahead[-1].tolist() == []
    # From where it stands it looks as far as it goes on.
    assert path[ahead[35][-1]] > 3.9
    assert [len(units) for units in following_units(path, spacing_m=0.9, count=1)[:2]] == [1, 1]
    assert spacing_m(50.0) == pytest.approx(0.87, abs=0.01)


def test_units_follow_one_another_in_either_order() -> None:
    ahead = following_units(np.arange(6.0), spacing_m=2.0, count=3)
    pairs = np.array([(0, 0), (0, 1), (1, 0), (2, 0), (0, 3), (0, 4), (4, 0)])
    assert are_following(ahead, *pairs.T).tolist() == [True, True, True, True, False, True, True]


def test_pairs_far_along_the_path_are_revisits() -> None:
    simulated = make_simulated_drive(units=40, cameras=1, points=300)
    choice = PairChoice(simulated.drive, simulated.features, NO_PRIOR, CONFIG)
    drive = Drive(simulated.drive.root, simulated.drive.manifest)
    choice.motion = Motion.from_travelled(drive, 1.1 * np.arange(40))
    one = PairMatches(image_a=0, image_b=1, matches=np.zeros((1, 2), np.int32), inliers=np.ones(1, dtype=np.bool_))
    pairs = [replace(one, image_b=b) for b in (1, 4, 10, 30)]
    assert [pair.is_revisit for pair in choice.with_revisits(pairs)] == [False, False, False, True]


def test_units_that_show_nothing_are_passed_over() -> None:
    usable = np.ones(12, dtype=np.bool_)
    usable[3:9] = False
    ahead = following_units(np.arange(12.0), spacing_m=1.5, count=3, usable=usable)
    assert ahead[2].tolist() == [9, 10]
    assert ahead[1].tolist() == [2, 9, 11]
    assert ahead[5].tolist() == [9, 10]
    assert not set(np.concatenate(ahead).tolist()) & set(range(3, 9))
