from __future__ import annotations

from itertools import combinations

from mrasfm_engine.aggregation.association import choose_pairs


def test_the_best_candidates_of_every_scene_are_compared() -> None:
    scores = {(i, j): (1.0 / (j - i),) for i, j in combinations(range(6), 2)}
    chosen = choose_pairs(6, scores, 2)
    assert {(i, i + 1) for i in range(5)} <= set(chosen)
    assert len(chosen) < len(scores)


def test_two_streets_that_cross_are_compared_with_one_another() -> None:
    """Four drives along each: every one has three better candidates in its own street."""
    street = [0, 0, 0, 0, 1, 1, 1, 1]
    scores = {(i, j): (0.9 if street[i] == street[j] else 0.1 + 0.01 * i, -1.0) for i, j in combinations(range(8), 2)}
    across = [pair for pair in choose_pairs(8, scores, 3) if street[pair[0]] != street[pair[1]]]
    assert len(across) == 3
    assert all(i == 3 for i, _ in across)  # the best of them


def test_what_is_out_of_reach_is_compared_with_nothing() -> None:
    assert choose_pairs(3, {(0, 1): (0.5, -1.0)}, 3) == [(0, 1)]
    assert choose_pairs(3, {}, 3) == []
