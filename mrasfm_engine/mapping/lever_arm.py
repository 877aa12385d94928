"""The antenna's place in the rig against the one that was given.

A lever arm with a wrong sign, or from another point of the vehicle than the rig's origin, is off by something that
turns with the vehicle. On a straight way that shifts all positions alike. A turn is wider or narrower by it, which
looks like a scene of another length, by per cents of one with good positions; or it begins late or early, as if the
clock were off.

A place is taken to be as well known as the manifest says, or exact, until it is more probable that it is wrong. Where
it is not exact it is three more unknowns of the adjustment (`ReceiverPositions.lever_m`), and the antenna stands where
these say.
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
    """

    offset_m: Floats
    sigma_m: Floats
    sigma_before_m: float
    log_odds: float

    @staticmethod
    def unknown() -> LeverArm:
        """One of which positions have not been asked."""
        known = {"offset_m": np.zeros(AXES), "sigma_m": np.full(AXES, SIGMA_OF_WRONG_M)}
        return LeverArm(**known, sigma_before_m=SIGMA_OF_WRONG_M, log_odds=0.0)

    @property
    def varies(self) -> bool:
        """True where it is estimated."""
        return self.sigma_before_m > 0.0

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
    ways = [rotation, others, by_time] if times_vary else [rotation, others]
    return np.concatenate(ways, axis=2)


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


def lever_arm_findings(lever: LeverArm | None) -> list[Finding]:
    """The finding that the antenna is elsewhere; none where it may be where it was given."""
    if lever is None or not lever.is_wrong:
        return []
    clearest = int(np.argmax(np.abs(lever.offset_m) / lever.sigma_m))
    told = [
        f"{abs(off_m):.2f} m {names[0 if off_m > 0 else 1]} (sigma {sigma_m:.2f} m)"
        for axis, (off_m, sigma_m, names) in enumerate(zip(lever.offset_m, lever.sigma_m, _DIRECTIONS, strict=True))
        if axis == clearest or sigma_m < _TOLD * SIGMA_OF_WRONG_M
    ]
    return [
        warning(
            "antenna-position",
            f"by the shape of the way, the antenna is {' and '.join(told)} where gnss.antenna_in_rig_m says: the scene "
            "takes it to be there",
            "Check gnss.antenna_in_rig_m: its signs, its axes (rig.body_axes), and that it begins at the rig's origin, "
            "from which rig_from_cam is given.",
        )
    ]
