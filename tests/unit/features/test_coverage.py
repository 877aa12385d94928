"""The order in which keypoints are taken, against its definition."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.features.coverage import covering_order


def crowd_and_few(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """300 strong keypoints in a corner of 60 px, then 60 weak ones on a grid over 600 x 400 px; which are the crowd."""
    crowd = rng.uniform(0, 60, (300, 2))
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(10) * 60.0 + 30, np.arange(6) * 60.0 + 90))
    xy = np.concatenate([crowd, np.stack([column, row], axis=1)]).astype(np.float32)
    return xy, np.arange(len(xy)) < len(crowd)


def test_a_crowd_of_strong_keypoints_does_not_push_out_weak_ones_elsewhere() -> None:
    xy, is_crowd = crowd_and_few(np.random.default_rng(0))
    first = covering_order(xy)[:80]
    assert (~is_crowd[first]).sum() == 60
    assert is_crowd[first].sum() == 20
    # By strength alone it would be the crowd only.
    assert is_crowd[:80].all()


def test_of_a_crowd_the_strongest_comes_first() -> None:
    xy, is_crowd = crowd_and_few(np.random.default_rng(1))
    order = covering_order(xy)
    assert order[0] == 0
    of_crowd = order[is_crowd[order]]
    assert of_crowd[0] == 0
    # Two of the crowd at one place: the weaker one is the last of all.
    doubled = np.concatenate([xy, xy[17:18]])
    assert covering_order(doubled)[-1] == len(xy)


def test_any_number_of_the_first_are_those_without_a_stronger_one_near() -> None:
    xy = np.random.default_rng(2).uniform(0, 500, (400, 2)).astype(np.float32)
    order = covering_order(xy)
    assert sorted(order.tolist()) == list(range(len(xy)))
    nearest_stronger = np.array(
        [np.inf, *(np.linalg.norm(xy[:i] - xy[i], axis=1).min() for i in range(1, len(xy)))], dtype=np.float64
    )
    assert (np.diff(nearest_stronger[order][1:]) <= 1e-3).all()
    for k in (20, 100, 300):
        reach = nearest_stronger[order[k]]
        assert len(cKDTree(xy[order[:k]]).query_pairs(reach - 1e-3)) == 0
        assert len(cKDTree(xy[:k]).query_pairs(reach - 1e-3)) > 0


def test_no_keypoint_and_one_keypoint() -> None:
    assert covering_order(np.zeros((0, 2), np.float32)).shape == (0,)
    assert covering_order(np.ones((1, 2), np.float32)).tolist() == [0]
