"""A leap of the receiver's clock against that of the images: one of the two was set while the vehicle drove.

Positions behind a leap lie ahead of the vehicle or behind it, by its speed times that. One offset for all positions
would be neither, and the scene would have another length, by more than positions that good leave open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.calibration import scale_of_baselines
from mrasfm_engine.mapping.georeferencing import BENDS, assess_residuals
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import beside_a_bent_scene, extent_m, positions_with_errors
from mrasfm_engine.mapping.receiver_clock import fit_motions, log_odds, track_motions
from mrasfm_engine.mapping.receiver_fit import Placement, antenna_places_m, most_likely_errors
from mrasfm_engine.mapping.receiver_jumps import AROUND
from mrasfm_engine.types import Floats
from schemas.findings import Finding, warning

ROUNDS = 4  # of weights by which positions that stick out count less
# Before positions say anything: the share of clocks that leap, of those that are wrong, and how far they leap.
LEAP_SHARE, SIGMA_OF_LEAP_S = 0.05, 1.0


@dataclass(frozen=True, kw_only=True)
class ClockLeap:
    """A leap of the receiver's clock.

    Attributes
    ----------
    last_before_us, first_behind_us
        Times of units between which it lies, as far apart as positions leave open.
    seconds
        About by how much more samples behind it are ahead of the images than those before it.
    later_is_used
        Whether the samples behind it are those that take part, as they are more.
    """

    last_before_us: int
    first_behind_us: int
    seconds: float
    later_is_used: bool

    def used(self, track: GnssTrack) -> GnssTrack:
        """The track with the samples of one side alone."""
        at_us = track.timestamps_us
        used = at_us >= self.first_behind_us if self.later_is_used else at_us <= self.last_before_us
        return replace(track, good=track.good & used)


def find_clock_leap(mapper: Mapper, placement: Placement) -> ClockLeap | None:
    """The leap of a clock that one offset does not explain; None where there is none, or positions tell none.

    The errors that wander are those that are most likely once the leap is known: it must not pass for one of them, nor
    they for it.
    """
    units = placement.units
    if len(units) < 4 * AROUND:
        return None
    none = np.zeros(0, dtype=np.int64)
    placement = replace(placement, jumps=none, blended=none, level_m=np.zeros((1, 3)))
    antenna_m = antenna_places_m(mapper, units, placement.lever_arm_m)
    time_s = mapper.drive.timestamps_us[units] / 1e6
    moves, (of_rig, sigma_rig) = track_motions(antenna_m, time_s), scale_of_baselines(mapper)
    sigma_factor = np.inf if mapper.drive.has_single_camera else sigma_rig
    sigma_m = placement.known_sigma_m[units]
    best, left_m = _best_leap(-placement.off_m, sigma_m, moves, 1.0 / of_rig, sigma_factor)
    by_leap = moves[:, :, :1] * (np.arange(len(units)) >= best)[:, None, None]
    inlier, factor = assess_residuals(
        left_m, sigma_m, np.ones(len(units), dtype=np.bool_), outlier_sigmas=mapper.config.gnss.outlier_sigmas
    )
    placement = replace(placement, inlier=inlier, noise_factor=factor)
    errors = most_likely_errors(mapper, replace(placement, off_m=left_m))
    positions = positions_with_errors(mapper, placement, units[inlier], errors)
    fitted = fit_motions(
        antenna_m[inlier],
        beside_a_bent_scene(positions, antenna_m),
        np.concatenate([moves, by_leap], axis=2)[inlier],
        factor=1.0 / of_rig,
        sigma_factor=sigma_factor,
    )
    if fitted is None:
        return None
    # A scene that bends moves one side against the other as well.
    bent_s = BENDS[0] * extent_m(antenna_m) / float(np.sqrt((moves[:, :, 0] ** 2).sum(axis=1).mean()))
    seconds, sigma_s = float(fitted[0][-1]), float(np.hypot(np.sqrt(fitted[1][-1, -1]), bent_s))
    odds = LEAP_SHARE / (1.0 - LEAP_SHARE) / (len(units) - 2 * AROUND)  # at any of so many places
    if log_odds(seconds, sigma_s, odds=odds, sigma_of_wrong_s=SIGMA_OF_LEAP_S) <= 0.0:
        return None
    at_us, margin_us = mapper.drive.timestamps_us[units], round(1e6 * abs(seconds))
    return ClockLeap(
        last_before_us=int(at_us[best - AROUND]) - margin_us,
        first_behind_us=int(at_us[min(best + AROUND, len(units) - 1)]) + margin_us,
        seconds=seconds,
        later_is_used=bool(inlier[best:].sum() > inlier[:best].sum()),
    )


def clock_leap_findings(leap: ClockLeap | None, start_us: int) -> list[Finding]:
    """The finding that a receiver's clock leaps; none where it does not.

    Parameters
    ----------
    start_us
        Time that the drive's seconds count from.
    """
    if leap is None:
        return []
    first_s, last_s = ((at_us - start_us) / 1e6 for at_us in (leap.last_before_us, leap.first_behind_us))
    used, left_out = ("after", "before") if leap.later_is_used else ("before", "after")
    return [
        warning(
            "gnss-clock-leap",
            f"between {first_s:.1f} and {last_s:.1f} s the clock of gnss.samples leaps by about "
            f"{abs(leap.seconds):.2g} s against that of the images: of the samples, those {left_out} it are not used, "
            f"and the more numerous ones {used} it are",
            "Check what sets the clocks while the vehicle drives: a computer whose time comes from a network leaps "
            "when that comes. With timestamps shifted on one side of the leap, all positions are used.",
        )
    ]


def _best_leap(off_m: Floats, sigma_m: Floats, moves: Floats, factor: float, sigma_factor: float) -> tuple[int, Floats]:
    """The place of the leap that explains most of what positions are off (n, 3), and what is left of that (n, 3).

    Parameters
    ----------
    moves
        (n, 3, 6) as of `track_motions`.
    factor, sigma_factor
        What is known without the receiver of the factor by which the places have to grow.
    """
    count, velocity_mps, trust = len(off_m), moves[:, :, 0], np.ones(len(off_m))
    for _ in range(ROUNDS):
        weight = trust[:, None] / sigma_m**2
        information = np.einsum("nij,ni,nik->jk", moves, weight, moves)
        right = np.einsum("nij,ni,ni->j", moves, weight, off_m)
        information[1, 1] += sigma_factor**-2
        right[1] += (factor - 1.0) * sigma_factor**-2
        inverse = np.linalg.pinv(information, hermitian=True)
        # A leap moves all positions behind it: sums from each to the last.
        by_leap = velocity_mps * weight
        shared = _to_the_end(np.einsum("ni,nij->nj", by_leap, moves))
        alone = _to_the_end((by_leap * velocity_mps).sum(axis=1))
        seen = _to_the_end((by_leap * off_m).sum(axis=1))
        known = np.maximum(alone - np.einsum("nj,jk,nk->n", shared, inverse, shared), 1e-9 * alone.max())
        step_s = (seen - shared @ inverse @ right) / known
        gain = known * step_s**2
        gain[:AROUND] = gain[count - AROUND + 1 :] = 0.0
        best = int(gain.argmax())
        left_m = off_m - moves @ (inverse @ (right - shared[best] * step_s[best]))
        left_m[best:] -= velocity_mps[best:] * step_s[best]
        left = np.linalg.norm(left_m / sigma_m, axis=1)
        trust = 1.0 / (1.0 + (left / (3.0 * max(float(np.median(left)), 1e-6))) ** 2) ** 2
    return best, left_m


def _to_the_end(values: Floats) -> Floats:
    """Sums (n, ...) of values from each place to the last."""
    result: Floats = np.cumsum(values[::-1], axis=0)[::-1]
    return result
