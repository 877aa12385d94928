from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.network import Network
from mrasfm_engine.matching.lighterglue import LighterGlueMatcher
from mrasfm_engine.matching.lightglue import ColmapLightGlueMatcher, LightGlueMatcher
from mrasfm_engine.matching.network_matcher import NetworkMatcher
from mrasfm_engine.matching.superglue import SuperGlueMatcher
from mrasfm_engine.scene.scene import ImageFeatures
from tests.helpers import learned_graphs

WIDTH, HEIGHT = 1000, 600
CASES: list[tuple[type[NetworkMatcher], Callable[[], bytes], int]] = [
    (LighterGlueMatcher, learned_graphs.lighterglue, 64),
    (LightGlueMatcher, learned_graphs.lightglue, 256),
    (ColmapLightGlueMatcher, learned_graphs.colmap_lightglue, 128),
    (SuperGlueMatcher, learned_graphs.superglue, 256),
]


def features(descriptors: np.ndarray, xy: np.ndarray | None = None) -> ImageFeatures:
    n = len(descriptors)
    return ImageFeatures(
        xy_px=np.zeros((n, 2), np.float32) if xy is None else xy.astype(np.float32),
        descriptors=descriptors.astype(np.float32),
        colors=np.zeros((n, 3), np.uint8),
        scores=np.ones(n, np.float32),
    )


def matched(matcher: NetworkMatcher, a: ImageFeatures, b: ImageFeatures) -> np.ndarray:
    pair = (matcher.prepare(f, width=WIDTH, height=HEIGHT) for f in (a, b))
    return matcher.match(*pair)


def unit(rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    d = rng.normal(size=(n, size))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize(("matcher", "graph", "size"), CASES)
def test_planted_matches_are_found_and_unlikely_ones_left_out(
    matcher: type[NetworkMatcher], graph: Callable[[], bytes], size: int
) -> None:
    rng = np.random.default_rng(0)
    a, order = unit(rng, 90, size), rng.permutation(90)[:50]
    b = np.concatenate([a[order], unit(rng, 20, size)])
    found = matched(matcher(Network("m", graph(), gpu=False), MatchConfig(min_score=0.9)), features(a), features(b))
    assert found.dtype == np.int32
    assert sorted(map(tuple, found.tolist())) == sorted(zip(order.tolist(), range(50), strict=True))


@pytest.mark.parametrize(("matcher", "graph", "size"), CASES)
def test_only_the_strongest_keypoints_are_matched(
    matcher: type[NetworkMatcher], graph: Callable[[], bytes], size: int
) -> None:
    d = unit(np.random.default_rng(1), 60, size)
    network = Network("m", graph(), gpu=False)
    found = matched(matcher(network, MatchConfig(max_keypoints=20, min_score=0.9)), features(d), features(d))
    np.testing.assert_array_equal(found, np.stack([np.arange(20)] * 2, axis=1))


@pytest.mark.parametrize(("matcher", "graph", "size"), CASES)
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 9), (9, 0), (1, 9), (9, 1)])
def test_hardly_any_keypoints(
    matcher: type[NetworkMatcher], graph: Callable[[], bytes], size: int, n: int, m: int
) -> None:
    rng = np.random.default_rng(2)
    pair = features(unit(rng, n, size)), features(unit(rng, m, size))
    assert matched(matcher(Network("m", graph(), gpu=False), MatchConfig()), *pair).shape == (0, 2)


@pytest.mark.parametrize(
    ("matcher", "corner", "middle"),
    [
        (LighterGlueMatcher, (-1.0, -0.6), (0.0, 0.0)),
        (LightGlueMatcher, (-1.0, -0.6), (0.0, 0.0)),
        (SuperGlueMatcher, (-0.5 / 0.7, -0.3 / 0.7), (0.0, 0.0)),
        (ColmapLightGlueMatcher, (0.0, 0.0), (500.0, 300.0)),
    ],
)
def test_keypoints_are_given_in_the_networks_units(
    matcher: type[NetworkMatcher], corner: tuple[float, float], middle: tuple[float, float]
) -> None:
    graph = {m: g for m, g, _ in CASES}[matcher]
    xy = np.array([[0.5, 0.5], [500.5, 300.5]])
    given = matcher(Network("m", graph(), gpu=False), MatchConfig()).prepare(
        features(np.zeros((2, 8)), xy), width=WIDTH, height=HEIGHT
    )
    np.testing.assert_allclose(given.xy[0], [corner, middle], atol=1e-6)
    np.testing.assert_array_equal(given.size, [[WIDTH, HEIGHT]])


def test_colmaps_network_gets_the_sizes_of_both_images() -> None:
    rng = np.random.default_rng(3)
    share, order = rng.random((40, 2)), rng.permutation(40)
    matcher = ColmapLightGlueMatcher(
        Network("m", learned_graphs.colmap_lightglue(places_only=True), gpu=False), MatchConfig()
    )
    d = np.zeros((40, 8))
    a = matcher.prepare(features(d, share * [800, 600] + 0.5), width=800, height=600)
    b = matcher.prepare(features(d, share[order] * [1920, 1080] + 0.5), width=1920, height=1080)
    found = matcher.match(a, b)
    assert len(found) == 40
    np.testing.assert_array_equal(order[found[:, 1]], found[:, 0])


@pytest.mark.parametrize(
    ("pairs", "scores"),
    [
        ([[0, 5]], [0.9]),  # there are five
        ([[0, 1], [-1, -1]], [0.9, 0.9]),  # padding
        ([[0, 1]], [0.9, 0.9]),
        ([0, 1], [0.9]),
    ],
)
def test_matches_that_are_none_are_refused(
    pairs: list[list[int]], scores: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Network("padded", learned_graphs.lightglue(), gpu=False)
    given = {"matches0": np.array(pairs), "mscores0": np.array(scores, np.float32)}
    monkeypatch.setattr(network, "run", lambda feed: given)
    five = features(unit(np.random.default_rng(0), 5, 256))
    with pytest.raises(InputError, match="model padded gives matches"):
        matched(LightGlueMatcher(network, MatchConfig()), five, five)


@pytest.mark.parametrize(
    ("pairs", "scores", "what"),
    [
        ([[0, 1], [2, 3]], [0.9, np.nan], "scores that are not finite numbers"),
        ([[0, 1], [2, 3]], [0.9, np.inf], "scores that are not finite numbers"),
        ([[0, 1], [0, 2]], [0.9, 0.9], "a keypoint more than one partner"),
        ([[0, 1], [2, 1]], [0.9, 0.9], "a keypoint more than one partner"),
    ],
)
def test_matches_that_say_nothing_are_refused(
    pairs: list[list[int]], scores: list[float], what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Network("odd", learned_graphs.lightglue(), gpu=False)
    given = {"matches0": np.array(pairs), "mscores0": np.array(scores, np.float32)}
    monkeypatch.setattr(network, "run", lambda feed: given)
    five = features(unit(np.random.default_rng(0), 5, 256))
    with pytest.raises(InputError, match=f"model odd gives {what}"):
        matched(LightGlueMatcher(network, MatchConfig()), five, five)


@pytest.mark.parametrize(
    ("partners", "scores"),
    [
        ([np.nan, 1, 2, 3, 4], [0.9] * 5),
        ([1e30, 1, 2, 3, 4], [0.9] * 5),
        ([0, 1, 2, 3, 4], [0.9] * 4),
        ([0, 1, 2, 3], [0.9] * 4),
        ([0, 1, 2, 3, 5], [0.9] * 5),  # there are five
    ],
)
def test_partners_that_are_no_keypoints_are_refused(
    partners: list[float], scores: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Network("odd", learned_graphs.colmap_lightglue(), gpu=False)
    given = {"matches0": np.array(partners, np.float32), "mscores0": np.array(scores, np.float32)}
    monkeypatch.setattr(network, "run", lambda feed: given)
    five = features(unit(np.random.default_rng(0), 5, 8))
    with pytest.raises(InputError, match="model odd gives"):
        matched(ColmapLightGlueMatcher(network, MatchConfig()), five, five)
