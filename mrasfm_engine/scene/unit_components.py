"""Components of a scene that positions alone put together: units that no chain of common points connects."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Ints

MIN_COMMON_POINTS = 20  # of two units that hold together: as many as a unit needs for its pose


def connected_units(scene: Scene, *, next_number: int) -> Ints:
    """Component (units,) of every unit: 0 is the largest, others count from `next_number`, larger ones first.

    Two units hold together where both observe at least `MIN_COMMON_POINTS` of the same points, and a unit without such
    a partner goes with the one that it has most points in common with. Units without observations are where the nearest
    unit in time is that has some.
    """
    units = len(scene.unit_registered)
    common = _common_points(scene)
    ends = np.stack(common.nonzero(), 1)
    strong = ends[np.asarray(common[ends[:, 0], ends[:, 1]]).ravel() >= MIN_COMMON_POINTS]
    best = np.asarray(common.argmax(axis=1)).ravel()
    alone = np.setdiff1d(ends[:, 0], strong)
    links = np.concatenate([strong, np.column_stack([alone, best[alone]])])
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(units, units))
    label = connected_components(graph, directed=False)[1]
    seeing = np.unique(scene.image_unit[scene.observation_image])
    if not len(seeing):
        return np.zeros(units, dtype=np.int64)
    sizes = np.bincount(label[seeing], minlength=units)
    order = np.argsort(-sizes, kind="stable")
    number = np.empty(units, dtype=np.int64)
    number[order] = np.concatenate([[0], next_number + np.arange(units - 1)])
    times_us = scene.drive.timestamps_us
    after = np.searchsorted(times_us[seeing], times_us).clip(1, max(len(seeing) - 1, 1))
    around = seeing[np.stack([after - 1, np.minimum(after, len(seeing) - 1)])]
    nearest = around[np.abs(times_us[around] - times_us).argmin(0), np.arange(units)]
    result: Ints = np.where(scene.unit_registered, number[label[nearest]], 0)
    return result


def _common_points(scene: Scene) -> csr_matrix:
    """Number (units, units) of points that both observe, without the diagonal, as a sparse matrix of rows."""
    unit = scene.image_unit[scene.observation_image]
    shape = (len(scene.unit_registered), len(scene.points_m))
    seen = coo_matrix((np.ones(len(unit)), (unit, scene.observation_point)), shape=shape).tocsr()
    seen.data[:] = 1.0  # a point that several images of a unit observe is one
    common = (seen @ seen.T).tocsr()
    common.setdiag(0)
    common.eliminate_zeros()
    return common
