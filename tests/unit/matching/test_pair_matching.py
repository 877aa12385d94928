from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig, PairConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.pair_selection import pairs_from_window
from tests.helpers.simulated_drive import make_simulated_drive

CALIBRATION = BundleAdjustmentConfig()


def test_matches_are_verified_and_nothing_is_lost_silently() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=600)
    config, calls = MatchConfig(), []
    candidates = pairs_from_window(simulated.drive, PairConfig())
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
    pairs = pairs_from_window(simulated.drive, PairConfig())
    counts = []
    for drive in (right.drive, simulated.drive):
        found = match_pairs(
            drive, simulated.features, pairs, NearestNeighbourMatcher(config), config, CALIBRATION, threads=1
        ).pairs
        inside = [p for p in found if drive.images[p.image_a].unit == drive.images[p.image_b].unit]
        counts.append((sum(int(p.inliers.sum()) for p in inside), sum(int(p.inliers.sum()) for p in found)))
    (inside, over_all), (inside_turned, over_all_turned) = counts
    assert inside > 100
    assert inside_turned == pytest.approx(share * inside, abs=0.1 * inside)
    assert over_all_turned - inside_turned == pytest.approx(over_all - inside, rel=0.05)


def test_cancelling() -> None:
    simulated = make_simulated_drive(units=3, cameras=1, points=300)
    config = MatchConfig()
    with pytest.raises(CancelledError):
        match_pairs(
            simulated.drive,
            simulated.features,
            pairs_from_window(simulated.drive, PairConfig()),
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
    candidates = pairs_from_window(simulated.drive, PairConfig())
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
    candidates = pairs_from_window(simulated.drive, PairConfig())
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
