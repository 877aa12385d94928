"""Lenses that nobody declared uncertain, and whose errors bend the scene.

Lens models are off by tenths of a pixel, and cameras and units turn by as much to make up for it. On a way that turns,
that adds up from unit to unit, and bends it. One Gauss-Newton step in which all intrinsics vary under their priors says
by how much. Where it looks like more than lenses usually are off by, from as far away as units lie from their middle,
the intrinsics vary as those do that the manifest declares uncertain.

What a vehicle does between two units, which images of other times and rolling shutters show, is interpolated. In a turn
the error of that looks like one of a lens: such drives keep their lenses.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import MAX_UNKNOWNS_FOR_COVARIANCE
from mrasfm_engine.bundle_adjustment.observation_sampling import choose_points
from mrasfm_engine.bundle_adjustment.problem import PLACES_OF_INTRINSICS, UNIT_DOF
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.intrinsics import (
    BEYOND_PRIOR_SIGMAS,
    assess_intrinsics,
    intrinsics_prior,
    problem_of_all_intrinsics,
)
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement_result import Refinement, solver_options, terms_of
from mrasfm_engine.types import Bools, Cancel

# Of those that an adjustment takes of an image: what bends a whole way, these tell as well.
SHARE_OF_OBSERVATIONS = 0.25


def free_bending_lenses(mapper: Mapper, result: Refinement, free_units: Bools, *, cancel: Cancel | None) -> bool:
    """Let the intrinsics of an adjusted scene vary that nobody asked about, if they bend it; whether any do now."""
    if not _are_open(mapper, result):
        return False
    terms, options = terms_of(mapper, result), solver_options(mapper, result)
    problem = problem_of_all_intrinsics(
        mapper,
        intrinsics_prior(mapper),
        free_units=free_units & mapper.registered,
        free_times=result.recalibrated if result.times_vary else None,
        terms=terms,
        options=options,
    )
    if problem.layout.size > MAX_UNKNOWNS_FOR_COVARIANCE or not _bend_px(mapper, problem) > LENS_SIGMA_PX:
        return False
    every = np.ones(len(mapper.camera_kind), dtype=np.bool_)
    decision = assess_intrinsics(mapper, every, free_units=free_units, terms=terms, options=options, cancel=cancel)
    if not decision.free.any():
        return False
    result.intrinsics = decision
    result.absolute.doubted_lever = None  # a bend looks like an antenna that is elsewhere: it is judged anew
    return True


def _are_open(mapper: Mapper, result: Refinement) -> bool:
    """True where all intrinsics are held, for want of a word about them alone."""
    settings = mapper.config.bundle_adjustment
    return (
        result.calibration.free
        and settings.camera_set_adjustment
        and settings.priors
        and settings.reassessment
        and settings.refine_focal is None
        and not result.intrinsics_are_asked
        and not mapper.drive.has_single_camera
        and mapper.state.simultaneous
    )


def _bend_px(mapper: Mapper, problem: Problem) -> float:
    """Displacement of units against one another by how much lenses would change, RMS in pixels.

    As large as it looks from so far away as units lie from their middle.

    Parameters
    ----------
    problem
        In which lenses vary, at a solution in which they do not.
    """
    free = problem.layout.unit_slot >= 0
    an_image = max(round(SHARE_OF_OBSERVATIONS * mapper.config.mapping.pose_observations), 1)
    problem = problem.of_points(choose_points(problem.observations, free, mapper.image_size_px, an_image=an_image))
    system = problem.normal_equations(problem.state, 0.0)
    eliminated = system.eliminate((~(system.matrix_diagonal() > 0.0)).astype(np.float64))
    if eliminated is None or eliminated.cameras is None:
        return 0.0
    known, gradient = eliminated.equations_of_border(system)
    is_lens = np.zeros(len(known), dtype=np.bool_)
    is_lens[: len(eliminated.free)] = np.isin(eliminated.free % problem.layout.camera_dof, PLACES_OF_INTRINSICS)
    step = np.asarray(-np.linalg.solve(known, gradient), dtype=np.float64)
    # The others follow the lenses, and not what the adjustment has left of a step without them.
    moved = known[np.ix_(~is_lens, is_lens)] @ step[is_lens]
    step[~is_lens] = -np.linalg.solve(known[np.ix_(~is_lens, ~is_lens)], moved)
    chi2, parameters = float(step[is_lens] @ (known @ step)[is_lens]), int(is_lens.sum())
    if not chi2 > parameters + BEYOND_PRIOR_SIGMAS * np.sqrt(2.0 * parameters):
        return 0.0  # right lenses would show as much by what keypoints err by
    before_m = problem.state.unit_position_m[free]
    after_m = before_m - (eliminated.coupled @ step).reshape(-1, UNIT_DOF)[:, 3:]
    if not np.isfinite(after_m).all():
        return 0.0
    bend_m = align_similarity(before_m, after_m).apply(after_m) - before_m
    from_middle_m = before_m - before_m.mean(axis=0)
    focal_px = float(mapper.state.camera_params[:, :2].mean())
    return focal_px * float(np.linalg.norm(bend_m) / max(float(np.linalg.norm(from_middle_m)), 1e-9))
