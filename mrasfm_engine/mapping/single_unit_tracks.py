"""Tracks that one unit alone observes, on things that move.

Two cameras that see a thing at one instant give its place, whatever its motion: no residual tells that it moves. What
tells is the next unit. Points of what stands go on being observed, most of them; on what moves none do, as matches
between units contradict the poses. The share of points around a track that other units observe as well is compared
with that share around all points that two cameras of one unit observe [Beta-binomial of both hypotheses]. Where units
lie so far apart that few points go on, the share says nothing, and no track is taken to move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Floats, Ints

NEIGHBOURS = 12
REACH_M = 1.2  # to neighbours: half of a car
MOVING = (1.0, 4.0)  # Beta distribution of the share on things that move: some wrong points look as if they went on
PRIOR = np.log(0.05 / 0.95)  # log odds: of the tracks that one unit alone observes, one in twenty
LEAST_ROWS = 30  # whose shares tell what stands looks like
CORRELATION = (0.01, 0.9)  # of points in one neighbourhood


@dataclass(frozen=True, kw_only=True)
class _Shares:
    """Neighbourhoods of points in units of which two cameras observe them."""

    track: Ints  # (n,)
    neighbours: Ints  # (n,)
    going_on: Ints  # (n,) of the neighbours, those that other units observe as well


def moving_in_single_units(mapper: Mapper, moves: Bools) -> Ints:
    """Tracks with points that one unit alone observes, and that move by what their neighbourhood shows.

    `moves` (tracks,) are known to move, and are no neighbours.
    """
    shares, single = _neighbourhoods(mapper, moves)
    if len(shares.track) < LEAST_ROWS:
        return np.zeros(0, dtype=np.int64)
    stands = _distribution(shares)
    asked = single[shares.track] & (shares.neighbours > 0)
    # The track itself is one more of the neighbourhood that does not go on.
    count, going_on = shares.neighbours[asked] + 1, shares.going_on[asked]
    gain = _log_likelihood(going_on, count, *MOVING) - _log_likelihood(going_on, count, *stands)
    return np.unique(shares.track[asked][gain + PRIOR > 0.0])


def _neighbourhoods(mapper: Mapper, moves: Bools) -> tuple[_Shares, Bools]:
    """Neighbourhoods, and which tracks (tracks,) one unit alone observes."""
    tracks, units = len(mapper.tracks), len(mapper.registered)
    rows = np.flatnonzero(mapper.is_inlier)
    of_keypoint = mapper.tracks.of_keypoint[rows]
    kept = mapper.triangulated[of_keypoint] & ~moves[of_keypoint]
    seen, images = np.unique(
        mapper.keypoints.unit[rows[kept]] * tracks + of_keypoint[kept], return_counts=True
    )  # by unit, and there by track
    unit, track = np.divmod(seen, tracks)
    single = np.bincount(track, minlength=tracks) == 1
    begins = np.searchsorted(unit, np.arange(units + 1))
    found: list[tuple[Ints, Ints, Ints]] = []
    for u in range(units):
        here = slice(begins[u], begins[u + 1])
        asked = np.flatnonzero(images[here] > 1)
        if len(asked):
            found.append(_around(mapper.state.points_m[track[here]], ~single[track[here]], track[here], asked))
    columns = [np.concatenate(each) for each in zip(*found, strict=True)] if found else [np.zeros(0, np.int64)] * 3
    return _Shares(track=columns[0], neighbours=columns[1], going_on=columns[2]), single


def _around(points_m: Floats, goes_on: Bools, track: Ints, asked: Ints) -> tuple[Ints, Ints, Ints]:
    """Tracks, neighbours and those going on, around the points `asked` (n,) of all points (m, 3) of a unit."""
    count = min(NEIGHBOURS + 1, len(points_m))
    _, index = cKDTree(points_m).query(points_m[asked], k=count, distance_upper_bound=REACH_M)
    index = np.asarray(index, dtype=np.int64).reshape(len(asked), count)
    is_other = (index < len(points_m)) & (index != asked[:, None])
    going_on = is_other & np.append(goes_on, False)[index]
    return track[asked], is_other.sum(axis=1), going_on.sum(axis=1)


def _distribution(shares: _Shares) -> tuple[float, float]:
    """The Beta distribution of the share, by its moments."""
    told = shares.neighbours > 1
    n, share = shares.neighbours[told], shares.going_on[told] / shares.neighbours[told]
    mean = float(np.clip(np.average(share, weights=n), 0.01, 0.99)) if told.any() else 0.5
    # The variance of a share of n is mean (1 - mean) (1 + (n - 1) correlation) / n.
    binomial = mean * (1.0 - mean)
    excess = float(np.mean((share - mean) ** 2 - binomial / n)) if told.any() else 0.0
    correlation = float(np.clip(excess / (binomial * np.mean(1.0 - 1.0 / n)), *CORRELATION)) if told.any() else 0.5
    both = (1.0 - correlation) / correlation
    return mean * both, (1.0 - mean) * both


def _log_likelihood(successes: Ints, trials: Ints, a: float, b: float) -> Floats:
    """Of a Beta-binomial distribution, less the binomial coefficient."""
    result: Floats = betaln(a + successes, b + trials - successes) - betaln(a, b)
    return result
