"""Report of mapping and refinement, in plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.geometry.camera_model import unpack_camera
from mrasfm_engine.mapping import gaps, rig_motion
from mrasfm_engine.mapping.calibration import heading_change_deg
from mrasfm_engine.mapping.incremental_mapping import MappingLog
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.miscalibration import voted_out
from mrasfm_engine.mapping.moving_objects import REASONS, MovingTracks
from mrasfm_engine.mapping.receiver_fit import Placement
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.road import RoadAssessment
from mrasfm_engine.mapping.unit_registration import MIN_CAMERA_INLIER_RATIO, MIN_CAMERA_MATCHES, Registration
from mrasfm_engine.scene.road import RoadSource
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.types import Bools, Ints
from schemas.findings import Finding, listed, warning

# At two sigmas of more a lane of 3.5 m is a third of a metre wider or narrower, and is taken for another kind of lane.
MAX_SIGMA_SCALE = 0.05

# What covers a camera for as long is no lorry beside the vehicle.
MOST_IMAGES, MIN_UNITS_AGAINST = 0.75, 5

DIRECTIONS = tuple(f"{kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz")


def describe(mapper: Mapper, log: MappingLog, others: Sequence[Mapper] = ()) -> dict[str, Any]:
    """Counts of the incremental loop, and what was rejected and why.

    Units that `others` have registered, components of the same drive, are not missing.
    """
    frames = mapper.drive.manifest.frames
    covered, poor = _covered(mapper, log), _poorly_seen(mapper)
    unclear = Counter(name for r in log.registrations for name in r.unclear)
    start = log.initialisation
    known = np.any([mapper.registered, *(other.registered for other in others)], axis=0)
    keypoints = np.bincount(mapper.keypoints.unit, minlength=len(frames))
    missing = [
        {
            "unit": int(u),
            "source_frame": frames[u].source_frame,
            "reason": _why_missing(mapper, log, int(u), int(keypoints[u])),
        }
        for u in np.flatnonzero(~known & mapper.keyframe)
    ]
    return {
        "initial_units": None if start is None else list(start.units),
        "initial_pose_from": None if start is None else start.method,
        "registered_units": int(mapper.registered.sum()),
        "units_not_registered": missing,
        "units_without_motion": int((~mapper.keyframe).sum()),
        "registered_by": dict(Counter(r.method for r in log.registrations)),
        "cameras_voted_out": voted_out(log.registrations, {image["unit"] for image in covered}),
        "cameras_without_a_vote": dict(unclear),
        "images_occluded": covered,
        "images_posed_by_their_unit_alone": poor,
        "images_dark_or_without_texture": [file for file in poor if file not in {image["file"] for image in covered}],
        "tracks": len(mapper.tracks),
        "points": int(mapper.triangulated.sum()),
        "observations": int(mapper.is_inlier.sum()),
        "revisits": {
            "unit_pairs_tried": log.revisits_tried,
            "unit_pairs_believed": len(log.revisits),
            "moved_at_most_m": log.loop_moved_m,
        },
        "matches_within_units_verified_again": log.verified_again,
        "places_alike": _places_alike(log),
        "local_adjustments": log.local_adjustments,
        "global_adjustments": [_adjustment(r) for r in log.global_adjustments],
        "road_points_dropped": [0 if isinstance(j, str) else int((~j.is_inlier).sum()) for j in log.roads],
    }


def _places_alike(log: MappingLog) -> dict[str, Any] | None:
    """Runs of units around which places look alike, and pairs of images that this rests on; None without any."""
    if log.alike is None or not log.alike.alike.any():
        return None
    return {
        "spans": [list(span) for span in gaps.spans(log.alike.alike)],
        "pairs_with_known_direction": log.alike.told,
        "pairs_against_it": log.alike.turned,
        "pairs_set_aside": len(log.alike.set_aside),
    }


def places_alike_findings(mapper: Mapper, log: MappingLog) -> list[Finding]:
    """The finding on places that look alike."""
    if log.alike is None or not log.alike.alike.any():
        return []
    where = gaps.in_words(mapper.drive, gaps.spans(log.alike.alike))
    return [
        warning(
            "places-alike",
            f"places look alike in {where}, as facades do that repeat: of {log.alike.told} pairs of images that others "
            f"lie between, {log.alike.turned} show the camera moving the other way",
            "The scene rests on images there that follow one another, and does without "
            f"{len(log.alike.set_aside)} other pairs. Where frames are half a period apart or more, it may be wrong "
            "all the same: look at the trajectory in report.html.",
        )
    ]


def _why_missing(mapper: Mapper, log: MappingLog, unit: int, keypoints: int) -> str:
    if unit in log.failures:
        return log.failures[unit].reason
    least = mapper.config.mapping.min_pnp_inliers
    images = mapper.image_unit == unit
    if images.any() and mapper.missing[images].all():
        return "its images are left out: truncated, corrupt, or those before them once more"
    if keypoints < least:
        return f"its images have {keypoints} keypoints, {least} are needed"
    return "it sees no point of the scene"


def _covered(mapper: Mapper, log: MappingLog) -> list[dict[str, Any]]:
    """Images covered by something that moves along with the vehicle."""
    images, cameras = mapper.drive.images, mapper.drive.cameras
    return [
        {
            "file": images[i].file,
            "camera": cameras[images[i].camera].name,
            "unit": images[i].unit,
            "share_of_keypoints_against_the_unit": round(share, 3),
        }
        for i, share in sorted(log.covered_images.items())
    ]


def covered_camera_findings(mapper: Mapper, log: MappingLog) -> list[Finding]:
    """Findings on cameras most of whose images contradict the poses of their units, all along the drive."""
    is_covered = np.zeros(len(mapper.image_unit), dtype=np.bool_)
    is_covered[sorted(log.covered_images)] = True
    return [
        warning(
            "camera-against-rig",
            f"{found} of {posed} images of camera {name} contradict the poses of the vehicle",
            "They have no part in the scene. Look at them: something may cover them, they may be another camera's, or "
            "rig_from_cam may be.",
        )
        for name, found, posed in _cameras_all_along(mapper, is_covered)
    ]


def idle_camera_findings(mapper: Mapper) -> list[Finding]:
    """Findings on cameras whose images observe hardly anything of the finished scene: with matches, and without."""
    of_tracks = mapper.keypoints.image[mapper.tracks.of_keypoint >= 0]
    matched = np.bincount(of_tracks, minlength=len(mapper.image_unit)) >= MIN_CAMERA_MATCHES
    idle = _is_poorly_seen(mapper)
    return [
        warning(
            "camera-without-points",
            f"{found} of {posed} images of camera {name} have matches and observe under {MIN_CAMERA_MATCHES} points of "
            "the scene",
            "They have hardly any part in the scene. Look at them: they may be another camera's, or rig_from_cam or "
            "params may be.",
        )
        for name, found, posed in _cameras_all_along(mapper, idle & matched)
    ] + [
        warning(
            "camera-without-matches",
            f"{found} of {posed} images of camera {name} have under {MIN_CAMERA_MATCHES} keypoints that match another "
            "image",
            "They have no part in the scene, and their poses are as rig_from_cam says. Look at them: they may be dark, "
            "without texture or noise alone, and the lens covered.",
        )
        for name, found, posed in _cameras_all_along(mapper, idle & ~matched)
    ]


def contradicting_image_findings(mapper: Mapper) -> list[Finding]:
    """The finding on single images most of whose points lie elsewhere in them, by the poses of their units."""
    of_keypoint = mapper.tracks.of_keypoint
    rows = np.flatnonzero((of_keypoint >= 0) & mapper.triangulated[of_keypoint])
    images = len(mapper.image_unit)
    shown = np.bincount(mapper.keypoints.image[rows], minlength=images)
    fitting = np.bincount(mapper.keypoints.image[rows[mapper.is_inlier[rows]]], minlength=images)
    found = mapper.image_posed & (shown >= MIN_CAMERA_MATCHES) & (fitting < MIN_CAMERA_INLIER_RATIO * shown)
    if not found.any():
        return []
    files = [mapper.drive.images[i].file for i in np.flatnonzero(found).tolist()]
    return [
        warning(
            "images-against-rig",
            f"{len(files)} of {int(mapper.image_posed.sum())} images contradict the poses of their units: "
            f"{listed(files)}",
            "They have hardly any part in the scene. Check that each is of its camera and of its time: files may be "
            "exchanged, late or repeated. Where one other camera alone says where the unit is, that one may be the "
            "wrong one, and sigma_position_m does not hold it.",
        )
    ]


def _cameras_all_along(mapper: Mapper, images: Bools) -> list[tuple[str, int, int]]:
    """Cameras of which most posed images are among some (i,): name, number of these, and of all that are posed."""
    names = [camera.name for camera in mapper.drive.cameras]
    posed, found = (
        np.bincount(mapper.image_camera[rows], minlength=len(names))
        for rows in (mapper.image_posed, mapper.image_posed & images)
    )
    all_along = (posed >= MIN_UNITS_AGAINST) & (found > MOST_IMAGES * posed)
    return [(names[c], int(found[c]), int(posed[c])) for c in np.flatnonzero(all_along).tolist()]


def _focal_lengths(mapper: Mapper, refinement: Refinement) -> dict[str, Any]:
    """Focal lengths of the cameras whose intrinsics varied; nothing where none did."""
    if not refinement.intrinsics_vary or refinement.intrinsics is None:
        return {}
    return {
        "focal_lengths_px": {
            camera.name: {"given": camera.params[0], "refined": unpack_camera(camera.model, params)[0]}
            for camera, params, free in zip(
                mapper.drive.cameras, mapper.state.camera_params, refinement.intrinsics.free, strict=True
            )
            if free.any()
        }
    }


def describe_refinement(mapper: Mapper, refinement: Refinement) -> dict[str, Any]:
    """Alignment, adjustments and certainty of the last stage."""
    placement, certainty = refinement.placement, refinement.certainty
    alignment = None if placement is None else placement.alignment
    result: dict[str, Any] = {
        "points": int(mapper.triangulated.sum()),
        "observations": int(mapper.is_inlier.sum()),
        "rejected": {
            "observations": refinement.observations_dropped,
            "points": refinement.points_dropped,
            "units": refinement.units_dropped,
        },
        "sigma_observation_px": refinement.sigma_px,
        "sigma_factor_of_shared_errors": refinement.sigma_factor,
        **_systematic(refinement),
        "adjustments": [_adjustment(r) for r in refinement.adjustments],
        "calibration": {
            "adjusted": refinement.calibration.free,
            "adjusted_cameras": [
                c.name for c, a in zip(mapper.drive.cameras, refinement.recalibrated, strict=True) if a
            ],
            "reason": refinement.calibration.reason,
            "heading_change_deg": heading_change_deg(mapper),
            **_directions(mapper, refinement),
            **_focal_lengths(mapper, refinement),
        },
        "georeferenced": refinement.georeferenced,
        "moving_objects": _moving(refinement.moving),
        "road": _road(refinement.road),
        "motion_within_units": _motion(mapper),
    }
    if certainty is not None and np.isfinite(certainty.sigma_scale):
        result["scale"] = {
            "sigma_relative": certainty.sigma_scale,
            "from": _scale_source(mapper, refinement),
        }
    if placement is not None and alignment is not None:
        times = mapper.drive.timestamps_us[placement.units[~placement.inlier]]
        result["gnss"] = {
            "units_used": int(placement.inlier.sum()),
            "outliers_at_us": [int(t) for t in times],
            "residual_rms_m": float(np.sqrt((placement.residuals_m[placement.inlier] ** 2).sum(1).mean())),
            "noise_factor": placement.noise_factor,
            "errors_in_declared_sigmas": {
                "white": placement.errors.white,
                "wander": placement.errors.wander,
                "unseen": placement.errors.unseen,
            },
            "wandering_error_rms_m": _wandering_rms_m(mapper, placement),
            "scale_of_rig_against_gnss": placement.scale_of_rig,
            "error_jumps_at_us": [int(t) for t in mapper.drive.timestamps_us[placement.jumps]],
        }
        if placement.clock is not None:
            clock = {"clock_offset_s": placement.clock.offset_s, "sigma_clock_offset_s": placement.clock.sigma_s}
            result["gnss"] |= clock
        lever = placement.lever or refinement.absolute.doubted_lever
        if lever is not None:
            result["gnss"]["antenna"] = {
                "used_in_rig_m": placement.lever_arm_m.tolist(),
                "offset_m": lever.offset_m.tolist(),
                "sigma_m": lever.sigma_m.tolist(),
            }
    elif placement is not None:
        result["gnss"] = {"not_used": placement.reason}
    leap = refinement.absolute.clock_leap
    if leap is not None and placement is not None:
        result["gnss"]["clock_leap"] = {
            "between_us": [leap.last_before_us, leap.first_behind_us],
            "leap_s": leap.seconds,
            "used": "after" if leap.later_is_used else "before",
        }
    return result


def _wandering_rms_m(mapper: Mapper, placement: Placement) -> float:
    """Size of the receiver's errors that wander, as the scene shows them."""
    if placement.prior is None:
        return 0.0
    return float(np.sqrt((placement.prior.errors_m(mapper.state) ** 2).sum(1).mean()))


def _directions(mapper: Mapper, refinement: Refinement) -> dict[str, Any]:
    """Observed directions of the cameras' poses, by name, and the miscalibrated cameras."""
    cameras, directions = mapper.drive.cameras, refinement.directions
    if directions is None:
        return {}
    observed = directions.observed & refinement.recalibrated[:, None]
    return {
        "observed": {
            camera.name: [d for d, seen in zip(DIRECTIONS, observed[c], strict=True) if seen]
            for c, camera in enumerate(cameras)
        },
        "only_the_prior": {
            camera.name: [d for d, seen in zip(DIRECTIONS, observed[c], strict=True) if not seen]
            for c, camera in enumerate(cameras)
        },
        "held_for_all_cameras_together": [*DIRECTIONS],
        "scale_of_the_rig": directions.scale_in_words,
        "cameras_wrong": [
            {
                "camera": cameras[w.camera].name,
                "rotation_deg": w.rotation_deg,
                "translation_m": w.translation_m,
                "sigmas_of_its_prior": w.prior_sigmas,
                "others_rotation_deg": w.others_rotation_deg,
                "others_translation_m": w.others_translation_m,
            }
            for w in refinement.miscalibrations
        ],
    }


def _moving(moving: MovingTracks) -> dict[str, Any]:
    """Tracks that show something that moves, and why each was taken out."""
    return {
        "tracks_judged": moving.judged,
        "tracks_dropped": len(moving.tracks),
        "points_dropped": moving.points,
        "tracks_dropped_because": {text: int((moving.reason == code).sum()) for code, text in REASONS.items()},
    }


def _road(judged: RoadAssessment | str) -> dict[str, Any]:
    """Thicknesses are of all points that were taken for the road's, and of those that were kept: none else left out."""
    if isinstance(judged, str):
        return {"source": None, "reason": judged}
    road, kept = judged.road, judged.is_inlier
    result = {
        "source": str(road.source),
        "patches": len(road.surface),
        "points": len(kept),
        "kept": int(kept.sum()),
        "kept_off_the_surface": int((kept & np.isfinite(judged.distance_m) & ~judged.is_on_surface).sum()),
        "dropped": int((~kept).sum()),
        "kept_where_no_surface_is": int((kept & np.isnan(judged.distance_m)).sum()),
        "roughness_m": road.roughness_m,
        "rig_height_above_road_m": road.rig_height_m,
    }
    for when, thickness in (("before", road.thickness_before), ("after", road.thickness_after)):
        if np.isfinite(thickness.range90_m):
            result[f"thickness_{when}_m"] = thickness.range90_m
            result[f"spread_{when}_m"] = thickness.spread_m
    if road.source is RoadSource.GEOMETRY:
        result["confidence"] = (
            "low: no mask says what is road. Points near the road's level in the vehicle's own lane were judged in the "
            "finished scene, and dropped only where nothing can stand: below the road, or above it where it drove"
        )
    return result


def describe_between(mapper: Mapper, registrations: Sequence[Registration]) -> dict[str, Any]:
    """The units that are no keyframes, and those of them that the finished scene gave no pose."""
    frames = mapper.drive.manifest.frames
    return {
        "between_keyframes": {
            "units": int((~mapper.keyframe).sum()),
            "registered": sum(r.world_from_rig is not None for r in registrations),
            "units_not_registered": [
                {"unit": r.unit, "source_frame": frames[r.unit].source_frame, "reason": r.reason}
                for r in registrations
                if r.world_from_rig is None
            ],
        }
    }


def _motion(mapper: Mapper) -> dict[str, Any]:
    """Distance of images from their unit in time and, where motion is compensated, in space."""
    bands = RowBands.from_drive(mapper.drive)
    if bands.simultaneous:
        return {"simultaneous": True}
    largest = mapper.motion.largest(mapper.state, mapper.registered)
    result: dict[str, Any] = {
        "simultaneous": False,
        "largest_time_offset_s": float(np.abs(bands.time_offset_s).max()),
        "compensated": not mapper.motion.bands.simultaneous,
    }
    if result["compensated"]:
        result |= {
            "largest_translation_m": largest.translation_m,
            "largest_rotation_deg": largest.rotation_deg,
            "units_not_compensated": len(_not_compensated(mapper)),
        }
    return result


def _not_compensated(mapper: Mapper) -> Ints:
    # The others did not move: that is why they are no keyframes.
    return mapper.motion.not_compensated(mapper.state, mapper.registered & mapper.keyframe)


def motion_findings(mapper: Mapper) -> list[Finding]:
    """Findings on the motion within units."""
    units = _not_compensated(mapper)
    return [rig_motion.finding(len(units), int(mapper.registered.sum()))] if len(units) else []


def scale_findings(mapper: Mapper, refinement: Refinement) -> list[Finding]:
    """Warn where lengths in the scene are hardly known."""
    certainty = refinement.certainty
    if certainty is None or certainty.sigma_scale <= MAX_SIGMA_SCALE:
        return []
    known = "by how much lengths may be off is not known: something that they depend on is not determined"
    if np.isfinite(certainty.sigma_scale):
        known = f"lengths are known to {certainty.sigma_scale:.1%} (one sigma): the drive observes the scale badly"
    remedy = (
        f"{_scale_from_gnss(mapper, refinement)}, or declare sigma_translation_m of cameras whose distances are known "
        "better; a longer drive with turns, and cameras with a common view, tell the scale as well."
    )
    return [warning("scale-uncertain", known, remedy)]


def _scale_from_gnss(mapper: Mapper, refinement: Refinement) -> str:
    """Words on what makes GNSS tell the scale: the drive may have it, and the scene may stand where it says."""
    gnss = mapper.drive.manifest.gnss
    if refinement.georeferenced:
        return (
            "Give GNSS positions of a longer path, or of a receiver with a smaller error: those of the drive are used"
        )
    if refinement.placement is not None:
        return "See to the drive's GNSS positions, which are not used; another finding says why"
    if gnss is not None and gnss.samples:
        return "Use the drive's GNSS positions, which this run was told to ignore"
    return "Give GNSS positions"


def _poorly_seen(mapper: Mapper) -> list[str]:
    """Images that observe too little to be registered alone: dark, without texture, or occluded."""
    images = mapper.drive.images
    return [images[i].file for i in np.flatnonzero(_is_poorly_seen(mapper))]


def _is_poorly_seen(mapper: Mapper) -> Bools:
    """Posed images (i,) that observe too little to be registered alone."""
    counts = np.bincount(mapper.keypoints.image[mapper.is_inlier], minlength=len(mapper.image_unit))
    result: Bools = mapper.image_posed & (counts < MIN_CAMERA_MATCHES)
    return result


def _scale_source(mapper: Mapper, refinement: Refinement) -> str:
    if mapper.drive.has_single_camera:
        return "GNSS" if refinement.georeferenced else "rough poses"
    return "baselines of the rig and GNSS" if refinement.georeferenced else "baselines of the rig"


def _systematic(refinement: Refinement) -> dict[str, Any]:
    errors = refinement.systematic
    return {} if errors is None else {"lens_errors_px": errors.lens_px, "factor_of_systematic_errors": errors.factor}


def _adjustment(report: Report) -> dict[str, Any]:
    return {
        "initial_cost": report.initial_cost,
        "final_cost": report.final_cost,
        "iterations": report.iterations,
        "termination": str(report.termination),
        "observations": report.observations,
        "parameters": report.parameters,
        "pose_parameters": report.pose_parameters,
    }
