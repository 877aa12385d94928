from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig, PairConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.pair_selection import motion_unknown, pairs_from_window
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import make_simulated_drive

CALIBRATION = BundleAdjustmentConfig()


def window_pairs(drive: Drive) -> np.ndarray:
    return pairs_from_window(drive, PairConfig(), motion_unknown(drive, PairConfig()))


def test_matches_are_verified_and_nothing_is_lost_silently() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=600)
    config, calls = MatchConfig(), []
    candidates = window_pairs(simulated.drive)
    result = match_pairs(
        simulated.drive,
        simulated.features,
        candidates,
        NearestNeighbourMatcher(config),
        config,
        CALIBRATION,
        threads=2,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert len(result.pairs) + result.few_matches + result.few_inliers == len(candidates)
    assert calls == [(k + 1, len(candidates)) for k in range(len(candidates))]
    assert len(result.pairs) > 0.9 * len(candidates)
    right = wrong = missed = 0
    for pair in result.pairs:
        assert pair.inliers.sum() >= config.min_matches
        a = simulated.point_of_keypoint[pair.image_a][pair.matches[:, 0]]
        b = simulated.point_of_keypoint[pair.image_b][pair.matches[:, 1]]
        same = (a == b) & (a >= 0)
        right += int((same & pair.inliers).sum())
        wrong += int((~same & pair.inliers).sum())
        missed += int((same & ~pair.inliers).sum())
    assert wrong <= 0.005 * right
    assert missed <= 0.05 * right
    assert right > 1000


def test_pairs_of_different_places_are_rejected_and_counted() -> None:
    simulated = make_simulated_drive(units=3, cameras=2, points=500)
    other = make_simulated_drive(units=3, cameras=2, points=500, seed=9)
    features = [simulated.features[0], other.features[1]]
    config = MatchConfig()
    result = match_pairs(
        simulated.drive,
        [*features, *simulated.features[2:]],
        np.array([[0, 1]], dtype=np.int64),
        NearestNeighbourMatcher(config),
        config,
        CALIBRATION,
        threads=1,
    )
    assert not result.pairs
    assert result.few_matches + result.few_inliers == 1


@pytest.mark.parametrize(("turned_deg", "share"), [(0.0, 1.0), (3.0, 1.0), (30.0, 0.0)])
def test_inside_a_unit_the_calibration_must_agree(turned_deg: float, share: float) -> None:
    """A camera that is off by what its prior allows is found, and keeps its matches; by ten sigmas it loses them."""
    config = MatchConfig()
    turn = se3.exp_so3(np.radians([turned_deg, 0.0, 0.0]))

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[1, :3, :3] = rig_from_cam[1, :3, :3] @ turn
        return rig_from_cam

    right = make_simulated_drive(units=3, cameras=2, points=600)
    simulated = make_simulated_drive(units=3, cameras=2, points=600, given=given)
    pairs = window_pairs(simulated.drive)
    counts = []
    for drive in (right.drive, simulated.drive):
        result = match_pairs(
            drive, simulated.features, pairs, NearestNeighbourMatcher(config), config, CALIBRATION, threads=1
        )
        found = result.pairs
        inside_pairs = [p for p in found if drive.images[p.image_a].unit == drive.images[p.image_b].unit]
        counts.append((sum(int(p.inliers.sum()) for p in inside_pairs), sum(int(p.inliers.sum()) for p in found)))
    (inside, over_all), (inside_turned, over_all_turned) = counts
    assert inside > 100
    # What contradicts the calibration stays, to be verified again once that has moved.
    assert len(inside_pairs) == 3
    assert result.against_calibration == (3 if share == 0 else 0)
    assert inside_turned == pytest.approx(share * inside, abs=0.1 * inside)
    assert over_all_turned - inside_turned == pytest.approx(over_all - inside, rel=0.05)


def test_cancelling() -> None:
    simulated = make_simulated_drive(units=3, cameras=1, points=300)
    config = MatchConfig()
    with pytest.raises(CancelledError):
        match_pairs(
            simulated.drive,
            simulated.features,
            window_pairs(simulated.drive),
            NearestNeighbourMatcher(config),
            config,
            CALIBRATION,
            threads=1,
            cancel=lambda: True,
        )


def test_matches_between_classes_are_dropped_before_verification_and_counted() -> None:
    simulated = make_simulated_drive(units=3, cameras=2, points=600)
    rng = np.random.default_rng(0)
    # A third of the keypoints has no class, the others have any.
    features = [replace(f, classes=rng.integers(0, 3, len(f.xy_px)).astype(np.uint8)) for f in simulated.features]
    candidates = window_pairs(simulated.drive)
    found = {}
    for same_class in (True, False):
        config = MatchConfig(same_class=same_class)
        found[same_class] = match_pairs(
            simulated.drive, features, candidates, NearestNeighbourMatcher(config), config, CALIBRATION, threads=1
        )
    with_classes, without = found[True], found[False]
    assert without.across_classes == 0
    for pair in with_classes.pairs:
        a, b = (features[image].classes[pair.matches[:, k]] for k, image in enumerate((pair.image_a, pair.image_b)))
        assert ((a == b) | (a == 0) | (b == 0)).all()
    matches = {same: sum(len(p.matches) for p in result.pairs) for same, result in found.items()}
    # Two ninths of random pairs of classes contradict each other.
    assert 0.7 * matches[False] < matches[True] < 0.85 * matches[False]
    assert 0.9 < (matches[True] + with_classes.across_classes) / matches[False] < 1.1


def test_without_classes_nothing_changes() -> None:
    simulated = make_simulated_drive(units=2, cameras=2, points=400)
    candidates = window_pairs(simulated.drive)
    results = []
    for same_class in (True, False):
        config = MatchConfig(same_class=same_class)
        matcher = NearestNeighbourMatcher(config)
        results.append(
            match_pairs(simulated.drive, simulated.features, candidates, matcher, config, CALIBRATION, threads=1)
        )
    assert len(results[0].pairs) == len(results[1].pairs) > 0
    for a, b in zip(results[0].pairs, results[1].pairs, strict=True):
        np.testing.assert_array_equal(a.matches, b.matches)
        np.testing.assert_array_equal(a.inliers, b.inliers)


def test_further_pairs_follow_from_what_the_first_show() -> None:
    simulated = make_simulated_drive(units=4, cameras=1, points=600)
    config, calls, asked = MatchConfig(), [], []

    def further(
        found: Sequence[PairMatches], rays_of: Callable[[PairMatches], tuple[np.ndarray, np.ndarray]]
    ) -> np.ndarray:
        asked.append([(pair.image_a, pair.image_b, len(rays_of(pair)[0]) == pair.inliers.sum()) for pair in found])
        return np.array([[0, 2], [1, 3]], dtype=np.int64)

    result = match_pairs(
        simulated.drive, simulated.features, np.array([[0, 1], [2, 3], [1, 2]]), NearestNeighbourMatcher(config),
        config, CALIBRATION, threads=2, further=further, progress=lambda done, total: calls.append((done, total)),
    )  # fmt: skip
    assert asked == [[(0, 1, True), (1, 2, True), (2, 3, True)]], "in the order of the drive"
    assert [(p.image_a, p.image_b) for p in result.pairs] == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert result.candidates == 5
    assert calls == [(1, 3), (2, 3), (3, 5), (4, 5), (5, 5)]
