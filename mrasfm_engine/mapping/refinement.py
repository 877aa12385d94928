"""Refinement of the grown reconstruction: georeferencing, the last camera set bundle adjustments, uncertainty."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import covariances
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import (
    FEW_UNITS,
    CalibrationDecision,
    assess_calibration,
    calibration_prior,
    has_few_units,
    hold_baselines,
    observed_directions,
    resolve_scale,
    scale_of_baselines,
    take_calibration,
)
from mrasfm_engine.mapping.georeferencing import BENT
from mrasfm_engine.mapping.given_scale import scale_of_given_rotations
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
from mrasfm_engine.mapping.moving_objects import drop_moving
from mrasfm_engine.mapping.other_sizes import (
    CLEAR_SIGMAS,
    SizedScenes,
    cost_as_found,
    is_another_size,
    parts_of,
    scenes_of_other_sizes,
    size_m,
    with_other_sizes,
)
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.receiver_findings import contradicts_rig
from mrasfm_engine.mapping.refinement_result import (
    DECREMENT_TOLERANCE,
    ROUGH_DECREMENT_TOLERANCE,
    Refinement,
    certainty_of,
    free_units_of,
    solver_options,
    terms_of,
    terms_of_all_cameras,
)
from mrasfm_engine.mapping.refused_positions import compare_positions_again
from mrasfm_engine.mapping.road import drop_off_road, road_where_points_are
from mrasfm_engine.mapping.time_offsets import (
    assess_times,
    interpolation_error_s,
    offsets_are_steady,
    positions_may_tell_time,
    positions_tell_time,
    time_findings,
    time_prior,
    times_may_vary,
)
from mrasfm_engine.types import Bools, Cancel, CountProgress

OF_THE_LARGEST = "it is that of the drive's largest component"
OF_ANOTHER_SIZE = "a scene of another size, with cameras that vary, is clearly more likely"
ROUNDS = 2  # of adjusting, triangulating anew and filtering,
MAX_ROUNDS = 6  # and while the weights of positions or time offsets change
MOST_COMPARISONS = 3  # with other sizes, each from the one that the last has found
MAX_UNBENDING = 6  # adjustments before them while positions contradict the scene's shape,
STRAIGHTENED = 0.7  # and each leaves at most so much of it
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
    result.moving = drop_moving(mapper)
    result.sigma_px = observation_sigma_px(mapper)
    _decide_what_varies(mapper, result, free_units, is_calibrated=calibrated is not None, cancel=cancel)
    _adjust_in_rounds(mapper, result, free_units, progress, cancel)
    result.certainty = certainty_of(mapper, result)
    _compare_with_other_sizes(mapper, result, free_units, cancel)
    _assess(mapper, result, free_units, cancel)
    if progress is not None:
        progress(ROUNDS + 1, ROUNDS + 1)
    return result


def _place(mapper: Mapper, result: Refinement, calibrated: Mapper | None, cancel: Cancel | None) -> None:
    """Put the scene where positions or rough poses say, and take the calibration of a larger scene, if there is one."""
    absolute = result.absolute
    absolute.place(mapper)
    compares_again = _reassesses(mapper) and mapper.config.bundle_adjustment.camera_set_adjustment
    if absolute.positions_are_refused and compares_again and not mapper.drive.has_single_camera:
        compare_positions_again(mapper, result, cancel)
    if calibrated is None:
        absolute.doubt_the_rig(mapper)
    placed = result.georeferenced or result.placed_by_rough_poses
    if not placed and mapper.drive.has_single_camera:
        raise ReconstructionError(
            "one camera tells no scale, and neither GNSS nor rough poses could: "
            + (result.placement.reason if result.placement is not None else "the drive has none that are usable"),
            remedy="Give a second camera with its baseline, or positions along the vehicle's trajectory.",
            code="no-metric-scale",
        )
    if calibrated is not None:
        take_calibration(mapper, calibrated)
        mapper.complete()


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
    if result.calibration.free and not result.georeferenced and _reassesses(mapper) and has_few_units(mapper):
        _hold_unless_wrong(mapper, free_units, result)
    result.times_vary = result.calibration.free and times_may_vary(mapper)
    if result.times_vary and result.absolute.positions is not None:
        result.mean_time_varies = positions_may_tell_time(mapper, result.absolute.positions)
        result.absolute.clock_varies = result.mean_time_varies
    result.intrinsics = held_intrinsics(mapper)
    if not is_calibrated and intrinsics_may_vary(mapper, calibration_varies=result.calibration.free):
        result.is_of_one_camera = mapper.drive.has_single_camera
        result.intrinsics = assess_intrinsics(
            mapper,
            free_units=free_units,
            terms=terms_of(mapper, result),
            options=solver_options(mapper, result),
            cancel=cancel,
        )


def _adjust_in_rounds(
    mapper: Mapper, result: Refinement, free_units: Bools, progress: CountProgress | None, cancel: Cancel | None
) -> None:
    """Adjust, triangulate anew and filter, until the weights of positions and the cameras' time offsets are steady."""
    _rescale(mapper, result, terms_of(mapper, result))
    steady = _unbend(mapper, result, free_units, cancel)
    done, is_last = 0, False
    while not is_last:
        result.sigma_px = observation_sigma_px(mapper)
        is_last = done == MAX_ROUNDS - 1 or (done >= ROUNDS - 1 and steady)
        if is_last:
            _weigh_shared_errors(mapper, result)
        offset_s = mapper.state.camera_time_offset_s
        _adjust(mapper, result, free_units, rough=not is_last, cancel=cancel)
        steady = _reassess(mapper, result) and offsets_are_steady(mapper, offset_s)
        if done == 0:
            _hear_given_rotations(mapper, result, free_units)
        _choose_observations(mapper, result, is_last=is_last)
        done += 1
        if progress is not None:
            progress(min(done, ROUNDS), ROUNDS + 1)


def _hear_given_rotations(mapper: Mapper, result: Refinement, free_units: Bools) -> None:
    """Let the rotations as given have their say on the scale that images have found by themselves."""
    if not result.calibration.free or result.georeferenced or not _reassesses(mapper) or has_few_units(mapper):
        return
    result.given_scale = scale_of_given_rotations(
        mapper,
        free_units=free_units & mapper.registered,
        free_times=result.recalibrated if result.times_vary else None,
        terms=terms_of(mapper, result),
        options=solver_options(mapper, result),
    )


def _weigh_shared_errors(mapper: Mapper, result: Refinement) -> None:
    """Let observations weigh as little beside priors as the errors leave them that they share.

    The residual on given rotations keeps its share against the images.
    """
    if not result.recalibrated.any():
        return
    certainty = certainty_of(mapper, result)
    if certainty is None:
        return
    result.sigma_factor = certainty.sigma_factor
    if result.given_scale is not None:
        result.given_scale = replace(result.given_scale, sigma=result.given_scale.sigma * result.sigma_factor)


def _choose_observations(mapper: Mapper, result: Refinement, *, is_last: bool) -> None:
    """Take up what fits the adjusted scene, and drop what does not, what moves, and what is off the road's surface.

    Raises
    ------
    ReconstructionError
        Where fewer than two units are left.
    """
    if is_last:
        mapper.readmit()
    else:
        mapper.complete()
    observations, points = mapper.filter(mapper.config.mapping.filter_error_px)
    result.observations_dropped += observations
    result.points_dropped += points
    if is_last:
        result.moving = drop_moving(mapper)
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


def _compare_with_other_sizes(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> None:
    """Compare the scene with itself adjusted from other sizes, and take the one that is clearly more likely.

    What was taken is compared again: it may have been on its way. The sizes of the last comparison widen the certainty
    as far as they are likely; they do no more where cameras have to stay as they are.
    """
    if result.georeferenced or mapper.drive.has_single_camera:
        return
    compared: SizedScenes | None = None
    for _ in range(MOST_COMPARISONS):
        scenes = None if result.certainty is None else _scenes_of_other_sizes(mapper, result, free_units, cancel)
        if scenes is None:
            break
        compared = scenes
        if not _is_of_another_size(mapper, result, scenes):
            break
        scenes.take(scenes.likely, mapper)
        _refine_with_all_cameras(mapper, result, free_units, cancel)
    if compared is not None and result.certainty is not None:
        result.certainty = with_other_sizes(mapper, result.certainty, compared)


def _scenes_of_other_sizes(
    mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None
) -> SizedScenes | None:
    """The scene adjusted from several sizes, with all cameras free; None where images know its scale."""
    assert result.certainty is not None
    return scenes_of_other_sizes(
        mapper,
        result.certainty,
        lambda terms: _adjust_all_cameras(mapper, result, free_units, terms, cancel),
        lambda: terms_of_all_cameras(mapper, result),
        solver_options(mapper, result),
        as_grown=result.as_grown,
    )


def _is_of_another_size(mapper: Mapper, result: Refinement, scenes: SizedScenes) -> bool:
    """True where a scene of another size is clearly more likely than the one that was found, and may take its place.

    A scene whose cameras have varied is at a minimum, whose certainty holds the sizes near it. What others cost, errors
    that observations share may decide there.
    """
    assert result.certainty is not None
    if not (result.calibration.free or result.calibration.is_open) or not _reassesses(mapper):
        return False
    near = CLEAR_SIGMAS * result.certainty.sigma_scale if result.calibration.free else 0.0
    if not is_another_size(scenes.size_m[scenes.likely], size_m(mapper), near=near):
        return False
    return scenes.costs[scenes.likely].is_clearly_below(cost_as_found(mapper, solver_options(mapper, result)))


def _refine_with_all_cameras(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> None:
    """Adjust a scene in which all cameras have varied, as the last round does, and choose its observations."""
    if not result.calibration.free:
        result.calibration = CalibrationDecision(True, OF_ANOTHER_SIZE)
    result.recalibrated[:] = True
    result.as_grown = None
    result.times_vary = times_may_vary(mapper)
    result.given_scale, result.sigma_factor = None, 1.0
    result.sigma_px = observation_sigma_px(mapper)
    _hear_given_rotations(mapper, result, free_units)
    _weigh_shared_errors(mapper, result)
    _adjust(mapper, result, free_units, rough=False, cancel=cancel)
    _reassess(mapper, result)
    _choose_observations(mapper, result, is_last=True)
    result.certainty = certainty_of(mapper, result)


def _assess(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> None:
    """Say how certain everything is, hold what the drive does not observe, and find what is not as it was given."""
    _compare_rough_poses_with_rig(mapper, result)
    result.directions = observed_directions(mapper, result.certainty)
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
    known = calibration_prior(mapper), mapper.state, result.directions
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


def _adjust(
    mapper: Mapper,
    result: Refinement,
    free_units: Bools,
    *,
    rough: bool,
    cancel: Cancel | None,
) -> None:
    """Adjust everything that varies, with all priors."""
    terms = terms_of(mapper, result)
    result.adjustments.append(
        adjust_poses(
            mapper,
            free_units & mapper.registered,
            free_cameras=result.recalibrated | (result.is_of_one_camera and result.intrinsics_vary),
            free_intrinsics=None if result.intrinsics is None else result.intrinsics.free,
            free_times=result.recalibrated if result.times_vary else None,
            terms=terms,
            options=solver_options(mapper, result, rough=rough),
            an_image=mapper.config.mapping.pose_observations if rough else 0,
            cancel=cancel,
        )
    )
    if result.intrinsics_vary:
        mapper.renew_rays()
    _rescale(mapper, result, terms)


def _adjust_all_cameras(
    mapper: Mapper, result: Refinement, free_units: Bools, terms: Sequence[Term], cancel: Cancel | None
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
    for _ in range(MAX_UNBENDING if result.georeferenced and _reassesses(mapper) else 0):
        assert result.placement is not None
        before = result.placement.noise_factor
        if before < BENT:
            break
        _adjust(mapper, result, free_units, rough=True, cancel=cancel)
        steady = _reassess(mapper, result)
        if result.placement.noise_factor > STRAIGHTENED * before:
            break
    return steady


def _reassess(mapper: Mapper, result: Refinement) -> bool:
    """Judge positions by the adjusted scene; whether their errors have the sizes that they had before."""
    if not (result.absolute.hold_the_frame and _reassesses(mapper)):
        return True
    before = result.absolute.errors
    result.absolute.reassess(mapper)
    after = result.absolute.errors
    return len(after) == len(before) and all(a.is_as_large_as(b) for a, b in zip(after, before, strict=True))


def _reassesses(mapper: Mapper) -> bool:
    settings = mapper.config.bundle_adjustment
    return settings.priors and settings.reassessment


def _hold_unless_wrong(mapper: Mapper, free_units: Bools, result: Refinement) -> None:
    """Put cameras back to where they began, but for those that are far off.

    So few units do not tell what they err by as a whole.
    """
    problem, _ = mapper.problem(
        free_units,
        free_cameras=np.ones(len(mapper.camera_kind), dtype=np.bool_),
        terms=terms_of(mapper, result),
        options=solver_options(mapper, result),
    )
    found = observed_directions(mapper, covariances(problem, problem.state, shared_errors=False))
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
    weighed = observed_directions(mapper, result.certainty, result.certainty.calibration_of_independent_errors)
    if weighed is None:
        return
    if result.times is not None:
        result.held_times = result.times.to_hold
    hold_times = result.held_times is not None and (result.held_times.any() or holds_mean_time)
    if weighed.to_hold[result.recalibrated].any() or hold_times:
        result.held = weighed.to_hold
        _adjust(mapper, result, free_units, rough=False, cancel=cancel)
    if result.georeferenced and weighed.scale_only_prior:
        hold_baselines(mapper, result.certainty, most_behind_px=BEHIND * result.sigma_px)


def _rescale(mapper: Mapper, result: Refinement, terms: Sequence[Term]) -> None:
    """Let the priors and the positions say the scale, where the calibration and with it the scale may vary."""
    several = not mapper.drive.has_single_camera
    if result.calibration.free and several and terms and mapper.config.bundle_adjustment.camera_set_adjustment:
        resolve_scale(mapper, terms)
