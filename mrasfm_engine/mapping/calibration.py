"""Prior knowledge of the calibration, and the decision whether the drive may change it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances, covariances
from mrasfm_engine.bundle_adjustment.observability_analysis import Observability, assess_directions
from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior, Term
from mrasfm_engine.bundle_adjustment.shared_errors import MIN_UNITS
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.matching.simultaneous import calibration_sigmas
from mrasfm_engine.types import Bools, Floats

STRAIGHT = "held as given: without GNSS a drive this straight does not observe it"
FEW_UNITS = "held as given: too few units to tell what they err by together"
MANY_UNITS = 10  # that leave nothing of a calibration open but what its prior knows
MIN_BASELINES_M2 = 1e-6
SCALE_RANGE = 0.3  # of its logarithm, that an adjustment may be off


def calibration_prior(mapper: Mapper, held: Bools | None = None) -> CalibrationPrior:
    """The prior of `rig_from_cam` from the manifest's sigmas, or the default ones, with weights as of now.

    Directions that are `held` (cameras, 6) stay as given.
    """
    given = mapper.drive.rig_from_cam
    sigma_rotation_rad, sigma_translation_m = calibration_sigmas(mapper.drive, mapper.config.bundle_adjustment)
    prior = CalibrationPrior(
        rotation=given[:, :3, :3],
        position_m=given[:, :3, 3],
        sigma_rotation_rad=sigma_rotation_rad,
        sigma_translation_m=sigma_translation_m,
        held=held,
    )
    return prior.with_weights(mapper.state)


def prior_among_observing_cameras(mapper: Mapper) -> CalibrationPrior:
    """The prior whose gauge is the mean of the cameras that observe points.

    Nothing but the prior knows where one is that observes none: beside a mean with such a one in it, no camera's pose
    is known better than that.
    """
    return calibration_prior(mapper).with_weights(mapper.state, observing_cameras(mapper))


def observing_cameras(mapper: Mapper) -> Bools:
    """Cameras (c,) that observe a point of the scene."""
    counts = np.bincount(mapper.keypoints.camera[mapper.is_inlier], minlength=len(mapper.camera_kind))
    result: Bools = counts > 0
    return result


def heading_change_deg(mapper: Mapper) -> float:
    """Spread of the registered units' forward directions, degrees."""
    forward = mapper.state.unit_rotation[mapper.registered][:, :, 0]
    mean = forward.mean(0) / max(float(np.linalg.norm(forward.mean(0))), 1e-9)
    angles = np.degrees(np.arccos(np.clip(forward @ mean, -1, 1)))
    return float(2 * angles.max())


@dataclass(frozen=True)
class CalibrationDecision:
    """Decision whether `rig_from_cam` may vary, with its reason.

    It is open where cameras are held because units are few: another size of the scene may contradict that.
    """

    free: bool
    reason: str
    is_open: bool = False


def assess_calibration(
    mapper: Mapper, *, free_units: Bools, terms: Sequence[Term], georeferenced: bool, options: SolverOptions
) -> CalibrationDecision:
    """Decide whether the calibration may vary. How long the baselines are, images never tell: their prior does, and
    positions.

    Parameters
    ----------
    free_units, terms, options
        Of the adjustment that would follow; the calibration's own prior is added.
    """
    settings = mapper.config.bundle_adjustment
    if not settings.refine_calibration:
        return CalibrationDecision(False, "held by the settings")
    if not settings.camera_set_adjustment:
        return CalibrationDecision(
            False, "held as given: images that are adjusted on their own have no common calibration"
        )
    if mapper.drive.has_single_camera:
        return CalibrationDecision(False, "a single camera has no calibration to others")
    # Without priors nothing bounds what the drive does not observe, without reassessment nothing takes it back.
    if not (settings.priors and settings.reassessment) and not georeferenced and is_straight(mapper):
        return CalibrationDecision(False, STRAIGHT)
    if has_few_units(mapper):
        problem, _ = mapper.problem(
            free_units,
            free_cameras=np.ones(len(mapper.camera_kind), dtype=np.bool_),
            terms=[calibration_prior(mapper), *terms],
            options=options,
        )
        if not np.isfinite(covariances(problem, problem.state, shared_errors=False).sigma_scale):
            return CalibrationDecision(
                False, "held as given: too few units to tell what freeing it would do", is_open=True
            )
    return CalibrationDecision(
        True, "GNSS makes it observable" if georeferenced else "varies as far as the drive observes it"
    )


def has_few_units(mapper: Mapper) -> bool:
    """True where fewer than MANY_UNITS are registered."""
    return bool(mapper.registered.sum() < MANY_UNITS)


def units_tell_shared_errors(mapper: Mapper) -> bool:
    """True where enough units are registered to tell errors that their observations share."""
    return bool(mapper.registered.sum() >= MIN_UNITS)


def is_straight(mapper: Mapper) -> bool:
    """True where the drive turns too little to correct a calibration that is nearly right: it leaves the scale open."""
    return heading_change_deg(mapper) < mapper.config.bundle_adjustment.min_heading_change_deg


def median_depth_m(mapper: Mapper) -> float:
    """Median distance of points from the units that see them."""
    rows = np.flatnonzero(mapper.is_inlier)
    off_m = mapper.state.points_m[mapper.tracks.of_keypoint[rows]]
    off_m = off_m - mapper.state.unit_position_m[mapper.keypoints.unit[rows]]
    return float(np.median(np.linalg.norm(off_m, axis=1))) if len(rows) else 0.0


def scale_of_baselines(mapper: Mapper) -> tuple[float, float]:
    """Factor by which the baselines would have to grow to be as given, and its standard deviation by their prior.

    A camera that is not where it was given counts as little as its prior lets it.
    """
    prior = calibration_prior(mapper)
    given, current = _about_their_mean(prior.position_m), _about_their_mean(mapper.state.camera_position_m)
    if min(np.linalg.norm(current), np.linalg.norm(given)) ** 2 < MIN_BASELINES_M2:
        return 1.0, np.inf  # cameras in one place have no scale
    information = ((given**2).sum(1) / prior.sigma_translation_m**2).sum()
    weights = prior.weights_of_places(mapper.state)
    # Lengths alone: the images may have turned the baselines, and no turn shrinks or mirrors a scene.
    lengths_m = [
        float(np.sqrt(weights @ ((position_m - np.average(position_m, axis=0, weights=weights)) ** 2).sum(axis=1)))
        for position_m in (mapper.state.camera_position_m, prior.position_m)
    ]
    return lengths_m[1] / lengths_m[0], float(1.0 / np.sqrt(information))


def scale_with_baselines(mapper: Mapper, factor: float) -> None:
    """Scale units, points and cameras about their middle: this changes no image, and adjustment hardly notices it.

    The cameras' mean place in the rig is kept, as the gauge holds it; the units move instead.
    """
    scale_scene(mapper, factor)
    mapper.state.camera_position_m[:] = _scaled_cameras(mapper, factor)


def scale_scene(mapper: Mapper, factor: float) -> None:
    """Scale units and points as `scale_with_baselines` does, and leave the cameras where they are in the rig."""
    state = mapper.state
    centre, mean = state.unit_position_m[mapper.registered].mean(0), state.camera_position_m.mean(0)
    unit_position_m = _scaled_units(mapper, factor)
    state.points_m[:] = centre + factor * (state.points_m - centre)
    mapper.motion.scale(state, factor, mean)
    state.unit_position_m[:] = unit_position_m


def hold_baselines(mapper: Mapper, certainty: Covariances, *, most_behind_px: float) -> None:
    """Give the baselines the length that they have by their prior, unless the scene stays behind by more than that.

    The scene follows as far as it is known by them alone: all of it where images compare both well, as those of a
    stereo pair do, and none of it where positions know the scene's scale better than images compare it with the rig
    [conditional mean of a normal distribution]. A scene that stays behind contradicts its images, unless each camera
    changes as the images want it: its length is then left to the adjustment, in which all of this weighs.
    """
    factor, follows = scale_of_baselines(mapper)[0], _share_of_baselines(mapper, certainty)[0]
    back = factor ** (follows - 1.0)
    if _moves_images_px(mapper, factor * back, factor) <= most_behind_px:
        scale_with_baselines(mapper, factor)
        scale_scene(mapper, back)


def _moves_images_px(mapper: Mapper, scene: float, baselines: float) -> float:
    """Shift of points in images, about, where the scene and the baselines are scaled by these factors."""
    from_mean_m = baselines * np.linalg.norm(_about_their_mean(mapper.state.camera_position_m), axis=1)
    away_m = abs(scene / baselines - 1.0) * float(from_mean_m.max())
    focal_px = float(mapper.state.camera_params[:, :2].mean())
    return float(away_m * focal_px / max(scene * median_depth_m(mapper), 1e-9))


def sigma_scale_of_images(mapper: Mapper, certainty: Covariances) -> float:
    """Standard deviation of the scene's scale, relative, if the baselines' length is known."""
    explained = _share_of_baselines(mapper, certainty)[1]
    return float(np.sqrt(max(certainty.sigma_scale**2 - explained, 0.0)))


def _share_of_baselines(mapper: Mapper, certainty: Covariances) -> tuple[float, float]:
    """Share of a change of the baselines that the scene's scale follows, and the variance of it that this explains.

    One and zero where the covariance does not say it.
    """
    observes = observing_cameras(mapper)
    centred = _about_their_mean(mapper.state.camera_position_m[observes])
    of_camera = np.zeros((len(observes), 6))
    of_camera[observes, 3:] = centred / max(float((centred**2).sum()), MIN_BASELINES_M2)
    length = of_camera.ravel()  # derivative of the baselines' common length, relative
    if certainty.scale_with_calibration.shape != length.shape:
        return 1.0, 0.0
    variance = float(length @ certainty.calibration_of_independent_errors @ length)
    covariance = float(length @ certainty.scale_with_calibration)
    if not (np.isfinite(covariance) and np.isfinite(variance) and variance > 0.0):
        return 1.0, 0.0
    return float(np.clip(covariance / variance, 0.0, 1.0)), covariance**2 / variance


def of_cameras_alone(mapper: Mapper, certainty: Covariances) -> Covariances:
    """The certainty of the cameras' poses among one another; the gauge is as soft as it has to be to be solved."""
    cameras = len(mapper.camera_kind)
    if certainty.calibration.shape != (6 * cameras, 6 * cameras) or not np.isfinite(certainty.calibration).all():
        return certainty
    prior = prior_among_observing_cameras(mapper)
    calibration = prior.without_gauge(certainty.calibration)
    sigma_camera = certainty.sigma_camera.copy()
    sigma_camera[:, :6] = np.sqrt(np.maximum(np.diagonal(calibration), 0.0)).reshape(cameras, 6)
    return replace(
        certainty,
        calibration=calibration,
        calibration_of_independent_errors=prior.without_gauge(certainty.calibration_of_independent_errors),
        scale_with_calibration=prior.without_gauge(certainty.scale_with_calibration),
        sigma_camera=sigma_camera,
    )


def observed_directions(
    mapper: Mapper, certainty: Covariances | None, covariance: Floats | None = None, *, placed: bool
) -> Observability | None:
    """Directions that the drive observes by its certainty, or by another `covariance` of the calibration.

    Parameters
    ----------
    placed
        Whether positions or rough poses place the scene.
    """
    cameras = len(mapper.camera_kind)
    if mapper.drive.has_single_camera or certainty is None or certainty.calibration.shape != (6 * cameras, 6 * cameras):
        return None
    prior = calibration_prior(mapper)
    found = assess_directions(
        certainty.calibration if covariance is None else covariance,
        position_m=mapper.state.camera_position_m,
        sigma_rotation_rad=prior.sigma_rotation_rad,
        sigma_translation_m=prior.sigma_translation_m,
        placed=placed,
        weight=prior.weights_of_places(mapper.state),
        sigma_left=prior.sigmas_left(mapper.state),
    )
    # Of a camera that observes nothing, what the others share is all that a drive knows.
    return replace(found, observed=found.observed & observing_cameras(mapper)[:, None])


def take_calibration(mapper: Mapper, other: Mapper) -> None:
    """Give the mapper's cameras the calibration of another scene of the drive; units and points follow its scale."""
    lengths_m = [np.linalg.norm(_about_their_mean(m.state.camera_position_m)) for m in (mapper, other)]
    if min(lengths_m) ** 2 >= MIN_BASELINES_M2:
        scale_with_baselines(mapper, float(lengths_m[1] / lengths_m[0]))
    mapper.drive, mapper.camera_kind[:] = mapper.drive.with_rig(other.drive.manifest.rig), other.camera_kind
    mapper.state = mapper.state.with_cameras_of(other.state)
    mapper.renew_rays()
    mapper.renew_motion()


def resolve_scale(mapper: Mapper, terms: Sequence[Term]) -> None:
    """Scale the scene with its baselines to where the terms cost least.

    No image changes with that, so priors and positions decide alone. Adjustment comes there slowly if at all: the cost
    is nearly flat along this direction, and where row bands follow the trajectory its derivatives are not exact.
    """

    def cost(log_factor: float) -> float:
        factor = float(np.exp(log_factor))
        units_m, cameras_m = _scaled_units(mapper, factor), _scaled_cameras(mapper, factor)
        state = replace(mapper.state, unit_position_m=units_m, camera_position_m=cameras_m)
        return sum(term.cost(state) for term in terms)

    found = minimize_scalar(cost, bounds=(-SCALE_RANGE, SCALE_RANGE), method="bounded", options={"xatol": 1e-6})
    if found.fun < cost(0.0):
        scale_with_baselines(mapper, float(np.exp(found.x)))


def _scaled_units(mapper: Mapper, factor: float) -> Floats:
    """Positions (u, 3) of units, scaled so that the cameras' mean place in each is scaled about the units' middle."""
    state = mapper.state
    centre = state.unit_position_m[mapper.registered].mean(0)
    # Scaled about the rig's origin the cameras' mean would move by this.
    moved = (factor - 1.0) * state.camera_position_m.mean(0)
    result: Floats = centre + factor * (state.unit_position_m - centre) + state.unit_rotation @ moved
    return result


def _scaled_cameras(mapper: Mapper, factor: float) -> Floats:
    """Positions (c, 3) of cameras in the rig, scaled about their mean."""
    position_m = mapper.state.camera_position_m
    result: Floats = position_m.mean(0) + factor * _about_their_mean(position_m)
    return result


def _about_their_mean(position_m: Floats) -> Floats:
    result: Floats = position_m - position_m.mean(0)
    return result
