"""Rounds of adjusting everything that varies, between which observations are chosen and priors weighed anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import sigma_factor_of_shared_errors
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.mapping.calibration import has_few_units, resolve_scale
from mrasfm_engine.mapping.georeferencing import BENT
from mrasfm_engine.mapping.given_scale import scale_of_given_rotations
from mrasfm_engine.mapping.inlier_gates import observation_sigma_px
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.moving_objects import drop_moving
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement_result import (
    DECREMENT_TOLERANCE,
    ROUGH_DECREMENT_TOLERANCE,
    Refinement,
    problem_of_all_unknowns,
    solver_options,
    terms_of,
)
from mrasfm_engine.mapping.road import drop_off_road
from mrasfm_engine.mapping.time_offsets import offsets_are_steady, times_may_vary
from mrasfm_engine.mapping.undeclared_lenses import free_bending_lenses
from mrasfm_engine.types import Bools, Cancel, CountProgress

ROUNDS = 2  # of adjusting, triangulating anew and filtering,
MAX_ROUNDS = 6  # and while the weights of positions or time offsets change
MAX_UNBENDING = 6  # adjustments before them while positions contradict the scene's shape,
STRAIGHTENED = 0.7  # and each leaves at most so much of it
# Points that move between their robust weights go on shaking all poses a little: of 600 units the decrement of a step
# stays at 0.2, or 6e-5 an unknown. The last adjustment ends there, at a step of at most one standard deviation of all.
SHAKEN_AN_UNKNOWN, MOST_SHAKEN = 1e-4, 0.5


def adjust_in_rounds(
    mapper: Mapper, result: Refinement, free_units: Bools, *, progress: CountProgress | None, cancel: Cancel | None
) -> None:
    """Adjust, triangulate anew and filter, until the weights of positions and the cameras' time offsets are steady."""
    _rescale(mapper, result, terms_of(mapper, result))
    steady = _unbend(mapper, result, free_units, cancel)
    done, is_last, heard = 0, False, False
    while not is_last:
        result.sigma_px = observation_sigma_px(mapper)
        is_last = done == MAX_ROUNDS - 1 or (done >= ROUNDS - 1 and steady)
        if is_last:
            weigh_shared_errors(mapper, result)
        offset_s = mapper.state.camera_time_offset_s
        adjust(mapper, result, free_units, rough=not is_last, cancel=cancel)
        if done == 0 and free_bending_lenses(mapper, result, free_units, cancel=cancel):
            steady = False  # a bent scene judges nothing
        else:
            steady = reassess_positions(mapper, result) and offsets_are_steady(mapper, offset_s)
            if not heard:
                hear_given_rotations(mapper, result, free_units)
            heard = True
        choose_observations(mapper, result, is_last=is_last)
        done += 1
        if progress is not None:
            progress(min(done, ROUNDS), ROUNDS + 1)
    result.is_steady = steady


def hear_given_rotations(mapper: Mapper, result: Refinement, free_units: Bools) -> None:
    """Let the rotations as given have their say on the scale that images have found by themselves."""
    if not result.calibration.free or result.georeferenced or not reassesses(mapper):
        return
    result.given_scale = scale_of_given_rotations(
        mapper,
        free_units=free_units & mapper.registered,
        free_times=result.recalibrated if result.times_vary else None,
        terms=terms_of(mapper, result),
        options=solver_options(mapper, result),
    )


def weigh_shared_errors(mapper: Mapper, result: Refinement) -> None:
    """Let observations weigh as little beside priors as the errors leave them that they share.

    The residual on given rotations keeps its share against the images.
    """
    if not result.recalibrated.any():
        return
    problem = problem_of_all_unknowns(mapper, result)
    if problem is None:
        return
    result.sigma_factor = sigma_factor_of_shared_errors(problem, problem.state)
    if result.given_scale is not None:
        result.given_scale = replace(result.given_scale, sigma=result.given_scale.sigma * result.sigma_factor)


def choose_observations(mapper: Mapper, result: Refinement, *, is_last: bool) -> None:
    """Take up what fits the adjusted scene, and drop what does not, what moves, and what is off the road's surface.

    Raises
    ------
    ReconstructionError
        Where fewer than two units are left.
    """
    if is_last:
        mapper.readmit()
    else:
        mapper.complete(anew=True)
    observations, points = mapper.filter(mapper.config.mapping.filter_error_px)
    result.observations_dropped += observations
    result.points_dropped += points
    if is_last:
        result.moving = drop_moving(mapper, for_map=True)
        result.points_dropped += mapper.drop_contradicted()
    else:
        mapper.drop(result.moving.tracks)
    if mapper.config.mapping.semantic_triangulation:
        result.road = drop_off_road(mapper, for_map=is_last, before=result.road)
    lost = mapper.drop_unsupported(mapper.config.mapping.min_pnp_inliers)
    result.units_dropped = sorted({*result.units_dropped, *lost.tolist()})
    if mapper.registered.sum() < 2:
        raise ReconstructionError(
            "adjusted together, no two units keep enough of what they observe: images contradict one another, "
            "the rig, or positions",
            remedy="Check the times of images and positions, and rig.cameras.",
            code="contradictory-drive",
        )


def adjust(
    mapper: Mapper,
    result: Refinement,
    free_units: Bools,
    *,
    rough: bool,
    cancel: Cancel | None,
) -> None:
    """Adjust everything that varies, with all priors."""
    terms, options = terms_of(mapper, result), solver_options(mapper, result, rough=rough)
    shaken = min(SHAKEN_AN_UNKNOWN * UNIT_DOF * int((free_units & mapper.registered).sum()), MOST_SHAKEN)
    result.adjustments.append(
        adjust_poses(
            mapper,
            free_units & mapper.registered,
            free_cameras=result.recalibrated | (result.is_of_one_camera and result.intrinsics_vary),
            free_intrinsics=None if result.intrinsics is None else result.intrinsics.free,
            free_times=result.recalibrated if result.times_vary else None,
            terms=terms,
            options=replace(options, decrement_tolerance=max(options.decrement_tolerance, shaken)),
            an_image=mapper.config.mapping.pose_observations if rough else 0,
            cancel=cancel,
        )
    )
    if result.intrinsics_vary:
        mapper.renew_rays()
    _rescale(mapper, result, terms)


def adjust_all_cameras(
    mapper: Mapper, result: Refinement, free_units: Bools, terms: Sequence[Term], *, cancel: Cancel | None
) -> Report:
    """Adjust by some terms with all cameras and their times free under their priors, those that are held as well.

    Scenes of many units have nearly their shape, and end earlier on their way along a flat scale. Few units, which
    take little time, go far.
    """
    tolerance = DECREMENT_TOLERANCE if has_few_units(mapper) else ROUGH_DECREMENT_TOLERANCE
    return adjust_poses(
        mapper,
        free_units & mapper.registered,
        free_cameras=np.ones(len(mapper.camera_kind), dtype=np.bool_),
        free_times=np.full(len(mapper.camera_kind), times_may_vary(mapper)),
        terms=terms,
        options=replace(solver_options(mapper, result), decrement_tolerance=tolerance),
        cancel=cancel,
    )


def _unbend(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> bool:
    """Adjust until positions, of which a bent trajectory contradicts most, agree with it as well as they can.

    They begin with the weight that the bend leaves them; what the adjustment has straightened makes the next more
    certain [graduated non-convexity]. Returns whether their weights are what they were before the last adjustment.
    """
    steady = True
    for _ in range(MAX_UNBENDING if result.georeferenced and reassesses(mapper) else 0):
        assert result.placement is not None
        before = result.placement.noise_factor
        if before < BENT:
            break
        adjust(mapper, result, free_units, rough=True, cancel=cancel)
        steady = reassess_positions(mapper, result)
        if result.placement.noise_factor > STRAIGHTENED * before:
            break
    return steady


def reassess_positions(mapper: Mapper, result: Refinement) -> bool:
    """Judge positions by the adjusted scene; whether their errors have the sizes that they had before."""
    if not (result.absolute.hold_the_frame and reassesses(mapper)):
        return True
    before = result.absolute.errors
    result.absolute.reassess(mapper)
    after = result.absolute.errors
    return len(after) == len(before) and all(a.is_as_large_as(b) for a, b in zip(after, before, strict=True))


def reassesses(mapper: Mapper) -> bool:
    """True where every adjustment judges calibration and positions anew."""
    settings = mapper.config.bundle_adjustment
    return settings.priors and settings.reassessment


def _rescale(mapper: Mapper, result: Refinement, terms: Sequence[Term]) -> None:
    """Let the priors and the positions say the scale, where the calibration and with it the scale may vary."""
    several = not mapper.drive.has_single_camera
    if result.calibration.free and several and terms and mapper.config.bundle_adjustment.camera_set_adjustment:
        resolve_scale(mapper, terms)
