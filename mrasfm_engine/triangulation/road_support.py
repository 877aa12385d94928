"""Support of a road's points: which of them agree with most of what lies around them.

A plane patch of many metres does not follow a speed bump, a crown or a parking bay behind a kerb, but points on them
agree with their neighbours; edges of shadows that move, and wrong matches, do not: true points of the road lie between
them. A point is supported where it agrees with the level that the road has around it, or, beside a step, where most
points on one side of it, or in one strip through it, are on its own level. It never supports itself, and points found
to be wrong support nobody.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.types import Bools, Floats, Ints

NEIGHBOURS = 14  # as many as leave half a disc, or a strip, enough to be a majority
REACH_M = 3.0  # of a neighbour: half a lane, beyond which the road may be another level
SMALLEST_REACH_M = 0.1
SLOPE = 0.02  # of the road about the surface, a metre of distance: a crown against a plane, a worn lane
GATE_SIGMAS = 3.0
SURFACE_SIGMAS = 2.0  # within which a point is at the surface so far
MAJORITY = 0.5  # of the points on one side, or in a strip
RIVALS = 1.5  # times what is on the surface's level there: levels of shadows lie between points of the road
LEAST_MASS = 1.0  # of agreeing neighbours, each counting by its distance: two of them, not far away
SURFACE_MASS = 1.0  # of the surface so far as a neighbour of every point,
SURFACE_SIGMA_M = 0.03  # and how uncertain it is where the road is uneven: half of what it is judged by
STEP_M = 0.3  # kerbs are lower, and so is what a plane through one half of a crown misses of the other
STRIP = 0.33  # half the width of a strip, in the distance of the farthest neighbour
SIDES = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])
STRIPS = 4  # of the directions: a strip has no side
ROUNDS = 3  # each without the support of those found wrong before
SHIFTS = 6  # mean shift ends sooner as a rule
CONVERGED_M = 1e-4


def find_supported(
    foot_m: Floats, offset_m: Floats, sigma_m: Floats, most_m: Floats, *, roughness_m: float, threads: int = 1
) -> Bools:
    """Points (n,) that agree with the road around them.

    Parameters
    ----------
    foot_m
        Feet (n, 3) of the points on the surface so far: roads above one another are apart.
    offset_m, sigma_m
        Signed distances (n,) from that surface, and their standard deviations.
    most_m
        Farthest (n,) that a point may be from the level which it agrees with, whatever its standard deviation is.
    roughness_m
        Standard deviation of the road about its surface.
    """
    supported: Bools = np.abs(offset_m) <= np.minimum(SURFACE_SIGMAS * np.hypot(sigma_m, roughness_m), most_m)
    asked = np.flatnonzero(~supported)
    if not len(asked):
        return supported
    neighbours = min(NEIGHBOURS + 1, len(foot_m))
    found = cKDTree(foot_m).query(foot_m[asked], k=neighbours, distance_upper_bound=REACH_M, workers=threads)
    away = np.asarray(found[0], dtype=np.float64).reshape(len(asked), -1)
    index: Ints = np.where(np.isfinite(away), np.asarray(found[1]).reshape(away.shape), 0).astype(np.int64)
    xy, counted = np.ascontiguousarray(foot_m[:, :2]), np.ones(len(foot_m), dtype=np.bool_)
    known = (xy, offset_m, sigma_m, most_m, roughness_m, asked, away, index)
    for _ in range(ROUNDS):
        in_ranges(threads, len(asked), partial(_judge, *known, counted, SIDES, supported))
        if (supported == counted).all():
            break
        counted = supported.copy()
    return supported


@uncounted()
def _level_from(
    start: float, offset: Any, weight: Any, variance: Any, count: int, own_variance: float
) -> tuple[float, float]:
    """The level that mean shift reaches from a start, with Tukey's weights, and its information; none has zero."""
    level, information = start, 0.0
    for _ in range(SHIFTS):
        total, information = 0.0, 0.0
        for n in range(count):
            v = variance[n] + own_variance
            e = (level - offset[n]) ** 2 / (GATE_SIGMAS * GATE_SIGMAS * v)
            if e < 1.0:
                w = weight[n] / v * (1.0 - e) ** 2
                information += w
                total += w * offset[n]
        if information <= 0.0:
            return level, 0.0
        moved = abs(total / information - level)
        level = total / information
        if moved < CONVERGED_M:
            break
    return level, information


@uncounted()
def _has_majority(level: float, rival: float, count: int, dx: Any, dy: Any, offset: Any, weight: Any, variance: Any,
                  strip_m: float, sides: Any) -> bool:  # fmt: skip
    """Return whether, on one side of a point or in a strip through it, most neighbours are on a level."""
    for way in range(len(sides) + STRIPS):
        strip = way >= len(sides)
        side = sides[way - len(sides) if strip else way]
        own, other, total = 0.0, 0.0, 0.0
        for n in range(count):
            across = dx[n] * side[0] + dy[n] * side[1]
            if (abs(across) > strip_m) if strip else (across < 0.0):
                continue
            total += weight[n]
            e = (level - offset[n]) ** 2 / (GATE_SIGMAS * GATE_SIGMAS * variance[n])
            if e < 1.0:
                own += weight[n] * (1.0 - e) ** 2
            e = (rival - offset[n]) ** 2 / (GATE_SIGMAS * GATE_SIGMAS * variance[n])
            if e < 1.0:
                other += weight[n] * (1.0 - e) ** 2
        if own >= LEAST_MASS and own >= MAJORITY * total and own >= RIVALS * other:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(
    xy: Any, offset: Any, sigma: Any, most: Any, roughness: float, asked: Any, away: Any, index: Any, counted: Any,
    sides: Any, supported: Any, lo: int, hi: int,
) -> None:  # fmt: skip
    """Judge points asked[lo] to asked[hi] by their neighbours (n, k), of which only those counted have a say."""
    k = away.shape[1] + 1
    _judge_each(
        xy, offset, sigma, most, roughness, asked, away, index, counted, sides, supported, lo, hi,
        np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
    )  # fmt: skip


@uncounted()
def _judge_each(
    xy: Any, offset: Any, sigma: Any, most: Any, roughness: float, asked: Any, away: Any, index: Any, counted: Any,
    sides: Any, supported: Any, lo: int, hi: int, z: Any, w: Any, v: Any, dx: Any, dy: Any,
) -> None:  # fmt: skip
    k = away.shape[1]
    rough = roughness * roughness
    for n in range(lo, hi):
        i, reach = asked[n], SMALLEST_REACH_M
        for a in range(k):
            if away[n, a] < np.inf:
                reach = max(reach, away[n, a])
        reach *= 1.05  # the farthest one counts a little
        m = np.int64(0)  # a literal has the kernels that it is given to compiled once more
        for a in range(k):
            j = index[n, a]
            if away[n, a] == np.inf or j == i or not counted[j]:
                continue
            z[m], w[m] = offset[j], 1.0 - (away[n, a] / reach) ** 2
            v[m] = sigma[j] ** 2 + rough + (SLOPE * away[n, a]) ** 2
            dx[m], dy[m] = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            m += 1
        z[m], w[m], v[m] = 0.0, SURFACE_MASS, SURFACE_SIGMA_M**2
        level, information = _level_from(0.0, z, w, v, m + 1, 0.0)
        variance = sigma[i] ** 2
        near = GATE_SIGMAS * math.sqrt(variance + rough + 1.0 / information)
        if abs(offset[i] - level) <= min(near, most[i]):
            supported[i] = True
            continue
        rival = level
        level, information = _level_from(offset[i], z, w, v, m, variance)
        supported[i] = False
        if information > 0.0 and abs(level) < STEP_M:
            near = GATE_SIGMAS * math.sqrt(variance + rough + 1.0 / information)
            if abs(offset[i] - level) <= min(near, most[i]):
                supported[i] = _has_majority(level, rival, m, dx, dy, z, w, v, STRIP * reach, sides)
