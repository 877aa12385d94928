"""Scale by the given rotations of the cameras, weighed against the scale by the drive's images.

Two cameras that are turned against each other by a little see all points nearer or farther: along a straight street
that looks like another scale, and only lens models, which err by the same in all images, tell the two apart. A turn
tells them apart much better. No residual shows errors of lens models, so an adjustment is far too certain of the scale.

With x the corrections of the cameras' rotations and l the errors of the lens models, the adjustment finds the scale

    s = a'x   with the rotations as given, whose errors x are those of a calibration
    s = b'l   with the rotations as it finds them

Both are estimates of one scale, and it is best known by their mean with the weights of their variances. How far the
drive moves cameras in other directions says how good the given rotations are. Every other direction of the calibration
stays free: one residual a'x on the rotations is added, which asks for what the mean comes to. It does not ask for the
rotations as given, with less weight: far from there the images' robust loss tears, and a scene shrinks without end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit, gammaln

from mrasfm_engine.bundle_adjustment.marginal_covariances import scale_functional
from mrasfm_engine.bundle_adjustment.priors import IntrinsicsPrior, ScalePrior, Term
from mrasfm_engine.bundle_adjustment.problem import PLACES_OF_INTRINSICS
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.intrinsics import problem_of_all_intrinsics
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX, lens_sigmas
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Floats

# Rotations are means over whole images of what lens models leave: about as many independent errors as parameters.
PATTERNS = 10
ROTATION_SIGMA_PX = LENS_SIGMA_PX / np.sqrt(PATTERNS)
MEASURED_RANGE = 100.0  # the largest errors of rotations that no calibration found, over those of one
CONTRADICTED_SIGMAS = 3.0
LEAST_SHARE = 0.1  # in the mean: with less it changes little, but would hold images that have not found their scale
# Of the images' variance, that the residual leaves at least. The mean comes out the same with any; with next to none
# the normal equations would keep few digits of what the cameras do with it.
LEAST_PULL = 1e-4
RIDGE = 1e-9


def scale_of_given_rotations(
    mapper: Mapper, *, free_units: Bools, free_times: Bools | None, terms: Sequence[Term], options: SolverOptions
) -> ScalePrior | None:
    """The residual on the rotations; None where images say nothing of the scale, or rotations nothing.

    Parameters
    ----------
    free_units, free_times, terms, options
        Of the adjustment that follows, with the calibration's prior.
    """
    cameras = len(mapper.camera_kind)
    lens = _over_keypoints(mapper)
    nuisance = IntrinsicsPrior(params=mapper.state.camera_params, sigma=lens)
    problem = problem_of_all_intrinsics(
        mapper,
        nuisance,
        free_units=free_units,
        free_times=free_times,
        terms=terms,
        options=options,
    )
    system = problem.normal_equations(problem.state, 0.0)
    eliminated = system.eliminate(np.zeros(len(system.gradient)))
    if eliminated is None or eliminated.cameras is None:
        return None
    functional = scale_functional(problem.state.unit_position_m[problem.layout.unit_slot >= 0])
    by_border = -(eliminated.coupled.T @ functional)[: len(eliminated.free)]  # of the scale, if nothing else varies
    place = eliminated.free % problem.layout.camera_dof
    of_lens, of_rotation = np.isin(place, PLACES_OF_INTRINSICS), place < 3
    of_rest, of_rig = ~of_lens & ~of_rotation, ~of_lens
    known = eliminated.equations_of_border(system)[0][: len(place), : len(place)]
    known = known + RIDGE * np.diag(np.diagonal(known))

    def if_varied(chosen: Bools, others: Bools) -> Floats:
        """Derivatives of the scale by some unknowns of the border, while others are at their best for each value."""
        between = known[np.ix_(chosen, others)]
        result: Floats = by_border[chosen] - between @ np.linalg.solve(known[np.ix_(others, others)], by_border[others])
        return result

    by_lens, by_rotation = if_varied(of_lens, of_rig), if_varied(of_rotation, of_rest).reshape(cameras, 3)
    moved_px, by_px = _moved_px(mapper), by_rotation / mapper.state.camera_params[:, :2].mean(axis=1)[:, None]
    of_given = float(np.linalg.norm(by_px)) * _rotation_sigma_px(moved_px, by_px)
    of_free = float(np.linalg.norm(by_lens * lens.ravel()))
    along = np.zeros(int(of_rig.sum()))
    along[of_rotation[of_rig]] = by_rotation.ravel()
    as_weighed = np.sqrt(float(along @ np.linalg.solve(known[np.ix_(of_rig, of_rig)], along)))
    if not (of_given > 0.0 and of_free > 0.0 and as_weighed > 0.0):
        return None
    images_alone = ScalePrior(
        rotation=mapper.rig_as_begun[:, :3, :3],
        scale_by_rotation=by_rotation,
        log_scale=0.0,
        sigma=np.inf,
        sigma_scale=of_free,
        sigma_of_corrections=0.0,
        share=0.0,
    )
    found = images_alone.log_scale_of(mapper.state)
    # What contradicts the images by many sigmas is no estimate of the same scale [Geman and McClure's weight].
    trusted = 1.0 / (1.0 + (found / np.hypot(of_given, of_free) / CONTRADICTED_SIGMAS) ** 2)
    ratio2 = (of_given / of_free / trusted) ** 2  # of their variances
    share = 1.0 / (1.0 + ratio2)
    if share < LEAST_SHARE:
        return images_alone
    # Images pull back with their own weight. Those that hardly resist go no farther than twice the way.
    pull = float(np.clip(ratio2, LEAST_PULL, 1.0))
    return replace(
        images_alone,
        log_scale=found * (1.0 - share * (1.0 + pull)),
        sigma=float(as_weighed * np.sqrt(pull)),
        sigma_scale=float(np.hypot(share * of_given, (1.0 - share) * of_free)),
        sigma_of_corrections=share * of_given,
        share=share,
    )


def _moved_px(mapper: Mapper) -> Floats:
    """Turns (c, 3) of the cameras from where they began against one another, in pixels at the images' centres."""
    given = mapper.rig_as_begun[:, :3, :3]
    moved = se3.log_so3(mapper.state.camera_rotation @ np.swapaxes(given, 1, 2))
    moved = moved * mapper.state.camera_params[:, :2].mean(axis=1)[:, None]
    result: Floats = moved - (np.median(moved, axis=0) if len(moved) > 2 else moved.mean(axis=0))
    return result


def turned_px(mapper: Mapper) -> float:
    """Largest angle by which the drive has turned two cameras against one another, in pixels."""
    moved = _moved_px(mapper)
    return float(np.linalg.norm(moved[:, None] - moved[None], axis=2).max())


def _rotation_sigma_px(moved_px: Floats, by_rotation: Floats) -> float:
    """Standard deviation of the given rotations by how far the drive turns them (c, 3) otherwise than along one way.

    Either a calibration found them, and they err by what is usual, which as many independent errors tell as a lens
    model has parameters; or somebody measured them, and they err by any size up to `MEASURED_RANGE` times as much, each
    as probable. Both are as probable before the drive says anything.
    """
    along = by_rotation / max(float(np.linalg.norm(by_rotation)), 1e-30)
    other = moved_px - along * (along * moved_px).sum()
    counted = max(3 * (len(moved_px) - 1) - 1, 1)
    usual2, found2 = ROTATION_SIGMA_PX**2, float((other**2).sum())
    measured2 = max(found2 / counted, usual2)
    # Logarithms of how probable it is to find that, without what both have in common.
    if_calibrated = (
        gammaln((PATTERNS + counted) / 2)
        - gammaln(PATTERNS / 2)
        - counted / 2 * np.log(PATTERNS * usual2)
        - (PATTERNS + counted) / 2 * np.log1p(found2 / (PATTERNS * usual2))
    )
    if_measured = gammaln(counted / 2) - counted / 2 * np.log(counted * measured2) - np.log(2 * np.log(MEASURED_RANGE))
    calibrated2 = (PATTERNS * usual2 + found2) / (PATTERNS + counted)
    return float(np.sqrt(measured2 + expit(if_calibrated - if_measured) * (calibrated2 - measured2)))


def _over_keypoints(mapper: Mapper) -> Floats:
    """Usual sigmas (c, INTRINSICS) of lens parameters by where the drive's images show anything."""
    keypoints, state = mapper.keypoints, mapper.state
    by_camera = [keypoints.camera == c for c in range(len(mapper.camera_kind))]
    cameras = zip(mapper.camera_kind.tolist(), state.camera_params, by_camera, strict=True)
    return np.stack([lens_sigmas(k, p, keypoints.xy_px[own], keypoints.rays[own]) for k, p, own in cameras])
