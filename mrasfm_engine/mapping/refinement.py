"""Refinement of the grown reconstruction: georeferencing, the last camera set bundle adjustments, uncertainty."""

from __future__ import annotations

import copy

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import covariances
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.adjustment_rounds import ROUNDS, adjust, adjust_in_rounds, reassesses
from mrasfm_engine.mapping.calibration import (
    FEW_UNITS,
    CalibrationDecision,
    assess_calibration,
    calibration_prior,
    hold_baselines,
    observed_directions,
    scale_of_baselines,
    take_calibration,
    units_tell_shared_errors,
)
from mrasfm_engine.mapping.inlier_gates import observation_sigma_px
from mrasfm_engine.mapping.intrinsics import (
    assess_intrinsics,
    held_intrinsics,
    intrinsics_may_vary,
)
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.miscalibration import (
    MIN_OTHERS,
    find_miscalibrations,
    find_wrong_pair,
)
from mrasfm_engine.mapping.most_likely_size import take_most_likely_size
from mrasfm_engine.mapping.moving_objects import drop_moving
from mrasfm_engine.mapping.other_sizes import parts_of
from mrasfm_engine.mapping.placement import compare_with_rig
from mrasfm_engine.mapping.receiver_findings import contradicts_rig
from mrasfm_engine.mapping.receiver_fit import MIN_POSITIONS
from mrasfm_engine.mapping.refinement_result import (
    Refinement,
    certainty_of,
    free_units_of,
    solver_options,
    systematic_errors_of,
    terms_of,
)
from mrasfm_engine.mapping.refused_positions import compare_positions_again
from mrasfm_engine.mapping.road import road_where_points_are
from mrasfm_engine.mapping.time_offsets import (
    assess_times,
    interpolation_error_s,
    positions_may_tell_time,
    positions_tell_time,
    time_findings,
    time_prior,
    times_may_vary,
)
from mrasfm_engine.mapping.undeclared_times import undeclared_time_findings
from mrasfm_engine.types import Bools, Cancel, CountProgress

OF_THE_LARGEST = "it is that of the drive's largest component"
BOTH_RIGHT_SIGMAS = 2.0  # of the scales by rough poses and by the rig as given, within which both may be right
BEHIND = 0.1  # of an observation's sigma, that a scene may stay behind baselines that are held


def refine(
    mapper: Mapper,
    absolute: AbsolutePriors | None = None,
    *,
    calibrated: Mapper | None = None,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> Refinement:
    """Georeference where positions allow, adjust everything with all priors, and estimate the uncertainty.

    Without positions, rough poses say where the scene lies.

    Parameters
    ----------
    calibrated
        A larger, refined scene of the same drive, whose calibration this one takes.
    """
    result = Refinement(absolute=AbsolutePriors() if absolute is None else absolute)
    _place(mapper, result, calibrated, cancel)
    free_units = free_units_of(mapper, result.absolute)
    result.moving = drop_moving(mapper, for_map=False)
    result.sigma_px = observation_sigma_px(mapper)
    _decide_what_varies(mapper, result, free_units, is_calibrated=calibrated is not None, cancel=cancel)
    adjust_in_rounds(mapper, result, free_units, progress=progress, cancel=cancel)
    result.certainty = certainty_of(mapper, result)
    take_most_likely_size(mapper, result, free_units, cancel=cancel)
    _assess(mapper, result, free_units, cancel)
    if result.placement is not None:
        doubted = result.absolute.doubted_lever
        result.absolute.placement = compare_with_rig(mapper, result.placement, doubted)
        if doubted is not None and result.certainty is not None:
            result.certainty = result.certainty.with_scale_error(abs(doubted.longer))
    if progress is not None:
        progress(ROUNDS + 1, ROUNDS + 1)
    return result


def _place(mapper: Mapper, result: Refinement, calibrated: Mapper | None, cancel: Cancel | None) -> None:
    """Put the scene where positions or rough poses say, and take the calibration of a larger scene, if there is one."""
    absolute = result.absolute
    absolute.place(mapper)
    compares_again = reassesses(mapper) and mapper.config.bundle_adjustment.camera_set_adjustment
    if absolute.positions_are_refused and compares_again and not mapper.drive.has_single_camera:
        compare_positions_again(mapper, result, cancel)
    if calibrated is None:
        absolute.doubt_the_rig(mapper)
    if not result.is_placed and mapper.drive.has_single_camera:
        raise _no_scale_of_one_camera(mapper, result)
    if calibrated is not None:
        take_calibration(mapper, calibrated)
        mapper.complete()


def _no_scale_of_one_camera(mapper: Mapper, result: Refinement) -> ReconstructionError:
    """The error that nothing tells the scale; where the scene has hardly a unit, positions are not what is missing."""
    registered, units = int(mapper.registered.sum()), len(mapper.registered)
    reasons = [] if result.placement is None else [result.placement.reason]
    if result.absolute.rough_fault:
        reasons.append(f"rough poses do not have the shape of the trajectory: {result.absolute.rough_fault}")
    reason = "; ".join(reasons) or "the drive has none that are usable"
    remedy = "Give a second camera with its baseline, or positions along the vehicle's trajectory."
    if registered < MIN_POSITIONS:
        reason = f"images link only {registered} of {units} units, and {MIN_POSITIONS} are needed"
        remedy = "Check that consecutive frames show the same scene, and that images are sharp and not mixed up."
    return ReconstructionError(
        f"one camera tells no scale, and neither GNSS nor rough poses could: {reason}",
        remedy=remedy,
        code="no-metric-scale",
    )


def _decide_what_varies(
    mapper: Mapper, result: Refinement, free_units: Bools, *, is_calibrated: bool, cancel: Cancel | None
) -> None:
    """Decide which of calibration, time offsets and intrinsics vary."""
    if is_calibrated:
        result.calibration = CalibrationDecision(False, OF_THE_LARGEST)
    else:
        result.calibration = assess_calibration(
            mapper,
            free_units=free_units,
            terms=terms_of(mapper, result),
            georeferenced=result.georeferenced,
            options=solver_options(mapper, result),
        )
    result.recalibrated = np.full(len(mapper.camera_kind), result.calibration.free)
    if (
        result.calibration.free
        and not result.georeferenced
        and reassesses(mapper)
        and not units_tell_shared_errors(mapper)
    ):
        _hold_unless_wrong(mapper, free_units, result)
    result.times_vary = result.calibration.free and times_may_vary(mapper)
    if result.times_vary and result.absolute.positions is not None:
        result.mean_time_varies = positions_may_tell_time(mapper, result.absolute.positions)
        result.absolute.clock_varies = result.mean_time_varies
    result.intrinsics = held_intrinsics(mapper)
    asked = intrinsics_may_vary(mapper, calibration_varies=result.calibration.free)
    if not is_calibrated and asked.any():
        result.is_of_one_camera = mapper.drive.has_single_camera
        result.intrinsics = assess_intrinsics(
            mapper,
            asked,
            free_units=free_units,
            terms=terms_of(mapper, result),
            options=solver_options(mapper, result),
            cancel=cancel,
        )


def _assess(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> None:
    """Say how certain everything is, hold what the drive does not observe, and find what is not as it was given."""
    _compare_rough_poses_with_rig(mapper, result)
    result.directions = observed_directions(mapper, result.certainty, placed=result.is_placed)
    result.systematic = systematic_errors_of(mapper, result, free_units)
    mean_time_varied = result.mean_time_varies
    if result.times_vary and result.certainty is not None:
        result.mean_time_varies &= positions_tell_time(mapper, result.certainty)
        prior = time_prior(mapper, mean_varies=result.mean_time_varies)
        offset_s = mapper.state.camera_time_offset_s
        result.times = assess_times(prior, result.certainty, interpolation_error_s(mapper), offset_s)
    if not result.recalibrated.any() or result.directions is None:
        return
    _hold_unobserved(
        mapper,
        result,
        free_units & mapper.registered,
        holds_mean_time=mean_time_varied and not result.mean_time_varies,
        cancel=cancel,
    )
    result.road = road_where_points_are(mapper, result.road)
    if result.times is not None:
        offset_s = mapper.state.camera_time_offset_s
        prior = time_prior(mapper, mean_varies=result.mean_time_varies)
        result.late_cameras = time_findings(mapper.drive, offset_s, prior, result.times)
    if result.calibration.free:
        result.late_cameras += undeclared_time_findings(
            mapper,
            free_units=free_units & mapper.registered,
            terms=terms_of(mapper, result),
            options=solver_options(mapper, result),
            cancel=cancel,
        )
    known = calibration_prior(mapper), mapper.state, result.directions, result.systematic
    result.miscalibrations = find_miscalibrations(*known)
    result.wrong_pair = find_wrong_pair(*known)


def _compare_rough_poses_with_rig(mapper: Mapper, result: Refinement) -> None:
    """Find a scale of rough poses that contradicts the rig; which of both is wrong nothing tells.

    The scene has that of the poses, as its baselines follow them. Where both cannot be right by what is known of them,
    it may be as far off as they differ.
    """
    rough = result.absolute.rough
    if result.georeferenced or rough is None or rough.prior is None or mapper.drive.has_single_camera:
        return
    factor, sigma_rig = scale_of_baselines(mapper)
    if not contradicts_rig(mapper, rough, 1.0 / factor):
        return
    result.scale_of_rough_poses = 1.0 / factor
    if result.certainty is None:
        return
    off = abs(float(np.log(factor)))
    if off > BOTH_RIGHT_SIGMAS * np.hypot(sigma_rig, result.certainty.sigma_scale):
        result.certainty = result.certainty.with_scale_error(off)


def _hold_unless_wrong(mapper: Mapper, free_units: Bools, result: Refinement) -> None:
    """Put cameras back to where they began, but for those that are far off.

    So few units do not tell what their observations err by together, and are far too certain of their cameras.
    """
    problem, _ = mapper.problem(
        free_units,
        free_cameras=np.ones(len(mapper.camera_kind), dtype=np.bool_),
        terms=terms_of(mapper, result),
        options=solver_options(mapper, result),
    )
    found = observed_directions(
        mapper, covariances(problem, problem.state, shared_errors=False), placed=result.is_placed
    )
    wrong = np.zeros_like(result.recalibrated)
    if found is not None:
        wrong[[one.camera for one in find_miscalibrations(calibration_prior(mapper), mapper.state, found)]] = True
    if wrong.any() and (~wrong).sum() < MIN_OTHERS:
        result.calibration = CalibrationDecision(True, "images contradict what was given")
        return
    result.calibration = CalibrationDecision(False, FEW_UNITS, is_open=True)
    result.recalibrated = wrong
    result.as_grown = copy.deepcopy(parts_of(mapper))
    mapper.begin_anew(~wrong)


def _hold_unobserved(
    mapper: Mapper,
    result: Refinement,
    free_units: Bools,
    *,
    holds_mean_time: bool,
    cancel: Cancel | None,
) -> None:
    """Adjust once more with that held as given of which the drive says nothing.

    It would else carry a correction that is mostly noise, and pass for a finding. A direction that shared errors alone
    make uncertain is not held: the adjustment is sure of it, and the whole scene would follow.
    """
    assert result.certainty is not None
    certainty = result.certainty
    weighed = observed_directions(
        mapper, certainty, certainty.calibration_of_independent_errors, placed=result.is_placed
    )
    if weighed is None:
        return
    if result.times is not None:
        result.held_times = result.times.to_hold
    hold_times = result.held_times is not None and (result.held_times.any() or holds_mean_time)
    if weighed.to_hold[result.recalibrated].any() or hold_times:
        result.held = weighed.to_hold
        adjust(mapper, result, free_units, rough=False, cancel=cancel)
    if result.georeferenced and weighed.scale_only_prior:
        hold_baselines(mapper, result.certainty, most_behind_px=BEHIND * result.sigma_px)
