"""Matches of a simulated route: geometry, wrong ones, revisits."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.benchmark.simulated_matches import FALSE_MATCHES, WRONG, simulate_matches
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.verification import epipolar_errors, in_front_of_both
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.synthetic.city import city_route
from mrasfm_engine.synthetic.long_route import LongRoute, observe_route
from mrasfm_engine.synthetic.rigs import true_cameras
from tests.helpers.simulated_drive import make_drive

CONFIG = EngineConfig()
UNITS_ONCE, UNITS = 25, 50
WIDTH, HEIGHT = 1240, 376


@pytest.fixture(scope="module")
def route() -> LongRoute:
    """A street that is driven twice: the second time it begins anew 0.4 m farther on."""
    rng = np.random.default_rng(0)
    travelled_m = np.concatenate([np.arange(UNITS_ONCE), np.arange(UNITS_ONCE) + 0.4])
    poses = city_route(30.0, rng).world_from_rig(travelled_m)
    return observe_route(true_cameras(2, width=WIDTH, height=HEIGHT, rng=rng), poses)


def matched(route: LongRoute, seed: int = 2) -> list[PairMatches]:
    params = np.array([camera.params for camera in route.cameras])
    rig_from_cam = np.stack([camera.rig_from_cam for camera in route.cameras])
    drive = make_drive(rig_from_cam, params, units=UNITS, size_px=(WIDTH, HEIGHT))
    return simulate_matches(drive, route, CONFIG, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def pairs(route: LongRoute) -> list[PairMatches]:
    return matched(route)


def true_share(route: LongRoute, pair: PairMatches) -> float:
    a, b = route.point[pair.image_a][pair.matches[:, 0]], route.point[pair.image_b][pair.matches[:, 1]]
    return float((a == b).mean())


def gap(pair: PairMatches) -> int:
    return pair.image_b // 2 - pair.image_a // 2


def rays(route: LongRoute, image: int, keypoints: np.ndarray) -> np.ndarray:
    params = np.array(route.cameras[image % 2].params)
    xy = (route.xy_px[image][keypoints] - params[2:]) / params[:2]
    found = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_a_tenth_is_wrong(route: LongRoute, pairs: list[PairMatches]) -> None:
    near = [pair for pair in pairs if not pair.is_revisit]
    assert len(near) > 400
    total = sum(len(pair.matches) for pair in near)
    wrong = sum(len(pair.matches) * (1 - true_share(route, pair)) for pair in near) / total
    assert 0.9 * WRONG < wrong < 1.2 * WRONG
    assert 150 < total / len(near) < 350


def test_pairs_are_as_the_matching_stage_leaves_them(route: LongRoute, pairs: list[PairMatches]) -> None:
    ends = [(pair.image_a, pair.image_b) for pair in pairs]
    assert ends == sorted(set(ends))
    for pair in pairs:
        assert pair.image_a < pair.image_b
        assert len(pair.matches) >= CONFIG.matching.min_matches
        assert pair.matches.dtype == np.int32
        assert pair.inliers.all()
        for side, image in ((0, pair.image_a), (1, pair.image_b)):
            assert len(np.unique(pair.matches[:, side])) == len(pair.matches)
            assert pair.matches[:, side].min() >= 0
            assert pair.matches[:, side].max() < len(route.point[image])


def test_wrong_matches_pass_verification(route: LongRoute, pairs: list[PairMatches]) -> None:
    pair = next(pair for pair in pairs if (pair.image_a, pair.image_b) == (10, 14))
    world_from_cam = [route.world_from_rig[i // 2] @ route.cameras[i % 2].rig_from_cam for i in (10, 14)]
    b_from_a = se3.inverse(world_from_cam[1]) @ world_from_cam[0]
    is_wrong = route.point[10][pair.matches[:, 0]] != route.point[14][pair.matches[:, 1]]
    assert is_wrong.sum() > 10
    wrong = pair.matches[is_wrong]
    ends = rays(route, 10, wrong[:, 0]), rays(route, 14, wrong[:, 1])
    focal_px = max(camera.params[0] for camera in route.cameras)
    assert (epipolar_errors(b_from_a, *ends) * focal_px).max() < CONFIG.matching.max_error_px
    assert in_front_of_both(b_from_a, *ends).all()


def test_revisits_are_found_missed_and_mistaken(route: LongRoute, pairs: list[PairMatches]) -> None:
    far = [pair for pair in pairs if pair.is_revisit]
    true = [pair for pair in far if true_share(route, pair) > 0.5]
    false = [pair for pair in far if true_share(route, pair) < 0.1]
    assert len(true) + len(false) == len(far)
    assert all(abs(gap(pair) - UNITS_ONCE) <= 6 for pair in true)
    again = {pair.image_b // 2 for pair in true}
    assert 0.5 * UNITS_ONCE < len(again) <= UNITS_ONCE
    assert 0 < len(false) < 0.3 * UNITS
    assert all(len(pair.matches) < FALSE_MATCHES[1] for pair in false)


def test_the_seed_decides(route: LongRoute, pairs: list[PairMatches]) -> None:
    again, other = matched(route), matched(route, seed=1)
    assert all(np.array_equal(a.matches, b.matches) for a, b in zip(pairs, again, strict=True))
    assert not np.array_equal(pairs[0].matches, other[0].matches)
