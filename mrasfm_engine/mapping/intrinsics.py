"""Intrinsics of the cameras: their prior, and whether the drive observes them.

Along a straight street a longer focal length, a longer way and a little distortion look nearly alike. An adjustment
that frees the focal length alone lets it take what the lens model leaves, and is very certain of it. So when it is
asked how well the drive knows the focal length, all intrinsics vary under their priors, those that the camera's model
does not have as well: a rectified image is as free of distortion as its calibration was right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import MAX_UNKNOWNS_FOR_COVARIANCE, covariances
from mrasfm_engine.bundle_adjustment.observability_analysis import OBSERVED_RATIO
from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import IntrinsicsPrior, Term
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions
from mrasfm_engine.geometry.camera_model import FISHEYE, manifest_scales, pack_cameras, with_limit
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.rectified_cameras import model_with_distortion, rig_with_models
from mrasfm_engine.types import Bools, Cancel, Floats
from schemas.drive import CAMERA_MODELS, Camera, Rig
from schemas.findings import Finding, warning

FOCAL_FACTOR, DISTORTION = 0, slice(4, INTRINSICS)  # among the intrinsics
BEYOND_PRIOR_SIGMAS = 4.0
HELD_TERMS = ("k3", "k4", "k5", "k6")  # of FULL_OPENCV: no prior of them is known, and k1 and k2 look nearly like them
SIGMA_ASPECT = 5e-4  # of fy over fx: pixels are square
TANGENTIAL_SHARE = 0.2  # of the sigma of radial distortion: lenses are centred better than they are modelled


@dataclass(frozen=True, kw_only=True)
class IntrinsicsDecision:
    """Decision which intrinsics vary.

    Attributes
    ----------
    free
        (cameras, INTRINSICS)
    asked
        (cameras,) whose intrinsics might vary; their focal lengths do if the drive observes them.
    sigma_focal
        (cameras,) what the drive would know of these focal lengths, relative; NaN of the others.
    prior_sigma_focal
        (cameras,) the same by the prior.
    """

    free: Bools
    asked: Bools
    sigma_focal: Floats
    prior_sigma_focal: Floats

    @property
    def distortion_varies(self) -> Bools:
        """Cameras (cameras,) of whose distortion any term is free."""
        return np.asarray(self.free[:, DISTORTION].any(axis=1))

    def findings(self, mapper: Mapper) -> list[Finding]:
        """Focal lengths that the drive does not observe although the settings ask for them, those that left their
        priors, and lenses of which some terms are held while the others vary.
        """
        found = []
        off = np.log(mapper.state.camera_params[:, 0] / pack_cameras(mapper.drive.cameras)[1][:, 0])
        for c, camera in enumerate(mapper.drive.cameras):
            if not self.asked[c]:
                continue
            if not self.free[c, 0] and mapper.config.bundle_adjustment.refine_focal:
                found.append(
                    warning(
                        "focal-not-observed",
                        f"the focal length of camera {camera.name} is held as given: the drive would know it to "
                        f"{self.sigma_focal[c]:.2%}, where its prior says {self.prior_sigma_focal[c]:.2%}",
                        "Give a drive that turns, or leave refine_focal off.",
                    )
                )
            elif self.free[c, 0] and abs(off[c]) > BEYOND_PRIOR_SIGMAS * self.prior_sigma_focal[c]:
                found.append(
                    warning(
                        "focal-beyond-prior",
                        f"the focal length of camera {camera.name} is {off[c]:+.2%} off what is given, "
                        f"{abs(off[c]) / self.prior_sigma_focal[c]:.0f} sigmas of its prior",
                        "Check params and sigma_focal_px of the camera.",
                    )
                )
            if self.free[c, 4] and (held := _held_terms(camera)):
                found.append(
                    warning(
                        "distortion-held",
                        f"{', '.join(held)} of camera {camera.name} are held as given while k1, k2, p1 and p2 vary, "
                        "and sigma_distortion is that of k1 and k2 alone",
                        "Give params with k3 to k6 from a good calibration, or a camera of model OPENCV.",
                    )
                )
        return found


def held_intrinsics(mapper: Mapper) -> IntrinsicsDecision:
    """The decision that all stay as given, for nobody asked."""
    cameras = len(mapper.camera_kind)
    return IntrinsicsDecision(
        free=np.zeros((cameras, INTRINSICS), dtype=np.bool_),
        asked=np.zeros(cameras, dtype=np.bool_),
        sigma_focal=np.full(cameras, np.nan),
        prior_sigma_focal=np.full(cameras, np.nan),
    )


def intrinsics_may_vary(mapper: Mapper, *, calibration_varies: bool) -> Bools:
    """Cameras (cameras,) whose intrinsics the settings let vary: with their places in the rig, or a single one's.

    By default a single camera's, as what is wrong with its lens no other camera takes, and those for which the
    manifest says how well any of them is known.
    """
    settings, is_single = mapper.config.bundle_adjustment, mapper.drive.has_single_camera
    is_free = settings.refine_calibration and settings.priors and settings.camera_set_adjustment
    if not (calibration_varies or (is_single and is_free)):
        return np.zeros(len(mapper.drive.cameras), dtype=np.bool_)
    return np.array([settings.intrinsics_may_vary(c, is_single=is_single) for c in mapper.drive.cameras])


def assess_intrinsics(
    mapper: Mapper,
    asked: Bools,
    *,
    free_units: Bools,
    terms: Sequence[Term],
    options: SolverOptions,
    cancel: Cancel | None = None,
) -> IntrinsicsDecision:
    """Free the intrinsics that the models of cameras have where the drive observes the focal length.

    A focal length that it does not observe is held: along a straight street it is the length of the way. The other
    intrinsics of a camera that is declared uncertain vary under their priors all the same, and those of cameras whose
    lenses bend the way.

    Pinhole cameras have a model with distortion from then on if they are free: what rectified images have left of it
    would else pass for a part of the focal length. Where `refine_focal` asks for all cameras, only a single one has it,
    and those whose intrinsics the manifest declares uncertain.

    Parameters
    ----------
    asked
        Cameras (cameras,) whose intrinsics may vary.
    free_units, terms, options, cancel
        Of the adjustment that would follow, with the calibration's prior; that of the intrinsics is added.
    """
    given = mapper.drive.manifest.rig
    is_single, by_default = mapper.drive.has_single_camera, mapper.config.bundle_adjustment.refine_focal is None
    declared = np.array([camera.declares_intrinsics for camera in given.cameras])
    may_be_distorted = asked & (declared | by_default | is_single)
    others_vary = asked & (declared | (by_default and not is_single))
    take_models(mapper, given, may_be_distorted)
    decision = _decided(mapper, asked, others_vary, free_units=free_units, terms=terms, options=options, cancel=cancel)
    take_models(mapper, given, may_be_distorted & decision.distortion_varies)
    return decision


def _decided(
    mapper: Mapper,
    asked: Bools,
    others_vary: Bools,
    *,
    free_units: Bools,
    terms: Sequence[Term],
    options: SolverOptions,
    cancel: Cancel | None,
) -> IntrinsicsDecision:
    """The decision about cameras whose models have all that may vary.

    `others_vary` are those (cameras,) whose other intrinsics vary where their focal lengths are held as well.
    """
    prior = intrinsics_prior(mapper)
    problem = problem_of_all_intrinsics(mapper, prior, asked, free_units=free_units, terms=terms, options=options)
    if problem.layout.size > MAX_UNKNOWNS_FOR_COVARIANCE:
        return held_intrinsics(mapper)
    # At the solution: residuals of a focal length that is off would pass for errors that its observations share.
    an_image = mapper.config.mapping.pose_observations
    solution, _ = solve_with_chosen_points(problem, mapper.image_size_px, an_image=an_image, cancel=cancel)
    sigma = np.where(asked, covariances(problem, solution).sigma_camera[:, 6], np.nan)
    observed = sigma < OBSERVED_RATIO * prior.sigma[:, 0]
    free = _of_models(mapper) & (observed | others_vary)[:, None]
    free[:, FOCAL_FACTOR] = observed
    return IntrinsicsDecision(
        free=free,
        asked=asked,
        sigma_focal=sigma,
        prior_sigma_focal=prior.sigma[:, 0],
    )


def take_models(mapper: Mapper, given: Rig, with_distortion: Bools) -> None:
    """Give cameras the models of a rig, or where distortion varies (cameras,) those that have terms for it.

    Their present intrinsics are without distortion where the models change.
    """
    models = [
        model_with_distortion(camera.model) if varies else camera.model
        for camera, varies in zip(given.cameras, with_distortion.tolist(), strict=True)
    ]
    mapper.drive = mapper.drive.with_rig(rig_with_models(given, models))
    mapper.camera_kind[:], _ = pack_cameras(mapper.drive.cameras)  # in place: whoever triangulates has it as well
    params = zip(mapper.camera_kind.tolist(), mapper.state.camera_params, strict=True)
    mapper.state = replace(mapper.state, camera_params=np.stack([with_limit(*own) for own in params]))


def problem_of_all_intrinsics(
    mapper: Mapper,
    prior: IntrinsicsPrior,
    which: Bools | None = None,
    *,
    free_units: Bools,
    free_times: Bools | None = None,
    terms: Sequence[Term],
    options: SolverOptions,
) -> Problem:
    """The adjustment in which all cameras vary, and with all their intrinsics, also those that models do not have.

    Parameters
    ----------
    prior
        Of the intrinsics, beside the other `terms`.
    which
        Cameras (cameras,) whose intrinsics vary; all of them by default.
    """
    every = np.ones(len(mapper.camera_kind), dtype=np.bool_)
    problem, _ = mapper.problem(
        free_units,
        free_cameras=every,
        free_intrinsics=np.repeat((every if which is None else which)[:, None], INTRINSICS, axis=1),
        free_times=free_times,
        terms=[*terms, prior],
        options=options,
    )
    return problem


def intrinsics_prior(mapper: Mapper) -> IntrinsicsPrior:
    """The prior of all cameras' intrinsics from the manifest's sigmas, or the default ones."""
    settings = mapper.config.bundle_adjustment
    _, params = pack_cameras(mapper.drive.cameras)
    sigma = np.empty((len(params), INTRINSICS))
    for c, camera in enumerate(mapper.drive.cameras):
        focal_px = params[c, 0]
        # Of a MEI camera the manifest's focal length is another one than that at the axis.
        given = camera.sigma_focal_px
        sigma[c, 0] = settings.sigma_focal if given is None else given / camera.params[0]
        sigma[c, 1] = SIGMA_ASPECT
        sigma[c, 2:4] = camera.sigma_principal_point_px or settings.sigma_principal_point * focal_px
        sigma[c, 4:] = camera.sigma_distortion or settings.sigma_distortion
        sigma[c, 4:] /= manifest_scales(int(mapper.camera_kind[c]), params[c])[4:]
        if mapper.camera_kind[c] != FISHEYE:
            sigma[c, 6:] *= TANGENTIAL_SHARE
    return IntrinsicsPrior(params=params, sigma=sigma)


def _held_terms(camera: Camera) -> list[str]:
    """Names of the camera's terms of distortion that are not zero and never vary."""
    if camera.model != "FULL_OPENCV":
        return []
    values = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    return [name for name in HELD_TERMS if values[name] != 0.0]


def _of_models(mapper: Mapper) -> Bools:
    """Intrinsics (cameras, INTRINSICS) that the cameras' models have."""
    result = np.zeros((len(mapper.camera_kind), INTRINSICS), dtype=np.bool_)
    for c, camera in enumerate(mapper.drive.cameras):
        names = CAMERA_MODELS[camera.model]
        focal, distortion = (sum(name[0] in begins for name in names) for begins in ("f", "kp"))
        result[c, [0, 2, 3]] = True
        result[c, 1] = focal == 2
        result[c, 4 : 4 + distortion] = True
    return result
