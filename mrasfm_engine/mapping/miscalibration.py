"""Miscalibrated cameras, found by their corrections and by the units' votes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.bundle_adjustment.observability_analysis import Observability
from mrasfm_engine.bundle_adjustment.priors import CONTRADICTED_SIGMAS, CalibrationPrior
from mrasfm_engine.mapping.systematic_errors import SystematicErrors
from mrasfm_engine.mapping.unit_registration import Registration
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats
from schemas.findings import Finding, warning

SIGNIFICANT_SIGMAS = 5.0  # of the posterior: less is no correction at all
UNUSUAL = 5.0  # times the other cameras' median correction, where that is more than
MIN_UNUSUAL_DEG, MIN_UNUSUAL_M = 1.0, 0.1  # what mountings and calibrations are off by as a rule
MIN_OTHERS = 2  # cameras that say what is usual


@dataclass(frozen=True, kw_only=True)
class Miscalibration:
    """A camera that stands or looks otherwise than given; lengths and angles of its correction."""

    camera: int
    rotation_deg: float
    translation_m: float
    prior_sigmas: float  # of the correction in the directions that the drive observes
    others_rotation_deg: float  # median correction of the other cameras
    others_translation_m: float


@dataclass(frozen=True, kw_only=True)
class MiscalibratedPair:
    """Two cameras whose relative pose differs from the given one: which of them is wrong is not observable."""

    rotation_deg: float
    translation_m: float


def find_wrong_pair(
    prior: CalibrationPrior, state: State, directions: Observability, systematic: SystematicErrors | None = None
) -> MiscalibratedPair | None:
    """Check whether the two cameras of a rig are off against each other by more than their prior can be.

    Parameters
    ----------
    systematic
        Errors of the corrections that all images share, if they are known.
    """
    corrections = np.where(directions.observed, prior.corrections(state), 0.0)
    if len(corrections) != 2:
        return None
    _, allowed, posterior = _sigmas(prior, directions, systematic)
    if not any(
        _is_wrong(corrections[:, part], c, sigma=allowed[c, part], posterior=posterior[c, part], floor=np.inf)
        for c in range(2)
        for part in (slice(0, 3), slice(3, 6))
    ):
        return None
    between = corrections[1] - corrections[0]
    return MiscalibratedPair(
        rotation_deg=float(np.degrees(np.linalg.norm(between[:3]))),
        translation_m=float(np.linalg.norm(between[3:])),
    )


def find_miscalibrations(
    prior: CalibrationPrior, state: State, directions: Observability, systematic: SystematicErrors | None = None
) -> list[Miscalibration]:
    """Cameras whose correction is certain, and far outside its prior or far from what the other cameras need.

    Only directions count that the drive observes.

    Parameters
    ----------
    systematic
        Errors of the corrections that all images share, if they are known.
    """
    corrections = prior.corrections(state)
    if len(corrections) == 2:
        return []  # they share the correction of their pair: see `find_wrong_pair`
    if len(corrections) > MIN_OTHERS:
        # What all cameras share is held, not observed, and one that is wrong has its part in how it is held.
        corrections = corrections - np.median(corrections, axis=0)
    corrections = np.where(directions.observed, corrections, 0.0)
    sigma, allowed, posterior = _sigmas(prior, directions, systematic)
    found = []
    for c in range(len(corrections)):
        verdicts = [
            _is_wrong(corrections[:, part], c, sigma=allowed[c, part], posterior=posterior[c, part], floor=floor)
            for part, floor in ((slice(0, 3), np.radians(MIN_UNUSUAL_DEG)), (slice(3, 6), MIN_UNUSUAL_M))
        ]
        if not any(verdicts):
            continue
        size = np.stack([np.linalg.norm(corrections[:, :3], axis=1), np.linalg.norm(corrections[:, 3:], axis=1)])
        others = np.median(np.delete(size, c, axis=1), axis=1)
        found.append(
            Miscalibration(
                camera=c,
                rotation_deg=float(np.degrees(size[0, c])),
                translation_m=float(size[1, c]),
                prior_sigmas=float(np.abs(corrections[c] / sigma[c]).max()),
                others_rotation_deg=float(np.degrees(others[0])),
                others_translation_m=float(others[1]),
            )
        )
    return found


def _sigmas(
    prior: CalibrationPrior, directions: Observability, systematic: SystematicErrors | None
) -> tuple[Floats, Floats, Floats]:
    """Standard deviations (c, 6) of corrections before the drive, of how far they may come out, and after it.

    Errors of lens models turn and move a camera by more than a good calibration errs, and no repetition shows them.
    """
    sigma = prior.sigma
    # The common scale may be off: it moves all cameras, and is no fault of one.
    posterior = np.maximum(np.nan_to_num(directions.ratio, nan=1.0) * directions.prior_sigma, 1e-9)
    allowed = sigma if systematic is None else np.hypot(sigma, systematic.sigma_camera(posterior))
    return sigma, allowed, posterior


def _is_wrong(corrections: Floats, camera: int, *, sigma: Floats, posterior: Floats, floor: float) -> bool:
    own = corrections[camera]
    certain = np.abs(own) >= SIGNIFICANT_SIGMAS * posterior  # a direction that is hardly known makes no other one large
    if (np.abs(own) > CONTRADICTED_SIGMAS * sigma)[certain].any():
        return True
    others = np.linalg.norm(np.delete(corrections, camera, axis=0), axis=1)
    usual = max(floor, UNUSUAL * float(np.median(others))) if len(others) >= MIN_OTHERS else np.inf
    return bool(np.linalg.norm(own[certain]) > usual)


def voted_out(registrations: Sequence[Registration], covered_units: set[int]) -> dict[str, int]:
    """Count how often cameras were voted out, by name; in a unit with a covered image no camera is at fault."""
    return dict(Counter(name for r in registrations for name in r.voted_out if r.unit not in covered_units))


def finding(name: str, wrong: Miscalibration) -> Finding:
    """Finding on a miscalibrated camera."""
    return warning(
        "camera-miscalibrated",
        f"camera {name} is turned by {wrong.rotation_deg:.2f} deg and moved by {wrong.translation_m:.3f} m from where "
        f"rig.cameras says; the other cameras by {wrong.others_rotation_deg:.2f} deg and "
        f"{wrong.others_translation_m:.3f} m as a rule",
        "Check first that params and images are its own, and not mirrored or turned: no pose is right for others. "
        "It was recalibrated: take its pose from calibration.json, and check how it is mounted. One whose images are "
        "late seems to be mounted farther ahead or back: where they may be, declare its sigma_time_offset_us.",
    )


def pair_finding(names: Sequence[str], wrong: MiscalibratedPair) -> Finding:
    """Finding on a miscalibrated pair of cameras."""
    return warning(
        "camera-miscalibrated",
        f"cameras {names[0]} and {names[1]} are turned by {wrong.rotation_deg:.2f} deg and moved by "
        f"{wrong.translation_m:.3f} m against each other from where rig.cameras says; which of them is wrong, two "
        "cameras do not tell",
        "Check first that params and images are their own, and not mirrored or turned: no pose is right for others. "
        "They were recalibrated: take their poses from calibration.json, and check how both are mounted.",
    )
