"""What is known of the calibration beforehand, and whether the drive may change it."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.adjustment.priors import CalibrationPrior
from mrasfm_engine.registration.model import Model


def calibration_prior(model: Model) -> CalibrationPrior:
    """The prior of `rig_from_cam` from the manifest's sigmas, or the default ones, with weights as of now."""
    settings, cameras = model.config.adjustment, model.drive.cameras
    given = model.drive.rig_from_cam
    prior = CalibrationPrior(
        rotation=given[:, :3, :3],
        position_m=given[:, :3, 3],
        sigma_rotation_rad=np.radians([c.sigma_rotation_deg or settings.sigma_rotation_deg for c in cameras]),
        sigma_translation_m=np.array([c.sigma_translation_m or settings.sigma_translation_m for c in cameras]),
    )
    return prior.with_weights(model.state)


def heading_change_deg(model: Model) -> float:
    """By how much the registered units' forward directions spread, degrees."""
    forward = model.state.unit_rotation[model.registered][:, :, 0]
    mean = forward.mean(0) / max(float(np.linalg.norm(forward.mean(0))), 1e-9)
    angles = np.degrees(np.arccos(np.clip(forward @ mean, -1, 1)))
    return float(2 * angles.max())


def calibration_is_free(model: Model, *, georeferenced: bool) -> bool:
    """Whether `rig_from_cam` may vary: on a straight way without GNSS it is not observed, and freeing it does harm."""
    settings = model.config.adjustment
    if not settings.refine_calibration or len(model.drive.cameras) < 2:
        return False
    return georeferenced or heading_change_deg(model) >= settings.min_heading_change_deg


def scale_of_baselines(model: Model) -> tuple[float, float]:
    """By which factor the baselines would have to grow to be as given, and its standard deviation by their prior."""
    prior = calibration_prior(model)
    given = prior.position_m - prior.position_m.mean(0)
    current = model.state.camera_position_m - model.state.camera_position_m.mean(0)
    information = float(((given**2).sum(1) / prior.sigma_translation_m**2).sum())
    factor = float((given * current).sum() / max(float((current**2).sum()), 1e-12))
    return factor, 1.0 / float(np.sqrt(max(information, 1e-12)))


def scale_with_baselines(model: Model, factor: float) -> None:
    """Scale units, points and cameras about their middle: this changes no image, and adjustment hardly notices it.

    The cameras' mean place in the rig is kept, as the gauge holds it; the units move instead.
    """
    state = model.state
    centre = state.unit_position_m[model.registered].mean(0)
    mean = state.camera_position_m.mean(0)
    # Scaled about the rig's origin the cameras' mean would move by this.
    moved = (factor - 1.0) * mean
    state.unit_position_m[:] = centre + factor * (state.unit_position_m - centre) + state.unit_rotation @ moved
    state.points_m[:] = centre + factor * (state.points_m - centre)
    state.camera_position_m[:] = mean + factor * (state.camera_position_m - mean)
