"""Evidence of every track for "this point moves" against "this point stands", from all of its observations.

The log evidence of a track is the difference of the marginal likelihoods of the two hypotheses of `point_hypotheses`
[Laplace]: residuals in standard deviations of an image coordinate, and what a velocity costs of its prior [Occam's
factor]. A velocity that explains nothing that standing does not explain, as one along the own motion, gains nothing.

No point is below the ground: the ray of a keypoint below the horizon ends on it, and with it the distance that a
standing point may have. So a car ahead, whose keypoints hardly move in the image, is no point at infinity. And no
vehicle is high above the ground: a keypoint high in an image shows one only if it is near.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.geometry.small_cholesky import log_determinant, solve
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.triangulation.point_hypotheses import (
    MOVES,
    STANDS,
    Sight,
    Views,
    cost_of_standing,
    fit,
    new_scratch,
)
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks
from mrasfm_engine.types import Bools, Floats, Ints

WINDOW_S = 1.5  # for which a velocity is taken to be constant: a car that brakes by 1 m/s2 is 1 m off at its end
MAX_OBSERVATIONS = 48  # of a track that are looked at, evenly spread
NEAREST_M = 0.5
SIGMA_INVERSE_M = 0.15  # of the inverse distance of standing points: most are beyond 5 m
SPEED_M_S = 8.0  # standard deviation of each axis of the velocity of what moves: traffic in towns
DRIFT_M_S = 0.5  # the same of what stands: two centimetres of error from unit to unit at 25 Hz, and slower than people
BODY_M, BODY_SHARE = 0.7, 0.6  # height of what moves over the ground, and the sigma of its distance as a share of it
FAR_M = 20.0  # distance of what moves, where its ray does not meet the ground
FARTHEST_M = 80.0  # where a car is as large as a keypoint
HIGHEST_M = 4.0  # of what moves, over the ground: lorries and buses
CAR_M = 2.0  # height of cars; what moves higher above the ground is on lorries and buses:
TALL = 3.0  # one in seven of what moves, as log odds
HORIZON = 0.02  # sine of a ray's fall, below which the ground says nothing of its distance
GRADE = 0.1  # by which the ground may fall away from the path
VERGE_M, STEEP = 4.0, 0.5  # distance from the path beyond which it may fall by so much more
FIRST_STEP_M, STEP_GROWTH, STEPS = 2.0, 1.2, 26  # along rays: to 200 m
UNSURE, UNSURE_PER_NUMBER = 6.0, 0.9  # cost of standing, and for each redundant number, below which nothing can gain


class GroundPath(NamedTuple):
    """The ground along the vehicle's path, at even stations."""

    ground_m: Floats  # (s, 3)
    up: Floats  # (s, 3)
    forward: Floats  # (s, 3)
    step_m: float
    station: Ints  # (bands,) where the vehicle is
    tolerance_m: float  # by which the ground may be lower on the path
    camera_height_m: float  # mean of the cameras over the ground


@dataclass(frozen=True, kw_only=True)
class TrackMotion:
    """Evidence and motion of tracks. All arrays are by track."""

    log_evidence: Floats  # (n,) natural logarithm of how much more likely they are if it moves; NaN if not weighed
    log_prior: Floats  # (n,) what its height says, if it moves: of things that move, few are tall
    velocity_m_s: Floats  # (n, 2) along and across the own direction of motion
    covariance: Floats  # (n, 3) of the velocity: xx, xy, yy
    distance_m: Floats  # (n,) from the reference camera, if it moves
    # (n, 4) inverse distance from there in 1 / m and its variance: if it stands, and if it moves
    inverse_distance: Floats
    misfit: Floats  # (n,) mean cost of an observation if it stands
    observations: Ints  # (n,) that were looked at
    reference: Ints  # (n,) keypoint; -1 where there are too few observations

    @staticmethod
    def empty(count: int) -> TrackMotion:
        """Nothing is known of any track but what its velocity is as a rule."""
        return TrackMotion(
            log_evidence=np.full(count, np.nan),
            log_prior=np.zeros(count),
            velocity_m_s=np.zeros((count, 2)),
            covariance=np.tile([SPEED_M_S**2, 0.0, SPEED_M_S**2], (count, 1)),
            distance_m=np.full(count, np.inf),
            inverse_distance=np.tile([0.0, np.inf, 0.0, np.inf], (count, 1)),
            misfit=np.zeros(count),
            observations=np.zeros(count, dtype=np.int64),
            reference=np.full(count, -1, dtype=np.int64),
        )


def weigh_tracks(
    into: TrackMotion,
    which: Ints,
    keypoints: Keypoints,
    tracks: Tracks,
    points_m: Floats,
    triangulated: Bools,
    views: Views,
    path: GroundPath,
    *,
    only_unsure: bool,
    threads: int = 1,
) -> None:
    """Weigh both hypotheses for the tracks `which` (m,), into the rows of `into` that these are.

    Parameters
    ----------
    points_m, triangulated
        Points (tracks, 3), and which there are: starts of the fits.
    only_unsure
        Leave those out that a point that stands explains so well that nothing is to be gained.
    """
    k = keypoints
    in_ranges(
        threads,
        len(which),
        lambda lo, hi: _weigh(
            which[lo:hi], tracks.first, tracks.keypoints, k.band, k.camera, k.xy_px, k.rays, points_m, triangulated,
            views, path, only_unsure, into.log_evidence, into.log_prior, into.velocity_m_s, into.covariance,
            into.distance_m, into.inverse_distance, into.misfit, into.observations, into.reference,
        ),
    )  # fmt: skip


@uncounted()
def free_distance_m(c: Any, d: Any, station: int, path: Any, farthest_m: float) -> float:
    """Distance along a ray from c at which it is below the ground; infinite where it never is for certain, or only
    beyond the farthest distance that is asked for."""
    s, k, last = FIRST_STEP_M, station, len(path.ground_m) - 1
    for _ in range(STEPS):
        if s >= farthest_m:
            break
        x0, x1, x2 = c[0] + s * d[0], c[1] + s * d[1], c[2] + s * d[2]
        for _ in range(3):  # to the nearest station, along the path from that of the step before
            y0, y1, y2 = x0 - path.ground_m[k, 0], x1 - path.ground_m[k, 1], x2 - path.ground_m[k, 2]
            along = path.forward[k, 0] * y0 + path.forward[k, 1] * y1 + path.forward[k, 2] * y2
            nearer = min(max(k + round(along / path.step_m), 0), last)
            if nearer == k:
                break
            k = nearer
        y0, y1, y2 = x0 - path.ground_m[k, 0], x1 - path.ground_m[k, 1], x2 - path.ground_m[k, 2]
        height = path.up[k, 0] * y0 + path.up[k, 1] * y1 + path.up[k, 2] * y2
        away = math.sqrt(max(y0 * y0 + y1 * y1 + y2 * y2 - height * height, 0.0))
        if height < -(path.tolerance_m + GRADE * away + STEEP * max(away - VERGE_M, 0.0)):
            return s
        s *= STEP_GROWTH
    return np.inf


@uncounted()
def _begin_of_window(members: Any, band: Any, views: Any) -> tuple[float, int]:
    """Begin of the time in which most of a track's observations are, and about how many these are.

    Keypoints are in the order of their units, so that a window that moves along them is enough. Cameras of one unit may
    be in any order, so that some more or fewer may be in that time.
    """
    most, begin_s, seen, first = 0, 0.0, 0, 0
    earliest_s, latest_s = np.inf, -np.inf
    for k in members:
        if views.is_posed[band[k]]:
            earliest_s, latest_s = min(earliest_s, views.time_s[band[k]]), max(latest_s, views.time_s[band[k]])
            seen += 1
    if not latest_s - earliest_s > WINDOW_S:  # as most are
        return earliest_s, seen
    seen = 0
    for i in range(len(members)):
        if not views.is_posed[band[members[i]]]:
            continue
        now = views.time_s[band[members[i]]]
        seen += 1
        while now - views.time_s[band[members[first]]] > WINDOW_S:
            seen -= views.is_posed[band[members[first]]]
            first += 1
        if seen > most:
            most, begin_s = seen, now
            for j in range(first, i):
                if views.is_posed[band[members[j]]]:
                    begin_s = min(begin_s, views.time_s[band[members[j]]])
    return begin_s, most


@uncounted()
def _look(
    members: Any, band: Any, camera: Any, xy: Any, rays: Any, views: Any, path: Any, sight: Any, c: Any
) -> tuple[int, int]:
    """Take a track's observations into `sight` and the reference camera's centre into c; how many, and the reference's
    place among them."""
    begin_s, about = _begin_of_window(members, band, views)
    if about < 2:
        return 0, 0
    inside = 0
    for k in members:
        inside += views.is_posed[band[k]] and 0.0 <= views.time_s[band[k]] - begin_s <= WINDOW_S
    if inside < 2:
        return 0, 0
    stride, at, n = (inside + MAX_OBSERVATIONS - 1) // MAX_OBSERVATIONS, 0, 0
    earliest, latest = np.inf, -np.inf
    for i in range(len(members)):
        k = members[i]
        later = views.time_s[band[k]] - begin_s
        if not views.is_posed[band[k]] or not 0.0 <= later <= WINDOW_S:
            continue
        at += 1
        if (at - 1) % stride:
            continue
        sight.keypoint[n], sight.band[n], sight.camera[n] = k, band[k], camera[k]
        sight.xy_px[n, 0], sight.xy_px[n, 1] = xy[k, 0], xy[k, 1]
        r, t = views.rotation[band[k]], views.translation_m[band[k]]
        for j in range(3):
            sight.offset_m[n, j] = -(r[0, j] * t[0] + r[1, j] * t[1] + r[2, j] * t[2])
        sight.time_s[n] = later
        earliest, latest = min(earliest, later), max(latest, later)
        n += 1
    middle, ref = 0.5 * (earliest + latest), 0
    for m in range(n):
        if abs(sight.time_s[m] - middle) < abs(sight.time_s[ref] - middle):
            ref = m
    for j in range(3):
        c[j] = sight.offset_m[ref, j]
    reference_s = sight.time_s[ref]
    for m in range(n):
        sight.time_s[m] -= reference_s
        for j in range(3):
            sight.offset_m[m, j] -= c[j]
    k, r = sight.keypoint[ref], views.rotation[sight.band[ref]]
    d, e = sight.direction, sight.tangents
    for j in range(3):
        d[j] = r[0, j] * rays[k, 0] + r[1, j] * rays[k, 1] + r[2, j] * rays[k, 2]
    axis = 0 if abs(d[0]) < 0.6 else 1
    norm = math.sqrt(1.0 - d[axis] * d[axis])
    for j in range(3):
        e[0, j] = ((1.0 if j == axis else 0.0) - d[axis] * d[j]) / norm
    _cross(d, e[0], e[1])
    station = path.station[sight.band[ref]]
    for j in range(3):
        sight.axes[0, j] = path.forward[station, j]
    _cross(path.up[station], path.forward[station], sight.axes[1])
    return n, ref


@uncounted()
def _cross(a: Any, b: Any, out: Any) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@uncounted()
def _variance_of_inverse_distance(scratch: Any) -> float:
    scratch.gradient[:] = 0.0
    scratch.gradient[2] = 1.0
    solve(scratch.factor, scratch.gradient, MOVES, scratch.step)
    return float(scratch.step[2])


@uncounted()
def _velocity_covariance(factor: Any, p: Any, gradient: Any, column: Any, out: Any) -> None:
    """Covariance xx, xy, yy of the velocity nu / rho at p, that of rho included."""
    rho = p[2]
    for axis in range(2):
        gradient[:] = 0.0
        gradient[3 + axis] = 1.0 / rho
        gradient[2] = -p[3 + axis] / (rho * rho)
        solve(factor, gradient, MOVES, column)
        across = column[4] / rho - column[2] * p[4] / (rho * rho)
        if axis == 0:
            out[0], out[1] = column[3] / rho - column[2] * p[3] / (rho * rho), across
        else:
            out[2] = across


@njit(cache=True, nogil=True)
def _weigh(
    which: Any, first: Any, members: Any, band: Any, camera: Any, xy: Any, rays: Any, points: Any, triangulated: Any,
    views: Any, path: Any, only_unsure: bool, evidence: Any, prior: Any, velocity: Any, covariance: Any, distance: Any,
    inverse_distance: Any, misfit: Any, observations: Any, reference: Any,
) -> None:  # fmt: skip
    most_seen = MAX_OBSERVATIONS
    sight = Sight(
        np.empty(most_seen, np.int64), np.empty(most_seen, np.int64), np.empty(most_seen, np.int64),
        np.empty((most_seen, 2)), np.empty((most_seen, 3)), np.empty(most_seen), np.empty(3), np.empty((2, 3)),
        np.empty((2, 3)),
    )  # fmt: skip
    _weigh_each(
        which, first, members, band, camera, xy, rays, points, triangulated, views, path, only_unsure, evidence, prior,
        velocity, covariance, distance, inverse_distance, misfit, observations, reference,
        sight, new_scratch(), np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5), np.empty(3),
    )  # fmt: skip


@uncounted()
def _weigh_each(
    which: Any, first: Any, members: Any, band: Any, camera: Any, xy: Any, rays: Any, points: Any, triangulated: Any,
    views: Any, path: Any, only_unsure: bool, evidence: Any, prior: Any, velocity: Any, covariance: Any, distance: Any,
    inverse_distance: Any, misfit: Any, observations: Any, reference: Any,
    sight: Any, scratch: Any, p: Any, start: Any, mean: Any, weight: Any, c: Any,
) -> None:  # fmt: skip
    nearest = 1.0 / NEAREST_M
    for t in which:
        evidence[t], reference[t] = np.nan, -1
        n, ref = _look(members[first[t] : first[t + 1]], band, camera, xy, rays, views, path, sight, c)
        if n < 2:
            continue
        d, e = sight.direction, sight.tangents
        station = path.station[sight.band[ref]]
        up = path.up[station]
        fall = -(up[0] * d[0] + up[1] * d[1] + up[2] * d[2])
        mean[2], weight[2] = 0.0, 1.0 / SIGMA_INVERSE_M**2
        too_little = UNSURE + UNSURE_PER_NUMBER * (2 * n - STANDS)
        p[:] = 0.0
        is_near = False
        if triangulated[t]:
            x0, x1, x2 = points[t, 0] - c[0], points[t, 1] - c[1], points[t, 2] - c[2]
            depth = d[0] * x0 + d[1] * x1 + d[2] * x2
            if depth > NEAREST_M:
                is_near = True
                p[0] = (e[0, 0] * x0 + e[0, 1] * x1 + e[0, 2] * x2) / depth
                p[1] = (e[1, 0] * x0 + e[1, 1] * x1 + e[1, 2] * x2) / depth
                p[2] = 1.0 / depth
                if only_unsure:
                    # Where its point explains it so well, the best one need not be found.
                    at_point = cost_of_standing(n, x0, x1, x2, sight, views, scratch)
                    if at_point + weight[2] * p[2] ** 2 < too_little and (
                        not fall > 0.0 or free_distance_m(c, d, station, path, depth) == np.inf
                    ):
                        continue
        least = 1.0 / free_distance_m(c, d, station, path, np.inf) if fall > 0.0 else 0.0
        if not is_near:
            p[2] = max(1.0 / FAR_M, least)
        enough = too_little if only_unsure else 0.0
        stands, data, is_sound = fit(n, STANDS, is_near, p, mean, weight, least, nearest, enough, sight, views, scratch)
        if stands < enough:
            continue
        reference[t], observations[t], misfit[t] = sight.keypoint[ref], n, data / n
        distance[t] = 1.0 / max(p[2], 1.0 / FARTHEST_M)
        if not is_sound:
            continue
        # Errors of poses and of the calibration look like a small velocity: what stands may have one as well.
        p[3] = p[4] = mean[3] = mean[4] = 0.0
        weight[3] = weight[4] = 1.0 / (max(p[2], 1.0 / FARTHEST_M) * DRIFT_M_S) ** 2
        stands, _, is_sound = fit(
            n, MOVES, np.bool_(True), p, mean, weight, least, nearest, 0.0, sight, views, scratch
        )  # fmt: skip
        if not is_sound:
            continue
        log_priors = math.log(weight[2]) + math.log(weight[3]) + math.log(weight[4])
        inverse_distance[t, 0], inverse_distance[t, 1] = p[2], _variance_of_inverse_distance(scratch)
        log_stands = -0.5 * (stands + log_determinant(scratch.factor, MOVES) - log_priors)
        lowest = max(least, 1.0 / FARTHEST_M, -fall / max(HIGHEST_M - path.camera_height_m, 0.5))
        expected = fall / max(path.camera_height_m - BODY_M, 0.3) if fall > HORIZON else 1.0 / FAR_M
        expected = max(expected, lowest)
        mean[2], weight[2] = expected, 1.0 / (BODY_SHARE * expected) ** 2
        weight[3] = weight[4] = 1.0 / (expected * SPEED_M_S) ** 2
        log_priors = math.log(weight[2]) + math.log(weight[3]) + math.log(weight[4])
        for i in range(len(p)):
            start[i] = p[i]
        moves = np.inf
        for from_standing in (False, True):
            for i in range(len(p)):
                p[i] = start[i] if from_standing else 0.0
            if not from_standing:
                p[2] = expected
            total, _, is_sound = fit(
                n, MOVES, from_standing, p, mean, weight, lowest, nearest, 0.0, sight, views, scratch
            )  # fmt: skip
            if is_sound and total < moves:
                moves = total
                evidence[t] = -0.5 * (total + log_determinant(scratch.factor, MOVES) - log_priors) - log_stands
                prior[t] = -TALL if path.camera_height_m - fall / p[2] > CAR_M else 0.0
                velocity[t, 0], velocity[t, 1] = p[3] / p[2], p[4] / p[2]
                distance[t] = 1.0 / p[2]
                inverse_distance[t, 2], inverse_distance[t, 3] = p[2], _variance_of_inverse_distance(scratch)
                _velocity_covariance(scratch.factor, p, scratch.gradient, scratch.step, covariance[t])
