"""The incremental loop: register the next unit, triangulate, adjust locally, now and then globally."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.solver import Report, SolverOptions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.baseline_without_rig import register_images_singly, retry_missing, take_over
from mrasfm_engine.mapping.calibration import (
    assess_calibration,
    calibration_prior,
    has_few_units,
    resolve_scale,
    scale_of_baselines,
    scale_with_baselines,
)
from mrasfm_engine.mapping.dynamic_objects import find_moving_along, units_to_doubt, without_keypoints
from mrasfm_engine.mapping.given_scale import turned_px
from mrasfm_engine.mapping.initialization import Initialisation, initialise
from mrasfm_engine.mapping.keyframes import select_keyframes
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX
from mrasfm_engine.mapping.loop_closure import close_loops, find_revisits
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.places_alike import SoundPairs
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.road import RoadAssessment, drop_off_road
from mrasfm_engine.mapping.static_images import find_still_keypoints
from mrasfm_engine.mapping.unit_registration import Registration, register_unit
from mrasfm_engine.matching.motion_of_cameras import motion_contradiction
from mrasfm_engine.matching.relative_pose import UncertainRig
from mrasfm_engine.matching.simultaneous import calibration_sigmas, verified_again
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints, build_tracks
from mrasfm_engine.types import Bools, Cancel, CountProgress, Floats, Ints
from schemas.findings import Finding

LOCAL_TOLERANCE = 1e-3
GLOBAL_TOLERANCE = 1e-4
DECREMENT_TOLERANCE = 0.1  # while the scene grows: less than half a standard deviation


@dataclass(kw_only=True)
class MappingLog:
    """Log of incremental mapping."""

    absolute: AbsolutePriors = field(default_factory=AbsolutePriors)
    initialisation: Initialisation | None = None
    registrations: list[Registration] = field(default_factory=list)
    failures: dict[int, Registration] = field(default_factory=dict)  # by unit, the last attempt
    calibration_free: bool = False  # whether global adjustments vary rig_from_cam
    calibration_held: bool = False  # whether they never do, as a larger part of the drive tells it better
    local_adjustments: int = 0
    global_adjustments: list[Report] = field(default_factory=list)
    roads: list[RoadAssessment | str] = field(default_factory=list)  # after each of them; why there is none
    revisits_tried: int = 0  # pairs of units across a gap that were compared
    revisits: list[tuple[int, int]] = field(default_factory=list)  # those that were believed
    loop_moved_m: float = 0.0  # by how much closing the loops moved a unit at most
    verified_again: bool = False  # whether matches within units were judged anew, by a calibration that had moved
    contradiction: Finding | None = None  # of the calibration as given by how the cameras move
    alike: SoundPairs | None = None  # of the drive, what became of pairs where places look alike
    covered_images: dict[int, float] = field(default_factory=dict)  # by image, the share of keypoints that move along


def run_incremental_mapping(
    mapper: Mapper,
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    *,
    absolute: AbsolutePriors | None = None,
    calibration_held: bool = False,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> MappingLog:
    """Register as many units as possible, beginning with the best-connected two.

    Positions and rough poses of `absolute` take part in its adjustments; the calibration does not, if it is held.

    Raises
    ------
    ReconstructionError
        Where the scene cannot even begin.
    CancelledError
        Where `cancel` answers True.
    """
    log = MappingLog(absolute=AbsolutePriors() if absolute is None else absolute, calibration_held=calibration_held)
    log.initialisation = initialise(mapper, pairs, prior_world_from_rig)
    adjust_globally(mapper, log, cancel)
    register_remaining(mapper, log, progress=progress, cancel=cancel)
    return log


def register_remaining(
    mapper: Mapper,
    log: MappingLog,
    *,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> None:
    """Register what can be registered of the keyframes that have no pose yet."""
    config, since_local, at_global = mapper.config, 0, int(mapper.registered.sum())
    while not mapper.registered[mapper.keyframe].all():
        if cancel is not None and cancel():
            raise CancelledError
        registration = _register_next(mapper, log)
        if registration is None:
            break
        log.registrations.append(registration)
        mapper.extend(registration.unit)
        since_local += 1
        if mapper.registered.sum() >= at_global * (1 + config.mapping.global_growth):
            adjust_globally(mapper, log, cancel)
            at_global, since_local = int(mapper.registered.sum()), 0
        elif since_local >= config.mapping.local_every:
            _adjust_locally(mapper, registration.unit, log.absolute)
            log.local_adjustments += 1
            since_local = 0
        if progress is not None:
            progress(int(mapper.registered.sum()), int(mapper.keyframe.sum()))
    if not config.mapping.camera_set_registration:
        retry_missing(mapper)


def mapper_of_drive(
    drive: Drive,
    keypoints: Keypoints,
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    config: EngineConfig,
) -> tuple[Mapper, Bools, Finding | None]:
    """The mapper of a drive of which nothing is registered yet, with tracks of pairs of units that follow one another.

    Also the keypoints (k,) that stand still in the image while the car moves, which its tracks do without, and what the
    cameras' motions have against the calibration as given.
    """
    image_unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    image_camera = np.array([image.camera for image in drive.images], dtype=np.int64)
    still = find_still_keypoints(keypoints, image_unit, image_camera, drive.rig_from_cam, pairs)
    sound = without_keypoints(pairs, keypoints.first, still) if still.any() else pairs
    mapper = Mapper(drive, keypoints, build_tracks(keypoints, sound), config)
    contradiction = None
    if config.bundle_adjustment.reassessment:
        by_motion = mapper.correct_calibration(sound)
        contradiction = motion_contradiction([camera.name for camera in drive.cameras], drive.rig_from_cam, by_motion)
    mapper.keyframe = select_keyframes(mapper)
    if prior_world_from_rig is not None:
        mapper.motion.follow_prior(prior_world_from_rig)
    return mapper, still, contradiction


def cleaned_and_closed(
    mapper: Mapper,
    log: MappingLog,
    near: Sequence[PairMatches],
    far: Sequence[PairMatches],
    still: Bools,
    *,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> Mapper:
    """The grown scene without what moves along, and with its loops closed.

    Parameters
    ----------
    near, far
        Pairs of units that follow one another, and of those that may be revisits.
    still
        Keypoints (k,) that stand still in the image while the car moves.
    """
    first = mapper.keypoints.first
    again = _verified_again(mapper, list(near), cancel)
    if again is not None:
        near, log.verified_again = again, True
        sound = without_keypoints(near, first, still) if still.any() else near
        mapper = with_tracks_of(mapper, sound)
    # Only the poses of all cameras together separate dynamic objects reliably, so mapping comes before the cleaning.
    moving = find_moving_along(mapper, near)
    if moving.any:
        log.covered_images = {int(i): float(moving.share[i]) for i in np.flatnonzero(moving.covered)}
        near, far = (without_keypoints(p, first, moving.keypoint) for p in (near, far))
        doubt = units_to_doubt(mapper, moving, still)
        mapper = _registered_anew(mapper, near, doubt, log, progress, cancel)
    revisits, log.revisits_tried = find_revisits(mapper, far)
    if not revisits:
        return mapper
    log.revisits = [(r.earlier, r.later) for r in revisits]
    log.loop_moved_m = close_loops(mapper, revisits)
    # Tracks anew, now with the matches across the loop that were believed, and points from the moved units.
    believed, unit = set(log.revisits), mapper.image_unit
    across = [p for p in far if (*sorted((int(unit[p.image_a]), int(unit[p.image_b]))),) in believed]
    closed = with_tracks_of(mapper, [*near, *across])
    adjust_globally(closed, log, cancel)
    return closed


def _verified_again(mapper: Mapper, pairs: list[PairMatches], cancel: Cancel | None) -> list[PairMatches] | None:
    """The pairs with matches of simultaneous images judged by the calibration as it is now; None, if it stayed.

    It stayed where no camera has turned against another by more than an inlier may be off.
    """
    focal_px = mapper.state.camera_params[:, :2].mean(axis=1)
    if turned_px(mapper) < mapper.config.matching.max_error_px:
        return None
    sigma = np.empty((len(focal_px), 6))
    sigma[:, :3] = LENS_SIGMA_PX / focal_px[:, None]  # what an adjustment may still be off by
    sigma[:, 3:] = calibration_sigmas(mapper.drive, mapper.config.bundle_adjustment)[1][:, None]
    rig = UncertainRig(rig_from_cam=mapper.state.rig_from_cam, covariance=np.diag(sigma.ravel() ** 2))
    return verified_again(
        mapper.drive, pairs, mapper.rays_of, rig, focal_px=focal_px, config=mapper.config.matching, cancel=cancel
    )


def _registered_anew(
    mapper: Mapper,
    pairs: Sequence[PairMatches],
    units: Ints,
    log: MappingLog,
    progress: CountProgress | None,
    cancel: Cancel | None,
) -> Mapper:
    """The scene with tracks from other matches, in which some units find their pose anew; else they keep it."""
    before = mapper.state.world_from_rig
    mapper.forget(units)
    mapper = with_tracks_of(mapper, pairs)
    register_remaining(mapper, log, progress=progress, cancel=cancel)
    # Where the units around have no pose either, there is nothing to register against: rather an old pose than none.
    lost = units[~mapper.registered[units]]
    for unit in lost:
        mapper.set_pose(int(unit), before[unit])
        log.failures.pop(int(unit), None)
    if len(lost):
        mapper.renew_motion()
        mapper.triangulate()
    adjust_globally(mapper, log, cancel)
    return mapper


def with_tracks_of(mapper: Mapper, pairs: Sequence[PairMatches]) -> Mapper:
    """The mapper's poses and calibration with tracks from other matches, and points from these."""
    result = Mapper(mapper.drive, mapper.keypoints, build_tracks(mapper.keypoints, pairs), mapper.config)
    result.state = replace(mapper.state, points_m=result.state.points_m)
    result.registered, result.missing, result.motion = mapper.registered, mapper.missing, mapper.motion
    result.keyframe, result.rig_as_begun = mapper.keyframe, mapper.rig_as_begun
    result.renew_motion()
    result.triangulate()
    return result


def _register_next(mapper: Mapper, log: MappingLog) -> Registration | None:
    """Register the unit whose images are covered best by points; units that failed wait until they see more."""
    counts = mapper.visible_counts()
    waiting = np.flatnonzero(~mapper.registered & mapper.keyframe & (counts >= mapper.config.mapping.min_pnp_inliers))
    scores = np.array([mapper.visibility_score(unit) for unit in waiting.tolist()])
    for unit in waiting[np.argsort(-scores, kind="stable")].tolist():
        failed = log.failures.get(unit)
        if failed is not None and counts[unit] < 1.2 * failed.correspondences:
            continue
        mapper.motion.predict(mapper.state, mapper.registered, unit)
        register = register_unit if mapper.config.mapping.camera_set_registration else register_images_singly
        registration = register(mapper, unit)
        if registration.world_from_rig is not None:
            log.failures.pop(unit, None)
            mapper.set_pose(unit, registration.world_from_rig)
            mapper.renew_motion(np.array([unit]))
            take_over(mapper, registration)
            return registration
        log.failures[unit] = registration
    return None


def _adjust_locally(mapper: Mapper, unit: int, absolute: AbsolutePriors) -> None:
    """Adjust a new unit and those it shares most points with; all other units and the calibration stay."""
    tracks = mapper.tracks_of_units(np.array([unit]))
    rows = mapper.observation_rows(tracks[mapper.triangulated[tracks]])
    shared = np.bincount(mapper.keypoints.unit[rows], minlength=len(mapper.registered))
    shared[unit] = np.iinfo(np.int64).max
    best = np.argsort(-shared, kind="stable")[: mapper.config.mapping.local_units]
    free = np.zeros(len(mapper.registered), dtype=np.bool_)
    free[best[shared[best] > 0]] = True
    free &= mapper.registered
    # Without a fixed unit the gauge is loose: hold the one that shares least.
    if (free == mapper.registered).all():
        free[best[free[best]][-1]] = False
    adjust_poses(
        mapper,
        free,
        terms=absolute.local_terms(mapper, free),
        options=SolverOptions(
            max_iterations=10,
            function_tolerance=LOCAL_TOLERANCE,
            decrement_tolerance=DECREMENT_TOLERANCE,
            expects_rest=not has_few_units(mapper),
            loss_scale=mapper.config.bundle_adjustment.loss_scale,
            threads=mapper.config.threads,
        ),
        an_image=mapper.config.mapping.pose_observations,
    )


def adjust_globally(mapper: Mapper, log: MappingLog, cancel: Cancel | None) -> None:
    """Adjust all units, the calibration where it is observed, and all points; then triangulate anew and filter.

    Once: the next adjustment is near while the scene grows, and the refinement when it has.
    """
    log.absolute.renew(mapper)
    free_units = mapper.registered.copy()
    if not log.absolute.hold_the_frame:
        free_units[np.flatnonzero(mapper.registered)[0]] = False
    options = SolverOptions(
        max_iterations=20,
        function_tolerance=GLOBAL_TOLERANCE,
        decrement_tolerance=DECREMENT_TOLERANCE,
        expects_rest=not has_few_units(mapper),
        loss_scale=mapper.config.bundle_adjustment.loss_scale,
        threads=mapper.config.threads,
    )
    terms = log.absolute.terms(mapper)
    # Once a part of the drive observes the calibration, more of it does so all the more.
    log.calibration_free = not log.calibration_held and (
        log.calibration_free
        or assess_calibration(
            mapper, free_units=free_units, terms=terms, georeferenced=bool(terms), options=options
        ).free
    )
    free, priors = log.calibration_free, mapper.config.bundle_adjustment.priors
    if free and priors:
        terms = [calibration_prior(mapper), *terms]
    report = adjust_poses(
        mapper,
        free_units,
        free_cameras=np.full(len(mapper.camera_kind), free),
        terms=terms,
        options=options,
        an_image=mapper.config.mapping.pose_observations,
        cancel=cancel,
    )
    log.global_adjustments.append(report)
    if free and priors:
        # Scale is a direction in which the cost hardly changes: over many adjustments it would wander off.
        if log.absolute.hold_the_frame:
            resolve_scale(mapper, terms)
        else:
            scale_with_baselines(mapper, scale_of_baselines(mapper)[0])
    mapper.complete()  # filters, too
    if mapper.config.mapping.semantic_triangulation:
        log.roads.append(drop_off_road(mapper, before=log.roads[-1] if log.roads else None))
