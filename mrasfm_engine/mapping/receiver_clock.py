"""The receiver's clock against that of the images.

Positions that pass a serial line, or have the time at which a computer logged them, are late by tenths of a second. All
of them then lie behind the vehicle, by its speed times that: where it accelerates, its way seems to have another
length, by per cents of a scene with good positions, and where it turns, another shape. Both tell how late they are,
wherever the scene lies and however long it is.

A clock is taken to be right, as the manifest says, until it is more probable that it is wrong. Then it is one more
unknown of the adjustment (`ReceiverPositions.clock_m`), and samples have the times that it says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats
from schemas.findings import Finding, warning

MIN_POSITIONS_FOR_CLOCK = 5
# Before positions say anything: the share of receivers whose clock is wrong, and how far those are off.
WRONG_SHARE, SIGMA_OF_WRONG_CLOCK_S = 0.05, 0.3
STEADY_SIGMAS = 0.1  # changes of an offset below this share of its sigma are none
SINGULAR = 1e-10  # eigenvalue of a matrix of unit diagonal that is rounding


@dataclass(frozen=True, kw_only=True)
class ReceiverClock:
    """Seconds by which a receiver's positions are ahead of the images, behind if negative, and their sigma."""

    offset_s: float
    sigma_s: float

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that it is wrong [Bayes' theorem]."""
        odds = WRONG_SHARE / (1.0 - WRONG_SHARE)
        return log_odds(self.offset_s, self.sigma_s, odds=odds, sigma_of_wrong_s=SIGMA_OF_WRONG_CLOCK_S)

    @property
    def is_wrong(self) -> bool:
        """True where it is more probable that it is wrong than that it is right."""
        return self.log_odds > 0.0

    def is_as(self, other: ReceiverClock) -> bool:
        """True where both agree but for less than their sigmas can tell."""
        return abs(self.offset_s - other.offset_s) < STEADY_SIGMAS * self.sigma_s


def log_odds(seconds: float, sigma_s: float, *, odds: float, sigma_of_wrong_s: float) -> float:
    """Logarithm of the odds of an error of a clock, as estimated, against none [Bayes' theorem].

    `odds` are those before positions say anything, and errors then are normal with `sigma_of_wrong_s`.
    """
    of_wrong = np.hypot(sigma_s, sigma_of_wrong_s)
    squared = seconds**2 * (sigma_s**-2 - of_wrong**-2)
    return float(np.log(odds * sigma_s / of_wrong) + 0.5 * squared)


def clock_offset(
    antenna_m: Floats, positions: ReceiverPositions, *, factor: float = 1.0, sigma_factor: float = np.inf
) -> ReceiverClock | None:
    """The offset that measured positions have against places (n, 3) that are aligned with them.

    Where the speed or the direction changes, it cannot be mistaken for a shift, a turn or a growth of the whole track;
    else its standard deviation is large. None with fewer than 5 positions, and where nothing tells it.

    Parameters
    ----------
    factor, sigma_factor
        What is known without the receiver of the factor by which the places have to grow.
    """
    if len(antenna_m) < MIN_POSITIONS_FOR_CLOCK:
        return None
    moves = track_motions(antenna_m, positions.time_s)
    fitted = fit_motions(antenna_m, positions, moves, factor=factor, sigma_factor=sigma_factor)
    if fitted is None:
        return None
    solution, covariance = fitted
    return ReceiverClock(offset_s=float(solution[0]), sigma_s=float(np.sqrt(covariance[0, 0])))


def track_motions(antenna_m: Floats, time_s: Floats) -> Floats:
    """Ways (n, 3, 6) in which places (n, 3) move: by a second of a clock, by growth, along axes, about the vertical."""
    velocity = np.gradient(antenna_m, time_s, axis=0)[:, :, None]
    centred_m = antenna_m - antenna_m.mean(0)
    shift, yaw = np.tile(np.eye(3), (len(antenna_m), 1, 1)), -se3.skew(centred_m)[:, :, [2]]
    return np.concatenate([velocity, centred_m[:, :, None], shift, yaw], axis=2)


def fit_motions(
    antenna_m: Floats, positions: ReceiverPositions, moves: Floats, *, factor: float, sigma_factor: float
) -> tuple[Floats, Floats] | None:
    """Sizes (k,) of the moves (n, 3, k) of places that fit measured positions best, and their covariance (k, k).

    See `clock_offset` for the factor, of the second of them. None where nothing tells one of them.
    """
    positions = replace(positions, clock_m=None)
    off_m = positions.position_m - antenna_m
    known = normal_equations(off_m, positions, moves, grows=1, factor=factor, sigma_factor=sigma_factor)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(known)[:-1], 1e-12))
    matrix, right = known[:-1, :-1] * np.outer(scale, scale), known[:-1, -1] * scale
    if np.linalg.eigvalsh(matrix)[0] < SINGULAR:
        return None
    solution = np.linalg.solve(matrix, right)
    noise = max(1.0, float(known[-1, -1] - right @ solution) / off_m.size)
    return solution * scale, noise * np.linalg.inv(matrix) * np.outer(scale, scale)


def normal_equations(
    off_m: Floats, positions: ReceiverPositions, moves: Floats, *, grows: int, factor: float, sigma_factor: float
) -> Floats:
    """Information (k + 1, k + 1) on moves (n, 3, k) of places, and last on what positions are off them (n, 3).

    `grows` is the number of the move that lets the places grow, of which a factor is known.
    """
    known = positions.information(np.concatenate([moves, off_m[:, :, None]], axis=2))
    of_factor = np.array([1.0, factor - 1.0]) / sigma_factor
    known[np.ix_([grows, -1], [grows, -1])] += np.outer(of_factor, of_factor)
    return known


def clock_findings(clock: ReceiverClock | None) -> list[Finding]:
    """The finding that a receiver's clock is off the images'; none where it is taken to be right."""
    if clock is None:
        return []
    direction = "ahead of" if clock.offset_s > 0 else "behind"
    return [
        warning(
            "gnss-clock-offset",
            f"by the shape of the way, gnss.samples are {abs(clock.offset_s):.3g} s {direction} the images "
            f"(sigma {clock.sigma_s:.2g} s): the scene takes them for positions at those times",
            "Check that both have the same clock and time scale (GPS is 18 s ahead of UTC), and that samples have the "
            "time of their position, not that of their arrival.",
        )
    ]
