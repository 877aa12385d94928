"""Relief of a road from those of its points that are supported: local planes above the patches, held near them."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry.small_cholesky import factorise, solve
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.scene.road_relief import NODE_M, Relief
from mrasfm_engine.types import Floats, Ints

LEVELS_M = 1.0  # of height that share a node: roads above one another are farther apart
NEAREST = 24  # points that a node's plane is fitted to: they leave a tenth of a point's noise in its two slopes
REACH_M = 3.0
# What the relief is where nothing tells: kerbs and bumps are 10 to 15 cm high, crowns slope by some per cent.
SIGMA_HEIGHT_M, SIGMA_SLOPE = 0.07, 0.07
ROBUST_SIGMAS = 4.5  # beyond which a point has no weight
CHANCE = 1.0  # of a plane's three numbers, in squared sigmas: James and Stein's for three
STEPS = 3  # of reweighted least squares


def fit_relief(foot_m: Floats, offset_m: Floats, sigma_m: Floats, *, roughness_m: float, threads: int = 1) -> Relief:
    """The relief through points whose feet on the patches (n, 3), offsets (n,) and standard deviations are given."""
    if not len(foot_m):
        return Relief.none()
    cell = np.floor(foot_m / [NODE_M, NODE_M, LEVELS_M]).astype(np.int64)
    cell -= cell.min(axis=0)
    rows, columns = cell[:, 1].max() + 1, cell[:, 2].max() + 1
    cells, member = np.unique((cell[:, 0] * rows + cell[:, 1]) * columns + cell[:, 2], return_inverse=True)
    counts = np.bincount(member, minlength=len(cells))
    node = np.column_stack([np.bincount(member, foot_m[:, k], minlength=len(cells)) / counts for k in range(3)])
    found = cKDTree(foot_m).query(node, k=min(NEAREST, len(foot_m)), distance_upper_bound=REACH_M, workers=threads)
    away = np.asarray(found[0], dtype=np.float64).reshape(len(node), -1)
    row: Ints = np.where(np.isfinite(away), np.asarray(found[1]).reshape(away.shape), 0).astype(np.int64)
    plane, sigma = np.zeros((len(node), 3)), np.zeros(len(node))
    variance = sigma_m**2 + roughness_m**2
    in_ranges(threads, len(node), partial(_fit_nodes, node, foot_m, offset_m, variance, away, row, plane, sigma))
    return Relief(node_m=node, height_m=plane[:, 0], slope=plane[:, 1:], sigma_m=sigma)


@njit(cache=True, nogil=True)
def _fit_nodes(
    node: Any, foot: Any, offset: Any, variance: Any, away: Any, row: Any, plane: Any, sigma: Any, lo: int, hi: int
) -> None:
    """Fit the planes (n, 3) of nodes lo to hi, and their heights' standard deviations, to their nearest points."""
    _fit_each(
        node, foot, offset, variance, away, row, plane, sigma, lo, hi,
        np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.ones(3),
    )  # fmt: skip


@uncounted()
def _fit_each(
    node: Any, foot: Any, offset: Any, variance: Any, away: Any, row: Any, plane: Any, sigma: Any, lo: int, hi: int,
    h: Any, factor: Any, g: Any, x: Any, design: Any,
) -> None:  # fmt: skip
    for n in range(lo, hi):
        reach = NODE_M / 2
        for a in range(away.shape[1]):
            if away[n, a] < np.inf:
                reach = max(reach, away[n, a])
        reach *= 1.05  # the farthest one counts a little
        x[:] = 0.0
        for step in range(STEPS):
            h[:] = 0.0
            g[:] = 0.0
            h[0, 0], h[1, 1], h[2, 2] = SIGMA_HEIGHT_M**-2, SIGMA_SLOPE**-2, SIGMA_SLOPE**-2
            for a in range(away.shape[1]):
                if away[n, a] == np.inf:
                    continue
                j = row[n, a]
                design[1], design[2] = foot[j, 0] - node[n, 0], foot[j, 1] - node[n, 1]
                w = (1.0 - (away[n, a] / reach) ** 2) ** 2 / variance[j]
                if step > 0:
                    off = offset[j] - x[0] - x[1] * design[1] - x[2] * design[2]
                    w *= max(1.0 - off * off / (ROBUST_SIGMAS * ROBUST_SIGMAS * variance[j]), 0.0) ** 2
                for p in range(3):
                    g[p] += w * design[p] * offset[j]
                    for q in range(3):
                        h[p, q] += w * design[p] * design[q]
            factorise(h, 3, factor)  # positive by what the relief is where nothing tells
            solve(factor, g, 3, x)
        # Where noise would make as much of it, there is no relief: shrunk as James and Stein (1961) do.
        evidence = 0.0
        for p in range(3):
            for q in range(3):
                evidence += x[p] * h[p, q] * x[q]
        left = 1.0 - CHANCE / evidence if evidence > CHANCE else 0.0
        for p in range(3):
            plane[n, p] = x[p] * left
        # Weights that fall with distance count a point as less precise than it is: the deviation is no smaller.
        g[0], g[1], g[2] = 1.0, 0.0, 0.0
        solve(factor, g, 3, x)
        sigma[n] = math.sqrt(x[0])
