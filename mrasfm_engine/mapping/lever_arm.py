"""The antenna's place in the rig against the one that was given.

A lever arm with a wrong sign, or from another point of the vehicle than the rig's origin, is off by something that
turns with the vehicle. On a straight way that shifts all positions alike. A turn is wider or narrower by it, which
looks like a scene of another length, by per cents of one with good positions; or it begins late or early, as if the
clock were off.

Where the manifest says how well the place is known, it is three more unknowns of the adjustment
(`ReceiverPositions.lever_m`), and the antenna stands where these say. Without that it stays where it was given, as a
scene that bends by a thousandth can look the same: that it is more probably elsewhere is a finding, and what the length
of the scene would change by is in its sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.receiver_positions import AXES, ReceiverPositions
from mrasfm_engine.mapping.receiver_clock import STEADY_SIGMAS, normal_equations, track_motions
from mrasfm_engine.types import Floats
from schemas.findings import Finding, warning

# Before positions say anything: the share of lever arms that are wrong, and how far those are off along each axis: by
# what is between one point and another of a car.
WRONG_SHARE, SIGMA_OF_WRONG_M = 0.05, 1.0
LOG_ODDS_BEFORE = float(np.log(WRONG_SHARE / (1.0 - WRONG_SHARE)))
SIGMA_TURNS = 0.01  # of the angle of a turn as images show it, relative: lenses are known to about that
_TURNS = AXES + 5  # among the ways of an antenna, behind growth, shifts and a turn of all
_TOLD = 0.5  # of that sigma, below which positions tell where the antenna is along an axis
_DIRECTIONS = (("ahead of", "behind"), ("to the left of", "to the right of"), ("above", "below"))


@dataclass(frozen=True, kw_only=True)
class LeverArm:
    """Offset (3,) of the antenna from where it was given, in the rig's axes, and its sigmas (3,).

    Attributes
    ----------
    sigma_before_m
        What was known of it before, along each axis; 0 where the place that was given is exact.
    log_odds
        Logarithm of the odds that it was given wrongly [Bayes' theorem].
    longer
        By which a scene that has the positions' length is longer with the antenna there, relative.
    """

    offset_m: Floats
    sigma_m: Floats
    sigma_before_m: float
    log_odds: float
    longer: float = 0.0

    @staticmethod
    def unknown() -> LeverArm:
        """One of which positions have not been asked."""
        sigma_m = SIGMA_OF_WRONG_M
        return LeverArm(offset_m=np.zeros(AXES), sigma_m=np.full(AXES, sigma_m), sigma_before_m=sigma_m, log_odds=0.0)

    @property
    def is_wrong(self) -> bool:
        """True where it is more probable that the antenna is elsewhere than that it is where it was given."""
        return self.log_odds > 0.0

    @property
    def may_be_wrong(self) -> bool:
        """True where positions say rather that it is elsewhere."""
        return self.log_odds > LOG_ODDS_BEFORE

    def is_as(self, other: LeverArm) -> bool:
        """True where both agree but for less than their sigmas can tell."""
        steady = np.abs(self.offset_m - other.offset_m) < STEADY_SIGMAS * self.sigma_m
        return self.is_wrong == other.is_wrong and bool(steady.all())


def lever_arm(
    off_m: Floats,
    ways: Floats,
    positions: ReceiverPositions,
    *,
    assumed_m: Floats,
    sigma_given_m: float = 0.0,
    factor: float = 1.0,
    sigma_factor: float = np.inf,
) -> tuple[LeverArm, Floats]:
    """The lever arm that measured positions have against places of the antenna.

    Parameters
    ----------
    off_m
        Measured positions less these places (n, 3).
    ways
        (n, 3, k), see `ways_of_antenna`.
    assumed_m
        Offset (3,) from where the antenna was given, at which it is taken to be there.
    sigma_given_m
        Of that place along each axis; 0 if it is exact unless it is wrong.
    factor, sigma_factor
        What is known without the receiver of the factor by which the places have to grow.

    Returns
    -------
    LeverArm
    sizes : (k,)
        By how much the places have to move along the ways.
    """
    known = normal_equations(
        off_m, replace(positions, lever_m=None), ways, grows=AXES, factor=factor, sigma_factor=sigma_factor
    )
    known[_TURNS, _TURNS] += SIGMA_TURNS**-2
    own, rest = slice(0, AXES), slice(AXES, -1)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(known)[rest], 1e-12))
    scale = np.outer(scale, scale)
    inverse = scale * np.linalg.pinv(scale * known[rest, rest], rcond=1e-12, hermitian=True)
    matrix = known[own, own] - known[own, rest] @ inverse @ known[rest, own]
    right = known[own, -1] - known[own, rest] @ inverse @ known[rest, -1]
    left = float(known[-1, -1] - known[-1, rest] @ inverse @ known[rest, -1])
    prior = np.eye(AXES) / SIGMA_OF_WRONG_M**2
    step_m = np.linalg.solve(matrix + prior, right - prior @ assumed_m)
    noise = max(1.0, (left - float(right @ step_m)) / off_m.size)
    result = _judged(matrix / noise, (right + matrix @ assumed_m) / noise, sigma_given_m)
    return result, np.concatenate([step_m, inverse @ (known[rest, -1] - known[rest, own] @ step_m)])


def ways_of_antenna(antenna_m: Floats, rotation: Floats, time_s: Floats, *, times_vary: bool) -> Floats:
    """Ways (n, 3, k) in which places (n, 3) of an antenna move: along the rig's axes by a metre, by growth, and others.

    Parameters
    ----------
    rotation
        The rig's (n, 3, 3) there.
    times_vary
        Whether all images may have been taken earlier or later, too.
    """
    by_time, others = np.split(track_motions(antenna_m, time_s), [1], axis=2)
    ways = [rotation, others, _by_turning_more(antenna_m, rotation)]
    return np.concatenate([*ways, by_time] if times_vary else ways, axis=2)


def _by_turning_more(antenna_m: Floats, rotation: Floats) -> Floats:
    """The way (n, 3, 1) of places if each turn of the vehicle is wider by all of itself."""
    heading = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    steps_m, at = np.diff(antenna_m, axis=0), 0.5 * (heading[1:] + heading[:-1]) - heading.mean()
    aside_m = at[:, None] * np.stack([-steps_m[:, 1], steps_m[:, 0], np.zeros(len(at))], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(aside_m, axis=0)])[:, :, None]


def _judged(matrix: Floats, right: Floats, sigma_given_m: float) -> LeverArm:
    """The lever arm by normal equations about where it was given; offsets are normal, of wrong ones and of others."""
    evidence_of_wrong = _evidence(matrix, right, SIGMA_OF_WRONG_M)
    log_odds = LOG_ODDS_BEFORE + evidence_of_wrong - _evidence(matrix, right, sigma_given_m)
    sigma_m = SIGMA_OF_WRONG_M if log_odds > 0.0 else sigma_given_m
    covariance = _posterior(matrix, sigma_m)
    return LeverArm(
        offset_m=covariance @ right,
        sigma_m=np.sqrt(np.maximum(np.diagonal(covariance), 0.0)),
        sigma_before_m=sigma_m,
        log_odds=log_odds,
    )


def _posterior(matrix: Floats, sigma_m: float) -> Floats:
    """Covariance (3, 3) of offsets that have a standard deviation before positions say anything, which may be 0."""
    variance = sigma_m**2
    return np.asarray(variance * np.linalg.inv(np.eye(AXES) + variance * matrix), dtype=np.float64)


def _evidence(matrix: Floats, right: Floats, sigma_m: float) -> float:
    """Log likelihood of positions if offsets have this standard deviation, less that without an offset."""
    determinant = float(np.linalg.slogdet(np.eye(AXES) + sigma_m**2 * matrix)[1])
    return 0.5 * (float(right @ _posterior(matrix, sigma_m) @ right) - determinant)


def lever_arm_findings(lever: LeverArm | None, *, is_taken: bool) -> list[Finding]:
    """The finding that the antenna is elsewhere; none where it may be where it was given.

    `is_taken` says that the scene takes it to be there.
    """
    if lever is None or not lever.is_wrong:
        return []
    if is_taken:
        then, declare = "the scene takes it to be there", ""
    else:
        longer = "longer" if lever.longer > 0 else "shorter"
        then = f"the scene leaves it where it was given, and would be {abs(lever.longer):.1%} {longer} with it there"
        declare = " With gnss.sigma_antenna_m its place is estimated with the scene."
    clearest = int(np.argmax(np.abs(lever.offset_m) / lever.sigma_m))
    told = [
        f"{abs(off_m):.2f} m {names[0 if off_m > 0 else 1]} (sigma {sigma_m:.2f} m)"
        for axis, (off_m, sigma_m, names) in enumerate(zip(lever.offset_m, lever.sigma_m, _DIRECTIONS, strict=True))
        if axis == clearest or sigma_m < _TOLD * SIGMA_OF_WRONG_M
    ]
    return [
        warning(
            "antenna-position",
            f"by the shape of the way, the antenna is {' and '.join(told)} where gnss.antenna_in_rig_m says: {then}",
            "Check gnss.antenna_in_rig_m: its signs, its axes (rig.body_axes), and that it begins at the rig's origin, "
            f"from which rig_from_cam is given.{declare} Distortion left in rectified images bends a scene as well: "
            "with sigma_distortion of the cameras it is estimated.",
        )
    ]
