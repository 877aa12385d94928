"""Places that look alike: matches between copies of points along facades that repeat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.components import Component, map_drive
from mrasfm_engine.mapping.mapping_report import describe, places_alike_findings
from mrasfm_engine.mapping.places_alike import SoundPairs, sound_pairs
from mrasfm_engine.matching.verification import fit_essential
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    keypoints_of,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
)

CONFIG = EngineConfig(threads=1)
PERIOD_M, SPACING_M = 12.0, 2.5
COPIES = range(-2, 8)
UNITS = 16


def along_facades(
    *, travelled_m: np.ndarray | None = None, hidden: Callable[[int, int], bool] = lambda u, c: False, seed: int = 0
) -> SimulatedDrive:
    """Two cameras on a straight street between facades whose points repeat; `point_of_keypoint` is the number of a
    point times that of its copies, plus which of these it is."""
    way_m = SPACING_M * np.arange(UNITS) if travelled_m is None else travelled_m
    simulated = make_simulated_drive(
        units=len(way_m), cameras=2, points=10, straight=True, spacing_m=SPACING_M, travelled_m=way_m, hidden=hidden
    )
    rng, truth = np.random.default_rng(seed), simulated.truth
    start = truth.world_from_rig[0]
    count = 150
    side_m = rng.choice([-1.0, 1.0], count) * rng.uniform(6.0, 9.0, count)
    once = np.stack([rng.uniform(0.0, PERIOD_M, count), side_m, rng.uniform(0.0, 6.0, count)], axis=1)
    shift = np.zeros((len(COPIES), 3))
    shift[:, 0] = PERIOD_M * np.array(COPIES)
    points_m = se3.apply(start, (once[:, None] + shift).reshape(-1, 3))
    features, numbers = [], []
    for image in simulated.drive.images:
        world_from_cam = truth.world_from_rig[image.unit] @ truth.rig_from_cam[image.camera]
        local = se3.apply(se3.inverse(world_from_cam), points_m)
        fx, fy, cx, cy = truth.camera_params[image.camera]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = local[:, :2] / local[:, 2:] * [fx, fy] + [cx, cy]
        seen = (local[:, 2] > 1.0) & (local[:, 2] < 30.0) & ((xy > 0) & (xy < truth.image_size_px)).all(axis=1)
        rows = np.flatnonzero(seen & (not hidden(image.unit, image.camera)))
        features.append(
            ImageFeatures(
                xy_px=(xy[rows] + rng.normal(0.0, 0.4, (len(rows), 2))).astype(np.float32),
                descriptors=np.zeros((len(rows), 128), np.uint8),
                colors=np.full((len(rows), 3), 128, np.uint8),
            )
        )
        numbers.append(rows)
    return replace(simulated, features=features, point_of_keypoint=numbers)


def matches(
    simulated: SimulatedDrive, share_of_copies: Callable[[PairMatches, int], float], *, window: int = 5, seed: int = 0
) -> list[PairMatches]:
    """True matches, of which some share is with the copy one period farther on; that depends on the pair and on how
    many units lie between its images."""
    rng, result, keypoints = np.random.default_rng(seed), [], keypoints_of(simulated, CONFIG)
    for pair in true_matches(simulated, window=window):
        of_a, of_b = (simulated.point_of_keypoint[image] for image in (pair.image_a, pair.image_b))
        units = [simulated.drive.images[image].unit for image in (pair.image_a, pair.image_b)]
        keypoint = {int(point): k for k, point in enumerate(of_b)}
        rows = pair.matches.copy()
        copied = rng.random(len(rows)) < share_of_copies(pair, units[1] - units[0])
        copy = np.array([keypoint.get(int(of_a[a]) + 1, -1) for a in rows[:, 0]])
        rows[copied, 1] = copy[copied]
        rows = rows[(rows[:, 1] >= 0)]
        if len(rows) >= 15:
            rays = [
                keypoints.rays[keypoints.first[k] + of]
                for k, of in zip((pair.image_a, pair.image_b), rows.T, strict=True)
            ]
            fit = fit_essential(*rays, max_error=2.0 / simulated.truth.camera_params[0, 0])
            result.append(replace(pair, matches=rows, inliers=fit.inliers, essential=fit.essential))
    return result


def is_true(simulated: SimulatedDrive, pair: PairMatches) -> np.ndarray:
    """Which inliers (n,) are of one point."""
    a, b = pair.matches[pair.inliers].T
    shown: np.ndarray = simulated.point_of_keypoint[pair.image_a][a] == simulated.point_of_keypoint[pair.image_b][b]
    return shown


def judged(simulated: SimulatedDrive, pairs: Sequence[PairMatches]) -> SoundPairs:
    return sound_pairs(simulated.drive, keypoints_of(simulated, CONFIG), pairs, CONFIG.matching)


def inliers(pairs: Sequence[PairMatches]) -> int:
    return sum(int(pair.inliers.sum()) for pair in pairs)


def gaps(simulated: SimulatedDrive, pairs: Sequence[PairMatches]) -> np.ndarray:
    unit = np.array([image.unit for image in simulated.drive.images])
    return np.array([unit[pair.image_b] - unit[pair.image_a] for pair in pairs])


def same_camera(simulated: SimulatedDrive, pair: PairMatches) -> bool:
    images = simulated.drive.images
    return images[pair.image_a].camera == images[pair.image_b].camera


FORTH_AND_BACK_M = SPACING_M * np.array([0, 1, 2, 3, 4, 4.4, 4.6, 4.6, 4.6, 4.4, 4, 3, 2, 1, 0, -1.0])


@pytest.mark.parametrize("travelled_m", [None, FORTH_AND_BACK_M, np.zeros(UNITS)], ids=["drives", "reverses", "stands"])
def test_right_matches_stay(travelled_m: np.ndarray | None) -> None:
    simulated = along_facades(travelled_m=travelled_m)
    pairs = matches(simulated, lambda pair, gap: 0.0)
    found = judged(simulated, pairs)
    assert not found.alike.any()
    assert found.turned == 0
    assert found.set_aside == []
    assert len(found.pairs) == len(pairs)
    assert inliers(found.pairs) > 0.999 * inliers(pairs)


def test_copies_that_are_fewer_go() -> None:
    simulated = along_facades()
    pairs = matches(simulated, lambda pair, gap: 0.3 if gap == 3 and same_camera(simulated, pair) else 0.0)
    found = judged(simulated, pairs)
    assert not found.alike.any()
    assert sum(int((~is_true(simulated, pair)).sum()) for pair in pairs) > 200
    assert all(is_true(simulated, pair).all() for pair in found.pairs)
    assert inliers(found.pairs) > 0.99 * sum(int(is_true(simulated, pair).sum()) for pair in pairs)


def test_images_between_tell_where_copies_are_more() -> None:
    simulated = along_facades()
    far = [p for p in matches(simulated, lambda pair, gap: 0.0) if same_camera(simulated, p)]
    one = far[int(np.flatnonzero(gaps(simulated, far) == 3)[4])]
    ends = (one.image_a, one.image_b)
    pairs = matches(simulated, lambda pair, gap: 0.8 if (pair.image_a, pair.image_b) == ends else 0.0)
    found = judged(simulated, pairs)
    assert found.turned == 1
    assert not found.alike.any()  # one pair of many
    kept = next(pair for pair in found.pairs if (pair.image_a, pair.image_b) == ends)
    assert is_true(simulated, kept).all()


def test_a_step_whose_matches_disagree_goes_the_way_of_those_around() -> None:
    simulated = along_facades()
    every = matches(simulated, lambda pair, gap: 0.0)
    one = next(p for p in every if same_camera(simulated, p) and gaps(simulated, [p])[0] == 1 and p.image_a >= 12)
    ends = (one.image_a, one.image_b)
    pairs = matches(simulated, lambda pair, gap: 0.85 if (pair.image_a, pair.image_b) == ends else 0.0)
    copied = next(pair for pair in pairs if (pair.image_a, pair.image_b) == ends)
    assert is_true(simulated, copied).mean() < 0.4
    kept = next(pair for pair in judged(simulated, pairs).pairs if (pair.image_a, pair.image_b) == ends)
    assert is_true(simulated, kept).all()


def test_where_places_look_alike_images_that_follow_one_another_are_believed_alone() -> None:
    simulated = along_facades()
    pairs = matches(simulated, lambda pair, gap: 1.0 if gap >= 3 else 0.0)
    found = judged(simulated, pairs)
    assert found.alike.all()
    assert found.turned > 0.3 * found.told > 0
    kept = gaps(simulated, found.pairs)
    assert kept.max() == 1
    assert all(same_camera(simulated, pair) or gap == 0 for pair, gap in zip(found.pairs, kept, strict=True))
    assert all(is_true(simulated, pair).all() for pair in found.pairs)
    assert len(found.pairs) + len(found.set_aside) <= len(pairs)
    following = [pair for pair in pairs if same_camera(simulated, pair) and gaps(simulated, [pair])[0] == 1]
    assert {(p.image_a, p.image_b) for p in following} <= {(p.image_a, p.image_b) for p in found.pairs}


def test_elsewhere_all_pairs_are_believed() -> None:
    simulated = along_facades()
    unit = [image.unit for image in simulated.drive.images]
    pairs = matches(simulated, lambda pair, gap: 1.0 if gap >= 3 and unit[pair.image_b] <= 6 else 0.0)
    found = judged(simulated, pairs)
    assert found.alike[:7].all()
    assert not found.alike[8:].any()
    elsewhere = [pair for pair in found.pairs if unit[pair.image_a] >= 8]
    assert gaps(simulated, elsewhere).max() >= 3
    assert all(unit[pair.image_a] <= 7 for pair in found.set_aside)


def test_images_far_apart_link_where_none_between_does() -> None:
    """Of camera 0 units 6 and 7 are missing, of camera 1 units 10 to 12: the other one links both sides."""
    lost = {(6, 0), (7, 0), (10, 1), (11, 1), (12, 1)}
    simulated = along_facades(hidden=lambda unit, camera: (unit, camera) in lost)
    found = judged(simulated, matches(simulated, lambda pair, gap: 1.0 if gap >= 3 else 0.0))
    assert gaps(simulated, found.pairs).max() == 1
    both = {(unit, camera) for unit in (6, 7) for camera in (0, 1)}
    simulated = along_facades(hidden=lambda unit, camera: (unit, camera) in both)
    unit = [image.unit for image in simulated.drive.images]

    def is_across(pair: PairMatches) -> bool:
        return unit[pair.image_a] < 6.5 < unit[pair.image_b]

    pairs = matches(simulated, lambda pair, gap: 1.0 if gap >= 3 and not is_across(pair) else 0.0)
    found = judged(simulated, pairs)
    across = [pair for pair in found.pairs if is_across(pair)]
    assert {(unit[pair.image_a], unit[pair.image_b]) for pair in across} == {(5, 8)}


def test_a_drive_without_pairs() -> None:
    simulated = along_facades()
    found = judged(simulated, [])
    assert (found.pairs, found.set_aside, found.told) == ([], [], 0)
    assert not found.alike.any()


def test_it_can_be_cancelled() -> None:
    simulated = along_facades()
    pairs = matches(simulated, lambda pair, gap: 0.0)
    with pytest.raises(CancelledError):
        sound_pairs(simulated.drive, keypoints_of(simulated, CONFIG), pairs, CONFIG.matching, lambda: True)


def mapped(simulated: SimulatedDrive, pairs: Sequence[PairMatches]) -> Component:
    return map_drive(simulated.drive, keypoints_of(simulated, CONFIG), pairs, None, CONFIG)[0]


@pytest.mark.parametrize("seed", range(2))
def test_the_scene_along_facades_that_repeat_is_right_and_says_so(seed: int) -> None:
    simulated = along_facades(seed=seed)
    share = {1: 0.2, 2: 0.6, 3: 1.0, 4: 1.0, 5: 1.0}
    part = mapped(simulated, matches(simulated, lambda pair, gap: share.get(gap, 0.0)))
    assert part.mapper.registered.all()
    assert rmse(metric_errors_m(part.mapper, simulated)) < 0.1  # with these copies among the matches, 3 m and more
    (found,) = places_alike_findings(part.mapper, part.log)
    assert (found.code, found.severity) == ("places-alike", "warning")
    assert "frames 0 to 15 at 0.0 to 1.5 s" in found.what
    assert describe(part.mapper, part.log)["places_alike"]["spans"] == [[0, 15]]


def test_a_scene_without_such_places_says_nothing() -> None:
    simulated = along_facades()
    part = mapped(simulated, matches(simulated, lambda pair, gap: 0.0))
    assert places_alike_findings(part.mapper, part.log) == []
    assert describe(part.mapper, part.log)["places_alike"] is None
