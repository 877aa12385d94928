"""Time offsets of cameras: by how much later than their timestamps say their images were taken.

An image of a moving vehicle that is later by delta stands farther along the trajectory by velocity times delta. At one
speed that looks like a camera that is mounted elsewhere; where the speed varies, or the vehicle turns, the two differ.
Offsets therefore vary with `rig_from_cam`, each under its prior. Cameras whose images are all taken at once have none,
unless the manifest says how well their times are known.

A shutter that rolls although the manifest does not say so passes for an offset: a camera's lower rows see what is near,
and see it later. Where no readout is declared, 0 for rows that are all taken at once included, an offset's sigma says
what the one would do to it that the residuals show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances
from mrasfm_engine.bundle_adjustment.observability_analysis import OBSERVED_RATIO, ONLY_PRIOR_RATIO
from mrasfm_engine.bundle_adjustment.priors import TimePrior, robust_gauge_weights
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.mapping.calibration import median_depth_m
from mrasfm_engine.mapping.georeferencing import similarity_motions
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools, Floats
from schemas.findings import Finding, warning

BEYOND_PRIOR_SIGMAS = 4.0
SIGMA_READOUT_S = 0.015  # of shutters of which nothing is declared: sensors read their rows in up to 30 ms


@dataclass(frozen=True, kw_only=True)
class TimeCertainty:
    """Knowledge of the cameras' time offsets: of each against their mean, where that is held.

    Attributes
    ----------
    sigma_s
        (cameras,) posterior.
    observed
        (cameras,) whether the drive knows them better than their prior does, or has drawn them far from there.
    to_hold
        (cameras,) whether the adjustment knows nothing that the prior does not.
    """

    sigma_s: Floats
    observed: Bools
    to_hold: Bools


def times_can_be_told(mapper: Mapper) -> bool:
    """True where settings and rig allow time offsets, if images are not taken at once."""
    settings = mapper.config.bundle_adjustment
    return (
        settings.refine_time_offsets
        and settings.priors
        and settings.camera_set_adjustment
        and not mapper.drive.has_single_camera
    )


def times_may_vary(mapper: Mapper) -> bool:
    """True where settings and drive allow time offsets."""
    return times_can_be_told(mapper) and not mapper.state.simultaneous


def time_prior(mapper: Mapper, *, mean_varies: bool, held: Bools | None = None) -> TimePrior:
    """The prior of all cameras' time offsets from the manifest's sigmas, or the default one.

    Parameters
    ----------
    mean_varies
        Whether positions tell when images were taken.
    held
        (cameras,) offsets that stay at zero; without, none does.
    """
    sigma_s, weights = _sigma_s(mapper), None
    if not mean_varies:
        weights = robust_gauge_weights((mapper.state.camera_time_offset_s / sigma_s)[:, None])
    return TimePrior(
        sigma_s=sigma_s, held=np.zeros(len(sigma_s), dtype=np.bool_) if held is None else held, gauge_weights=weights
    )


def offsets_are_steady(mapper: Mapper, before_s: Floats) -> bool:
    """True where no offset (c,) has moved among the others by more than its prior allows.

    One that moves farther is on its way: observations were chosen by what it was.
    """
    moved_s = mapper.state.camera_time_offset_s - before_s
    return bool((np.abs(moved_s - np.median(moved_s)) <= BEYOND_PRIOR_SIGMAS * _sigma_s(mapper)).all())


def _sigma_s(mapper: Mapper) -> Floats:
    default_us = mapper.config.bundle_adjustment.sigma_time_offset_us
    return np.array([camera.sigma_time_offset_us or default_us for camera in mapper.drive.cameras]) / 1e6


def positions_may_tell_time(mapper: Mapper, positions: ReceiverPositions) -> bool:
    """True where positions would know the offsets' mean better than its prior does, if the scene could not bend.

    Wherever the scene lies, and however large it is.
    """
    velocity_mps = mapper.motion.velocity_mps(mapper.state, mapper.registered)[positions.unit]
    moves = similarity_motions(mapper.state.unit_position_m[positions.unit])
    sigma_s = _sigma_s(mapper)
    known = positions.information_given(velocity_mps, moves)
    return bool(known * (sigma_s**2).mean() / len(sigma_s) > OBSERVED_RATIO**-2)


def positions_tell_time(mapper: Mapper, certainty: Covariances) -> bool:
    """True where an adjustment in which the offsets' mean varied knows it better than its prior does."""
    sigma_s = _sigma_s(mapper)
    return bool(np.sqrt(certainty.times_s2.sum()) < OBSERVED_RATIO * np.linalg.norm(sigma_s))


def undeclared_readouts(mapper: Mapper) -> Bools:
    """Cameras (c,) whose manifest does not say how long they take from the first row to the last."""
    return np.array([camera.readout_us is None for camera in mapper.drive.cameras])


def interpolation_error_s(mapper: Mapper) -> Floats:
    """Time offsets (c,) that the cameras seem to have because the rig does not move on a parabola between units.

    That of a camera whose motion since its units' timestamps looks most like what is left out, in rotation and, as seen
    at the points' median depth, in translation; of both the mean goes into `rig_from_cam`.
    """
    velocity, left_out = mapper.motion.left_out(mapper.state, mapper.registered)
    as_seen = np.repeat([1.0, 1.0 / max(median_depth_m(mapper), 1e-3)], 3)
    camera, known = mapper.image_camera, mapper.registered[mapper.image_unit]
    result = np.zeros(len(mapper.camera_kind))
    for c in range(len(result)):
        rate = velocity[known & (camera == c)] * as_seen
        rate = rate - rate.mean(0) if len(rate) else rate
        power = float((rate**2).sum())
        if power > 0.0:
            result[c] = (rate * left_out[known & (camera == c)] * as_seen).sum() / power
    return result


def assess_times(prior: TimePrior, certainty: Covariances, error_s: Floats, offset_s: Floats) -> TimeCertainty | None:
    """Compare what is known of the offsets (c,), besides errors (c,) that interpolation makes, with their prior.

    An offset that is far off by both is one that the drive wants, however little more than the prior it knows of it.

    None where nothing is known.
    """
    if len(certainty.times_s2) != len(prior.sigma_s) or not np.isfinite(certainty.times_s2).all():
        return None

    def sigma_s(covariance_s2: Floats) -> Floats:
        result: Floats = np.sqrt(np.maximum(np.diagonal(prior.without_gauge(covariance_s2)), 0.0))
        return result

    before_s = sigma_s(np.diag(prior.sigma_s**2))
    # What errors of all cameras do to the trajectory is common to them.
    after_s = sigma_s(certainty.times_s2 + np.outer(error_s, error_s) + (error_s**2).mean())
    independent_s = sigma_s(certainty.times_of_independent_errors_s2)
    if prior.gauge_weights is not None:
        offset_s = offset_s - np.average(offset_s, weights=prior.gauge_weights)
    is_far = np.abs(offset_s) > BEYOND_PRIOR_SIGMAS * np.maximum(prior.sigma_s, after_s)
    return TimeCertainty(
        sigma_s=after_s,
        observed=np.asarray((after_s < OBSERVED_RATIO * before_s) | is_far),
        to_hold=np.asarray((independent_s > ONLY_PRIOR_RATIO * before_s) & ~is_far),
    )


def time_findings(drive: Drive, offset_s: Floats, prior: TimePrior, certainty: TimeCertainty) -> list[Finding]:
    """Cameras whose images were taken at other times than their timestamps say."""
    off: Sequence[int] = np.flatnonzero(
        certainty.observed & (np.abs(offset_s) > BEYOND_PRIOR_SIGMAS * prior.sigma_s)
    ).tolist()
    return [
        warning(
            "time-offset-beyond-prior",
            f"images of camera {drive.cameras[c].name} were taken {1e3 * offset_s[c]:+.1f} ms from their timestamps, "
            f"{abs(offset_s[c]) / prior.sigma_s[c]:.0f} sigmas of the prior",
            "Check where the camera's timestamps come from, and sigma_time_offset_us of the camera.",
        )
        for c in off
    ]
