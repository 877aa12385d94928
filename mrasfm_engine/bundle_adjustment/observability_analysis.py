"""Observability of the cameras' poses in the rig: directions that the drive determines, and those that rest on the
prior.

Two motions of the cameras change no image, whatever the drive: all cameras moved by one transform (the units move by
its inverse), and all moved away from their mean place by one factor (units and points move along). The adjustment holds
the first; the second, the scale, is as good as the baselines' prior and positions make it. Neither says anything about
one camera among the others, so a camera's direction is judged with both held: it is observed where the posterior
standard deviation is well below what the prior alone would leave. That is what was declared, but of a camera that the
drive shows far from where it was given no more than the loss has left. Where a direction is nothing but such a motion
(the baseline of two cameras is their scale), it is not observed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.types import Bools, Floats

ONLY_PRIOR_RATIO = 0.9  # above, a drive says nothing of a direction, or positions of the scale, that the prior does not
OBSERVED_RATIO = 0.5  # a direction counts as observed when its posterior sigma is below this share of the prior's
MIN_OWN_SHARE = 0.1  # of a direction's prior variance that is left when the motions that no image shows are held


@dataclass(frozen=True, kw_only=True)
class Observability:
    """Directions of `rig_from_cam` that a drive observes, about and along the rig's axes."""

    observed: Bools  # (c, 6) rotations, then translations, of a camera among the others
    ratio: (
        Floats  # (c, 6) posterior over prior sigma of the same; NaN where nothing of the direction is the camera's own
    )
    prior_sigma: Floats  # (c, 6) rad and m, see `CalibrationPrior.sigmas_left`
    scale_observed: bool  # whether positions know the size of the rig better than its prior does
    scale_only_prior: bool  # or say nothing of it at all
    sigma_scale: float  # posterior, relative, of the cameras' distances
    prior_sigma_scale: float  # by the priors of the cameras' places; infinite where these are one

    @property
    def to_hold(self) -> Bools:
        """Directions (c, 6) to leave as given: of which the drive says nothing that the prior does not.

        Of one of which it says a little the adjustment's mean of both is kept: held elsewhere, it would draw the
        others along. What is nothing but scale is held only where positions say nothing of that.
        """
        result: Bools = (np.nan_to_num(self.ratio, nan=np.inf) > ONLY_PRIOR_RATIO) & (
            np.isfinite(self.ratio) | self.scale_only_prior
        )
        return result

    @property
    def scale_in_words(self) -> str:
        """Source of the rig's size, in words."""
        if self.scale_observed:
            return "observed by positions"
        return "only the prior" if self.scale_only_prior else "the prior and positions"


def assess_directions(
    covariance: Floats,
    *,
    position_m: Floats,
    sigma_rotation_rad: Floats,
    sigma_translation_m: Floats,
    placed: bool,
    weight: Floats | None = None,
    sigma_left: Floats | None = None,
) -> Observability:
    """Compare the posterior of all cameras' poses with their prior.

    Parameters
    ----------
    covariance
        Posterior (6 c, 6 c) of rotations (rad) and translations (m), camera by camera, with the cameras' mean
        correction held.
    position_m
        Places (c, 3) of the cameras in the rig.
    sigma_rotation_rad, sigma_translation_m
        Prior standard deviations (c,) of each axis.
    placed
        Whether positions or rough poses place the scene: without them, images and prior alone make the rig's size
        neither more nor less certain, however the posterior of wrong baselines comes out.
    weight
        Weights (c,) that the prior of places has left in the adjustment, of which cameras far from where they were
        given keep little: positions may well know the length of their baselines better than that.
    sigma_left
        Standard deviations (c, 6) that the prior has left of rotations and translations: see
        `CalibrationPrior.sigmas_left`.
    """
    cameras = len(position_m)
    sigma = np.repeat(np.stack([sigma_rotation_rad, sigma_translation_m], 1), 3, axis=1)
    prior_sigma = sigma if sigma_left is None else sigma_left
    if not np.isfinite(covariance).all():
        return Observability(
            observed=np.zeros((cameras, 6), dtype=np.bool_),
            ratio=np.full((cameras, 6), np.inf),
            prior_sigma=prior_sigma,
            scale_observed=False,
            scale_only_prior=not placed,
            sigma_scale=np.inf,
            prior_sigma_scale=np.inf,
        )
    posterior = covariance / np.outer(sigma.ravel(), sigma.ravel())
    # The mean that is held is one of whitened corrections, so in these all common motions are alike.
    prior = np.asarray(np.kron(np.eye(cameras) - 1.0 / cameras, np.eye(6)), dtype=np.float64)
    growth = np.zeros((cameras, 6))
    growth[:, 3:] = (position_m - position_m.mean(0)) / sigma[:, 3:]
    functional: Floats = prior @ growth.ravel()
    known = float(functional @ functional)
    prior_scale = left_scale = posterior_scale = float("inf")
    scale_observed = False
    if known > 1e-6:
        prior_scale = 1.0 / float(np.sqrt(known))
        of_camera = (functional.reshape(cameras, 6) ** 2).sum(1)
        left_scale = 1.0 / float(np.sqrt(of_camera @ (np.ones(cameras) if weight is None else weight)))
        posterior_scale = float(np.sqrt(max(float(functional @ posterior @ functional), 0.0))) / known
        scale_observed = placed and posterior_scale < OBSERVED_RATIO * prior_scale
        if not scale_observed:
            prior, posterior = _given(prior, functional), _given(posterior, functional)
    own, left = np.diagonal(prior), np.maximum(np.diagonal(posterior), 0.0)
    ratio = np.where(own > MIN_OWN_SHARE, np.sqrt(left / np.maximum(own, MIN_OWN_SHARE)), np.nan).reshape(cameras, 6)
    ratio = ratio * sigma / prior_sigma
    return Observability(
        observed=np.nan_to_num(ratio, nan=np.inf) < OBSERVED_RATIO,
        ratio=ratio,
        prior_sigma=prior_sigma,
        scale_observed=scale_observed,
        scale_only_prior=not placed or posterior_scale > ONLY_PRIOR_RATIO * left_scale,
        sigma_scale=posterior_scale,
        prior_sigma_scale=prior_scale,
    )


def _given(covariance: Floats, functional: Floats) -> Floats:
    """The covariance (n, n) once the linear functional (n,) is known."""
    column = covariance @ functional
    variance = float(functional @ column)
    result: Floats = covariance if variance <= 0 else covariance - np.outer(column, column) / variance
    return result
