"""Groups of tracks that move together: neighbours in an image strengthen one another.

A rigid object that moves has many keypoints side by side, and one velocity explains them all. Whether a track moves is
decided for all tracks together [mean field of an Ising model]: by its own evidence, or by that for the velocity that
its moving neighbours share, and by what its neighbours are. Given that velocity, a track pays no Occam factor for one
of its own [Savage-Dickey], unless errors of poses explain that velocity as well. So velocities along the own motion
count, too, of which a track alone reveals nothing. Moving neighbours say nothing of a track with another velocity. A
track among them may also be a mixture of wrong matches, as objects that move and look alike make them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.triangulation.track_motion import DRIFT_M_S, SPEED_M_S, TrackMotion
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks
from mrasfm_engine.types import Floats, Ints

NEIGHBOURS = 12
REACH_M = 1.2  # to neighbours, at a track's distance: half of a car
LENGTH_M = 5.0  # of cars, as sigma of how far two of their tracks are one behind the other
MOST_EVIDENCE = 8.0  # that a track has for itself: more is a matter of wrong matches, not of motion
PRIOR = 0.5  # log odds for standing, beside a track that may move
BOND = 1.0  # log odds that a neighbour adds that moves,
BOND_TO_STANDING = 0.5  # and takes that stands: a thing's outline has both on its sides
SLACK_M_S = 0.5  # by which velocities of one thing differ
MIXED = 8.0  # cost of an observation, if matches are mixed: as a residual of five standard deviations has it
OTHER_VELOCITY = 11.8  # squared distance of two velocities, as improbable as three standard deviations of one number
ROUNDS = 10
ALONE, SHARED, MIXTURE, BESIDE = 1, 2, 3, 4  # why a track is taken to move


@dataclass(frozen=True, kw_only=True)
class MotionGroups:
    """Tracks that move."""

    tracks: Ints  # (n,) ascending
    # (n,) ALONE: its own evidence; SHARED: its neighbours' velocity; MIXTURE: its matches contradict; BESIDE: none of
    # these, but most of its neighbours move.
    reason: Ints


class Neighbours:
    """The tracks nearest to tracks in the image of their reference keypoints, each looked for once.

    Parameters
    ----------
    motion
        Of all tracks; those asked for have been weighed.
    focal_px
        Of every camera (c,).
    """

    def __init__(
        self, motion: TrackMotion, keypoints: Keypoints, tracks: Tracks, focal_px: Floats, *, threads: int = 1
    ) -> None:
        self._motion, self._keypoints, self._tracks = motion, keypoints, tracks
        self._focal_px, self._threads = focal_px, threads
        self._place = np.full(len(tracks), -1, dtype=np.int64)  # of a track among the rows
        self._rows = np.zeros((0, NEIGHBOURS), dtype=np.int64)

    def beside(self, which: Ints) -> Ints:
        """Neighbours (n, NEIGHBOURS) of tracks (n,), each at most once among them; -1 for none."""
        new = which[self._place[which] < 0]
        self._place[new] = len(self._rows) + np.arange(len(new))
        self._rows = np.concatenate([self._rows, self._found(new)])
        return self._rows[self._place[which]]

    def _found(self, which: Ints) -> Ints:
        result = np.full((len(which), NEIGHBOURS), -1, dtype=np.int64)
        k = self._keypoints
        reference = self._motion.reference[which]
        reach_px = REACH_M * self._focal_px[k.camera[reference]] / self._motion.distance_m[which]
        in_ranges(
            self._threads,
            len(which),
            lambda lo, hi: _nearest(
                reference[lo:hi], reach_px[lo:hi], k.first, k.image, k.xy_px, self._tracks.of_keypoint, result[lo:hi]
            ),
        )
        return result


def group(
    motion: TrackMotion, suspects: Ints, known: Floats, neighbours: Neighbours, *, weigh: Callable[[Ints], None]
) -> MotionGroups:
    """Decide which tracks move.

    Parameters
    ----------
    motion
        Of all tracks; those without evidence, also where `weigh` gives none, stand unless something else is known.
    suspects
        Tracks (m,) that may move. They and their neighbours are judged, all others stand.
    known
        Log odds (tracks,) to move by something else than a track's own observations, that is by what is around its
        place; NaN where there are none.
    neighbours
        Of the same tracks.
    weigh
        Completes `motion` for tracks.
    """
    weigh(suspects[np.isnan(motion.log_evidence[suspects])])
    beside = neighbours.beside(suspects)
    is_other = np.zeros(len(known), dtype=np.bool_)
    is_other[beside[beside >= 0]] = True
    is_other[suspects] = False
    others = np.flatnonzero(is_other)
    weigh(others[np.isnan(motion.log_evidence[others])])
    nodes = np.concatenate([suspects, others])
    edges = np.concatenate([beside, neighbours.beside(others)])
    place = np.full(len(known), -1, dtype=np.int64)
    place[nodes] = np.arange(len(nodes))
    # A neighbour that is no node stands: it is beside no suspect.
    linked = np.where(edges >= 0, place[edges], -2)
    is_known, is_weighed = np.isfinite(known[nodes]), np.isfinite(motion.log_evidence[nodes])
    evidence = np.where(is_known, 0.0, -MOST_EVIDENCE)
    evidence[is_weighed] = motion.log_evidence[nodes[is_weighed]]
    evidence[is_known] += known[nodes[is_known]] + PRIOR  # which log odds have already
    mixed = np.where(is_weighed, 0.5 * motion.observations[nodes] * (motion.misfit[nodes] - MIXED), -np.inf)
    score, reason = np.empty(len(nodes)), np.empty(len(nodes), dtype=np.int64)
    _mean_field(
        linked, evidence, motion.log_prior[nodes], motion.velocity_m_s[nodes], motion.covariance[nodes],
        motion.inverse_distance[nodes], is_known, mixed, score, reason,
    )  # fmt: skip
    order = np.argsort(nodes)
    # What was not weighed, with too few observations, is not known to move.
    order = order[(score[order] > 0.0) & (is_known | is_weighed)[order]]
    return MotionGroups(tracks=nodes[order], reason=reason[order])


@njit(cache=True, nogil=True)
def _nearest(reference: Any, reach: Any, first: Any, image: Any, xy: Any, of_keypoint: Any, out: Any) -> None:
    distance = np.empty(out.shape[1])
    for n in range(len(reference)):
        k, count = reference[n], 0
        if k < 0:
            continue
        limit = reach[n] * reach[n]
        for other in range(first[image[k]], first[image[k] + 1]):
            d2 = (xy[other, 0] - xy[k, 0]) ** 2 + (xy[other, 1] - xy[k, 1]) ** 2
            if d2 >= limit or of_keypoint[other] < 0 or other == k:
                continue
            at = count
            while at > 0 and distance[at - 1] > d2:
                if at < len(distance):
                    distance[at], out[n, at] = distance[at - 1], out[n, at - 1]
                at -= 1
            if at < len(distance):
                distance[at], out[n, at] = d2, of_keypoint[other]
                count = min(count + 1, len(distance))
            if count == len(distance):
                limit = distance[count - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _distance2(d0: float, d1: float, xx: float, xy: float, yy: float) -> Any:
    """Squared distance of a difference in standard deviations, by its covariance xx, xy, yy, and the determinant."""
    det = xx * yy - xy * xy
    return (yy * d0 * d0 - 2.0 * xy * d0 * d1 + xx * d1 * d1) / det, det


@njit(cache=True, nogil=True, error_model="numpy")
def _moving_against_standing(v0: float, v1: float, xx: float, xy: float, yy: float) -> Any:
    """Logarithm of how much likelier a velocity of covariance xx, xy, yy is on what moves than on what stands."""
    moving, moving_det = _distance2(v0, v1, xx + SPEED_M_S**2, xy, yy + SPEED_M_S**2)
    standing, standing_det = _distance2(v0, v1, xx + DRIFT_M_S**2, xy, yy + DRIFT_M_S**2)
    return 0.5 * (standing - moving - math.log(moving_det / standing_det))


@njit(cache=True, nogil=True, error_model="numpy")
def _without_prior(velocity: Any, covariance: Any, information: Any, pulled: Any) -> None:
    """Information (3,) xx, xy, yy that observations have of the velocity of a thing, and that times the velocity (2,).

    Velocities and covariances have the prior of a track's own velocity: neighbours must not count it again each.
    Velocities of one thing differ by SLACK_M_S.
    """
    slack2, prior = SLACK_M_S**2, 1.0 / SPEED_M_S**2
    xx, xy, yy = covariance
    det = xx * yy - xy * xy
    information[:], pulled[:] = 0.0, 0.0
    if not det > 0.0:
        return
    xx, xy, yy = yy / det, -xy / det, xx / det
    p0, p1 = xx * velocity[0] + xy * velocity[1], xy * velocity[0] + yy * velocity[1]
    xx, yy = max(xx - prior, 0.0), max(yy - prior, 0.0)
    if xx * yy < xy * xy:  # by rounding
        xy = math.copysign(math.sqrt(xx * yy), xy)
    # i (1 + s i)^-1 and (1 + s i)^-1 p
    a, b, d = 1.0 + slack2 * xx, slack2 * xy, 1.0 + slack2 * yy
    det = a * d - b * b
    information[0] = (xx * d - xy * b) / det
    information[1] = (xy * a - xx * b) / det
    information[2] = (yy * a - xy * b) / det
    pulled[0], pulled[1] = (d * p0 - b * p1) / det, (a * p1 - b * p0) / det


@njit(cache=True, nogil=True, error_model="numpy")
def _are_beside(moving: Any, standing: Any) -> float:
    """Likelihood that one track, if it moves, and another, if it stands, are on one thing: 1 at equal distances."""
    length = LENGTH_M * moving[2] * moving[2]
    variance = moving[3] + standing[1] + length * length
    return math.exp(-0.5 * (moving[2] - standing[0]) ** 2 / variance)


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_field(
    linked: Any, evidence: Any, prior: Any, velocity: Any, covariance: Any, inverse_distance: Any, is_known: Any,
    mixed: Any, score: Any, reason: Any,
) -> None:  # fmt: skip
    """Log odds and reasons of all nodes; `linked` (n, k) are their neighbours: -1 for one that stands, -2 for none."""
    count, size = linked.shape
    belief, following = np.empty(count), np.empty(count)
    information, pulled = np.empty((count, 3)), np.empty((count, 2))
    slack2, speed2 = SLACK_M_S**2, SPEED_M_S**2
    for n in range(count):
        own = min(evidence[n], MOST_EVIDENCE)
        belief[n] = math.tanh(0.5 * (own + prior[n] - PRIOR))
        _without_prior(velocity[n], covariance[n], information[n], pulled[n])
    for _ in range(ROUNDS):
        for n in range(count):
            i0, i1, i2 = 1.0 / speed2, 0.0, 1.0 / speed2
            v0 = v1 = moving = for_moving = for_standing = 0.0
            for j in range(size):
                m = linked[n, j]
                if m == -2:
                    continue
                b = belief[m] if m >= 0 else -1.0
                if b <= 0.0:
                    # What is known of a track is of its place, and what stands far behind that is seen around any car.
                    beside = _are_beside(inverse_distance[n], inverse_distance[m]) if is_known[n] and m >= 0 else 1.0
                    for_standing -= BOND_TO_STANDING * b * beside
                    continue
                for_moving += BOND * b
                moving += b
                i0 += b * information[m, 0]
                i1 += b * information[m, 1]
                i2 += b * information[m, 2]
                v0 += b * pulled[m, 0]
                v1 += b * pulled[m, 1]
            best, why = evidence[n], ALONE
            if moving > 0.5:
                det = i0 * i2 - i1 * i1
                common0, common1 = (i2 * v0 - i1 * v1) / det, (i0 * v1 - i1 * v0) / det
                cxx, cxy, cyy = i2 / det, -i1 / det, i0 / det
                xx, xy, yy = covariance[n, 0] + slack2 + cxx, covariance[n, 1] + cxy, covariance[n, 2] + slack2 + cyy
                away, det = _distance2(common0 - velocity[n, 0], common1 - velocity[n, 1], xx, xy, yy)
                speed = (common0 * common0 + common1 * common1) / speed2
                shared = evidence[n] + 0.5 * (speed - away - math.log(det / (speed2 * speed2)))
                shared += min(_moving_against_standing(common0, common1, cxx, cxy, cyy), 0.0)
                if away <= OTHER_VELOCITY and shared > best:
                    best, why = shared, SHARED
                if mixed[n] > best:  # and its velocity means nothing
                    best, why = mixed[n], MIXTURE
                elif away > OTHER_VELOCITY:
                    for_moving = 0.0
            # Evidence against is not bounded: no neighbours outweigh what is sure to stand.
            score[n] = min(best, MOST_EVIDENCE) + prior[n] - PRIOR + for_moving - for_standing
            reason[n] = why if best + prior[n] > PRIOR else BESIDE
            following[n] = 0.5 * belief[n] + 0.5 * math.tanh(0.5 * score[n])
        belief[:] = following
