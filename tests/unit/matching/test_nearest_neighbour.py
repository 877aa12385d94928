from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.bounded_cache import bytes_of
from mrasfm_engine.config import MatchConfig
from mrasfm_engine.matching import integer_products, nearest_neighbour
from mrasfm_engine.matching.integer_products import RightSide, missing
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher, Prepared
from mrasfm_engine.scene.scene import ImageFeatures
from tests.helpers.simulated_drive import random_descriptors


def features(descriptors: np.ndarray) -> ImageFeatures:
    n = len(descriptors)
    return ImageFeatures(xy_px=np.zeros((n, 2), np.float32), descriptors=descriptors, colors=np.zeros((n, 3), np.uint8))


def match_by(similarity: np.ndarray, ratio: float) -> np.ndarray:
    """Match two images whose descriptors have given cosines (n, m): those of the first have them as elements."""
    n, m = similarity.shape
    a = Prepared(similarity, np.zeros((m, n), np.float32), np.zeros(n, np.float32), np.ones(n, np.float32))
    b = Prepared(np.eye(m, dtype=np.float32), np.eye(m, dtype=np.float32), *(np.ones(m, np.float32) for _ in range(2)))
    return NearestNeighbourMatcher(MatchConfig(ratio=ratio)).match(a, b)


def brute_force(similarity: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    distance2 = 2 - 2 * similarity.astype(np.float64)
    result = []
    for i in range(len(distance2)):
        nearest = np.argsort(distance2[i], kind="stable")
        j = int(nearest[0])
        if int(np.argmin(distance2[:, j])) == i and distance2[i, j] < ratio**2 * distance2[i, nearest[1]]:
            result.append((i, j))
    return result


@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.95])
@pytest.mark.parametrize("seed", range(3))
def test_mutual_ratio_agrees_with_brute_force(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(60, 16))
    b = np.concatenate([a[rng.permutation(60)[:40]] + rng.normal(size=(40, 16)) * 0.5, rng.normal(size=(15, 16))])
    a, b = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (a, b))
    similarity = (a @ b.T).astype(np.float32)
    found = [tuple(pair) for pair in match_by(similarity, ratio).tolist()]
    assert found == brute_force(similarity, ratio)
    assert 5 < len(found) < 55


@pytest.mark.parametrize(("n", "m"), [(70, 64), (150, 129), (90, 300), (300, 63)])
def test_mutual_ratio_agrees_with_brute_force_over_many_columns(n: int, m: int) -> None:
    rng = np.random.default_rng(n)
    a, b = (rng.normal(size=(k, 16)) for k in (n, m))
    both = min(n, m) // 2
    b[:both] = a[rng.permutation(n)[:both]] + rng.normal(size=(both, 16)) * 0.4
    b[both] = b[0]  # as near as another one: neither matches
    a, b = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (a, b))
    similarity = (a @ b[rng.permutation(m)].T).astype(np.float32)
    found = [tuple(pair) for pair in match_by(similarity, 0.8).tolist()]
    assert found == brute_force(similarity, 0.8)
    assert both / 3 < len(found) < 2 * both


def test_of_equal_descriptors_one_matches_at_most() -> None:
    similarity = np.full((3, 80), -0.5, np.float32)
    similarity[:2, 70] = 0.9
    assert match_by(similarity, 0.8).tolist() == [[0, 70]]


def test_planted_matches_are_found_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    a, order = random_descriptors(200, rng), rng.permutation(200)[:120]
    b = np.concatenate([a[order], random_descriptors(80, rng)])
    matcher = NearestNeighbourMatcher(MatchConfig())
    matches = matcher.match(matcher.prepare(features(a)), matcher.prepare(features(b)))
    assert matches.dtype == np.int32
    assert sorted(map(tuple, matches.tolist())) == sorted(zip(order.tolist(), range(120), strict=True))


def test_what_repeats_does_not_match() -> None:
    rng = np.random.default_rng(2)
    d = random_descriptors(30, rng)
    alike = [np.clip(d.astype(int) + rng.integers(-6, 7, d.shape), 0, 255).astype(np.uint8) for _ in range(2)]
    matcher = NearestNeighbourMatcher(MatchConfig())
    twice, once = (matcher.prepare(features(np.concatenate(f))) for f in (alike, alike[:1]))
    prepared = matcher.prepare(features(d))
    assert len(matcher.match(prepared, twice)) < 3
    assert len(matcher.match(prepared, once)) == 30


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 50), (50, 0), (1, 50), (50, 1), (2, 2)])
def test_hardly_any_keypoints(n: int, m: int) -> None:
    matcher = NearestNeighbourMatcher(MatchConfig())
    a, b = (matcher.prepare(features(random_descriptors(k, np.random.default_rng(k)))) for k in (n, m))
    matches = matcher.match(a, b)
    assert matches.shape[1] == 2
    assert len(matches) <= min(n, m)


def test_an_empty_descriptor_matches_nothing() -> None:
    d = random_descriptors(5, np.random.default_rng(3))
    d[2] = 0
    matcher = NearestNeighbourMatcher(MatchConfig())
    prepared = matcher.prepare(features(d))
    assert np.isfinite(prepared.inverse_lengths).all()
    assert matcher.match(prepared, prepared).tolist() == [[i, i] for i in (0, 1, 3, 4)]


def test_bytes_match_as_the_same_floats_do() -> None:
    rng = np.random.default_rng(5)
    a = random_descriptors(300, rng)
    b = np.clip(a[rng.permutation(300)[:200]].astype(int) + rng.integers(-25, 26, (200, 128)), 0, 255).astype(np.uint8)
    matcher = NearestNeighbourMatcher(MatchConfig())
    found = [
        matcher.match(*(matcher.prepare(features(d.astype(kind))) for d in (a, b))).tolist()
        for kind in (np.uint8, np.float32)
    ]
    assert found[0] == found[1]
    assert 150 < len(found[0]) <= 200


def test_the_memory_of_prepared_bytes_is_known() -> None:
    """Of their packed columns, which are in no array."""
    d = random_descriptors(50, np.random.default_rng(3))
    prepared = NearestNeighbourMatcher(MatchConfig()).prepare(features(d))
    rows, columns, missing_and_lengths = d.nbytes, 2 * d.nbytes, 2 * 4 * len(d)
    assert bytes_of(prepared) == rows + columns + missing_and_lengths


@pytest.mark.parametrize("signs", [True, False])
@pytest.mark.parametrize("shape", [(2, 1, 3), (5, 128, 700), (33, 64, 2)])
def test_products_of_bytes_are_exact(shape: tuple[int, int, int], signs: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    n, k, m = shape
    rng = np.random.default_rng(k)
    a, b = (rng.integers(low, 256, size, dtype=np.uint8) for low, size in ((128, (n, k)), (0, (m, k))))
    if not signs:  # as on a processor without the instruction
        monkeypatch.setattr(integer_products, "_signs_are_exact", lambda: False)
    right = RightSide(b)
    assert right.is_signed == (signs and integer_products._signs_are_exact())
    products = right.product(a) + missing(a)[:, None]
    assert np.array_equal(products, a.astype(np.int64) @ b.astype(np.int64).T)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize(("rows", "columns"), [(1, 40), (70, 40), (130, 65), (64, 4)])
def test_matches_do_not_depend_on_how_many_rows_are_taken_at_a_time(
    kind: type, rows: int, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A last part that is shorter than the others, or of one row, is compared as well, and none twice."""
    rng = np.random.default_rng(rows)
    b = random_descriptors(columns, rng)
    shared = columns // 2
    a = np.concatenate([random_descriptors(rows, rng), b[rng.permutation(columns)[:shared]]])
    matcher = NearestNeighbourMatcher(MatchConfig())
    sides = [matcher.prepare(features(descriptors.astype(kind))) for descriptors in (a, b)]
    found = []
    for step in (1, 7, len(a) - 1, len(a), 10 * len(a)):
        monkeypatch.setattr(nearest_neighbour, "_rows_at_a_time", lambda element, columns, step=step: step)
        found.append(matcher.match(*sides))
    assert len(found[0]) == shared
    np.testing.assert_array_equal(a[found[0][:, 0]], b[found[0][:, 1]])
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.parametrize("columns", [2, 511, 1500, 4096, 4097, 100_000])
def test_products_that_exist_at_one_time_stay_in_the_cache(columns: int) -> None:
    """Calls with hardly any rows cost more, and floats are not faster for it."""
    rows = nearest_neighbour._rows_at_a_time(np.dtype(np.uint8), columns)
    in_cache = nearest_neighbour.FEWEST_ROWS * columns <= nearest_neighbour.CACHED_PRODUCTS
    assert rows >= nearest_neighbour.FEWEST_ROWS
    assert rows == nearest_neighbour.ROWS or rows * columns <= nearest_neighbour.CACHED_PRODUCTS < (rows + 1) * columns
    assert in_cache == (rows * columns <= nearest_neighbour.CACHED_PRODUCTS)
    assert nearest_neighbour._rows_at_a_time(np.dtype(np.float32), columns) == nearest_neighbour.ROWS


def test_float_descriptors_of_any_length_match_too() -> None:
    rng = np.random.default_rng(4)
    a, order = rng.normal(size=(80, 64)).astype(np.float32), rng.permutation(80)[:50]
    matcher = NearestNeighbourMatcher(MatchConfig())
    matches = matcher.match(matcher.prepare(features(a)), matcher.prepare(features(3 * a[order])))
    assert sorted(map(tuple, matches.tolist())) == sorted(zip(order.tolist(), range(50), strict=True))
