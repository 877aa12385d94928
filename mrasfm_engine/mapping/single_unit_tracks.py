"""Tracks that one unit alone observes, on things that move.

Two cameras that see a thing at one instant give its place, whatever its motion: no residual tells that it moves. What
tells is the next unit. Points of what stands go on being observed, most of them; on what moves none do, as matches
between units contradict the poses. The share of points around a track that other units observe as well is compared
with that share around all points that two cameras of one unit observe [Beta-binomial of both hypotheses]. Where units
lie so far apart that few points go on, the share says nothing, and no track is taken to move.

Points are not judged that neither the unit before nor that after has in view, and not those on the ground: the road in
front of a vehicle looks so different a metre later that few of its points go on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaln, expit, logit

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project_points
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.jit import njit
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.parallel import even_bounds, in_parts
from mrasfm_engine.triangulation.track_motion import GroundPath
from mrasfm_engine.types import Bools, Floats, Ints

NEIGHBOURS = 12
REACH_M = 1.2  # to neighbours: half of a car
MOVING = (1.0, 4.0)  # Beta distribution of the share on things that move: some wrong points look as if they went on
SHARE_THAT_MOVES = (2.0, 20.0)  # Beta distribution, as far as the drive does not tell: most likely one in twenty
ROUNDS = 30  # of expectation and maximisation
CONVERGED = 1e-3  # of the share of points that move, relative
LEAST_ROWS = 30  # whose shares tell what stands looks like
LEAST_CORRELATION = 0.01  # of points in one neighbourhood


@dataclass(frozen=True, kw_only=True)
class _Shares:
    """Neighbourhoods of points that can be judged, in units of which two cameras observe them."""

    track: Ints  # (n,)
    neighbours: Ints  # (n,)
    going_on: Ints  # (n,) of the neighbours, those that other units observe as well


def log_odds_in_single_units(mapper: Mapper, moves: Bools, path: GroundPath) -> Floats:
    """Log odds (tracks,) to move by what is around them, of tracks that one unit alone observes; NaN of all others.

    `moves` (tracks,) are known to move, and are no neighbours.
    """
    result = np.full(len(mapper.tracks), np.nan)
    shares, single = _neighbourhoods(mapper, moves, path)
    rows = np.flatnonzero(shares.neighbours > 0)
    # The track itself is one more of its neighbourhood.
    alone = single[shares.track[rows]]
    count, going_on = shares.neighbours[rows] + 1, shares.going_on[rows] + ~alone
    if len(rows) >= LEAST_ROWS:
        result[shares.track[rows[alone]]] = log_odds_of_moving(count, going_on)[alone]
    return result


def log_odds_of_moving(count: Ints, going_on: Ints) -> Floats:
    """Log odds (n,) of neighbourhoods to move, of whose points (n,) so many go on.

    How many move, and how many points go on of those that stand, is told by all of them together [expectation
    maximisation]: a street with traffic beside the vehicle has many that move, most drives have none.
    """
    mode, others = (number - 1.0 for number in SHARE_THAT_MOVES)
    share = mode / (mode + others)
    # Thousands of neighbourhoods are of a hundred kinds.
    kinds, kind, number = np.unique(count * (NEIGHBOURS + 2) + going_on, return_inverse=True, return_counts=True)
    count, going_on = np.divmod(kinds, NEIGHBOURS + 2)
    gain = belief = np.zeros(len(number))
    for _ in range(ROUNDS):
        stands = _distribution(count, going_on, number * (1.0 - belief))
        gain = _log_likelihood(going_on, count, *MOVING) - _log_likelihood(going_on, count, *stands)
        belief = expit(gain + logit(share))
        before, share = share, float((mode + number @ belief) / (mode + others + len(kind)))
        if abs(share - before) < CONVERGED * before:
            break
    result: Floats = (gain + logit(share))[kind]
    return result


def _off_the_ground(points_m: Floats, path: GroundPath, *, threads: int = 1) -> Bools:
    """Return whether points (n, 3) are higher than the path's ground at the nearest station.

    Far from the path the ground may be higher, too. What is meant is the road before the vehicle, which is near.
    """
    station = nearest(path.ground_m, points_m, threads=threads)[1][:, 0]
    height_m = ((points_m - path.ground_m[station]) * path.up[station]).sum(1)
    result: Bools = height_m > path.tolerance_m
    return result


def _seen_by_next(mapper: Mapper, points_m: Floats, unit: Ints) -> Bools:
    """Return whether the registered unit before or that after has points (n, 3) of units (n,) in view."""
    registered, state = np.flatnonzero(mapper.registered), mapper.state
    rig_from_world = se3.inverse(state.world_from_rig[registered])
    place, result = np.searchsorted(registered, unit), np.zeros(len(unit), dtype=np.bool_)
    for step in (-1, 1):
        there = np.flatnonzero((place + step >= 0) & (place + step < len(registered)) & ~result)
        in_rig_m = se3.apply(rig_from_world[place[there] + step], points_m[there, None])[:, 0]
        for camera, rig_from_cam in enumerate(state.rig_from_cam):
            pixels = project_points(
                int(mapper.camera_kind[camera]),
                state.camera_params[camera],
                se3.apply(se3.inverse(rig_from_cam), in_rig_m),
            )
            result[there] |= ((pixels >= 0.0) & (pixels < mapper.image_size_px[camera])).all(1)
    return result


def _neighbourhoods(mapper: Mapper, moves: Bools, path: GroundPath) -> tuple[_Shares, Bools]:
    """Neighbourhoods, and which tracks (tracks,) one unit alone observes."""
    counted = mapper.triangulated & ~moves
    unit, track, images = _points_of_units(mapper.is_inlier, mapper.tracks.of_keypoint, mapper.keypoints.unit, counted)
    single = np.bincount(track, minlength=len(counted)) == 1
    points_m, goes_on = mapper.state.points_m[track], ~single[track]
    asked = np.flatnonzero(images > 1)
    asked = asked[_off_the_ground(points_m[asked], path, threads=mapper.config.threads)]
    asked = asked[_seen_by_next(mapper, points_m[asked], unit[asked])]
    units = np.arange(len(mapper.registered) + 1)
    begins, first = np.searchsorted(unit, units), np.searchsorted(unit[asked], units)
    neighbours, going_on = np.zeros(len(asked), dtype=np.int64), np.zeros(len(asked), dtype=np.int64)
    axis, order = _sorted_in_units(points_m, begins, first)
    in_parts(
        np.searchsorted(first, even_bounds(len(asked), mapper.config.threads)),
        lambda lo, hi, part: _count_in_units(
            points_m, goes_on, axis, order, begins, asked, first, lo, hi, neighbours, going_on
        ),
    )
    return _Shares(track=track[asked], neighbours=neighbours, going_on=going_on), single


@njit(cache=True, nogil=True)
def _points_of_units(is_inlier: Any, of_keypoint: Any, unit_of_keypoint: Any, counted: Any) -> Any:
    """Units (n,), ascending, and tracks (n,) of points that these observe, and in how many images (n,) each.

    Keypoints are in the order of their units, so that one pass is enough.
    """
    size = len(is_inlier)
    units, tracks, images = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    entry, count = np.full(len(counted), -1, np.int64), 0
    for k in range(size):
        t = of_keypoint[k]
        if not is_inlier[k] or not counted[t]:
            continue
        if entry[t] < 0 or units[entry[t]] != unit_of_keypoint[k]:
            entry[t] = count
            units[count], tracks[count], images[count] = unit_of_keypoint[k], t, 0
            count += 1
        images[entry[t]] += 1
    return units[:count].copy(), tracks[:count].copy(), images[:count].copy()


def _sorted_in_units(points_m: Floats, begins: Ints, first: Ints) -> tuple[Ints, Ints]:
    """The axis (units,) along which the points of every unit lie farthest apart, and their order (m,) along it within
    their unit, of units of which any are asked for.
    """
    axis, order = np.zeros(len(begins) - 1, dtype=np.int64), np.zeros(len(points_m), dtype=np.int64)
    for u in np.flatnonzero(np.diff(first)):
        own = points_m[begins[u] : begins[u + 1]]
        axis[u] = np.argmax(own.max(axis=0) - own.min(axis=0))
        order[begins[u] : begins[u + 1]] = np.argsort(own[:, axis[u]])
    return axis, order


@njit(cache=True, nogil=True)
def _count_in_units(
    points: Any, goes_on: Any, axes: Any, orders: Any, begins: Any, asked: Any, first: Any, lo: int, hi: int,
    neighbours: Any, going_on: Any,
) -> None:  # fmt: skip
    """Count neighbours and those of them that go on, around the points `asked` (n,) of units lo..hi.

    Points (m, 3) from begins[u], and those asked from first[u], are of unit u.
    """
    for u in range(lo, hi):
        begin, end = begins[u], begins[u + 1]
        if first[u] == first[u + 1]:
            continue
        own, axis, order = points[begin:end], axes[u], orders[begin:end]
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        rows = slice(first[u], first[u + 1])
        _count_around(
            own[order], axis, goes_on[begin:end][order], place[asked[rows] - begin], neighbours[rows], going_on[rows]
        )


@njit(cache=True, nogil=True)
def _count_around(points: Any, axis: int, goes_on: Any, asked: Any, neighbours: Any, going_on: Any) -> None:
    """Count around points (n,) the nearest of points (m, 3), which are in the order of a coordinate."""
    distance, goes = np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.bool_)
    for n in range(len(asked)):
        own, count, limit = asked[n], 0, REACH_M * REACH_M
        for step in (-1, 1):
            m = own + step
            while 0 <= m < len(points) and (points[m, axis] - points[own, axis]) ** 2 < limit:
                d2 = 0.0
                for j in range(3):
                    d2 += (points[m, j] - points[own, j]) ** 2
                if d2 < limit:
                    count = min(count + 1, NEIGHBOURS)
                    at = count - 1
                    while at > 0 and distance[at - 1] > d2:
                        distance[at], goes[at] = distance[at - 1], goes[at - 1]
                        at -= 1
                    distance[at], goes[at] = d2, goes_on[m]
                    limit = distance[-1] if count == NEIGHBOURS else limit
                m += step
        neighbours[n] = count
        for i in range(count):
            going_on[n] += goes[i]


def _distribution(count: Ints, going_on: Ints, weight: Floats) -> tuple[float, float]:
    """The Beta distribution of the share of points that go on, by the moments of neighbourhoods (n,) of two and more.

    It has no peaks at both ends: those would be two kinds of neighbourhoods.
    """
    share = going_on / count
    mean = float(np.clip(np.average(share, weights=weight * count), 0.01, 0.99))
    # The variance of a share of n is mean (1 - mean) (1 + (n - 1) correlation) / n.
    binomial = mean * (1.0 - mean)
    excess = float(np.average((share - mean) ** 2 - binomial / count, weights=weight))
    peak = max(mean, 1.0 - mean)
    correlation = excess / (binomial * float(np.average(1.0 - 1.0 / count, weights=weight)))
    correlation = min(max(correlation, LEAST_CORRELATION), peak / (1.0 + peak))
    both = (1.0 - correlation) / correlation
    return mean * both, (1.0 - mean) * both


def _log_likelihood(successes: Ints, trials: Ints, a: float, b: float) -> Floats:
    """Logarithm of a Beta-binomial probability, less that of the binomial coefficient."""
    result: Floats = betaln(a + successes, b + trials - successes) - betaln(a, b)
    return result
