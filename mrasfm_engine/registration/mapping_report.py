"""What the report says of mapping and refinement, in plain values."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from mrasfm_engine.adjustment.solver import Report
from mrasfm_engine.registration.calibration import heading_change_deg
from mrasfm_engine.registration.camera_set import MIN_CAMERA_MATCHES
from mrasfm_engine.registration.incremental import MappingLog
from mrasfm_engine.registration.model import Model
from mrasfm_engine.registration.refine import Refinement
from mrasfm_engine.registration.road import RoadJudgement
from mrasfm_engine.scene.road import RoadSource


def describe(model: Model, log: MappingLog) -> dict[str, Any]:
    """Counts of the incremental loop, and what was rejected and why."""
    frames = model.drive.manifest.frames
    voted_out = Counter(name for r in log.registrations for name in r.voted_out)
    start = log.initialisation
    missing = [
        {
            "unit": int(u),
            "source_frame": frames[u].source_frame,
            "reason": log.failures[int(u)].reason if int(u) in log.failures else "it sees no point of the scene",
        }
        for u in np.flatnonzero(~model.registered)
    ]
    return {
        "initial_units": None if start is None else list(start.units),
        "initial_pose_from": None if start is None else start.method,
        "registered_units": int(model.registered.sum()),
        "units_not_registered": missing,
        "registered_by": dict(Counter(r.method for r in log.registrations)),
        "cameras_voted_out": dict(voted_out),
        "images_posed_by_their_unit_alone": _poorly_seen(model),
        "tracks": len(model.tracks),
        "points": int(model.solved.sum()),
        "observations": int(model.kept.sum()),
        "revisits": {
            "unit_pairs_tried": log.revisits_tried,
            "unit_pairs_believed": len(log.revisits),
            "moved_at_most_m": log.loop_moved_m,
        },
        "local_adjustments": log.local_adjustments,
        "global_adjustments": [_adjustment(r) for r in log.global_adjustments],
        "road_points_dropped": [0 if isinstance(j, str) else int((~j.kept).sum()) for j in log.roads],
    }


def describe_refinement(model: Model, refinement: Refinement) -> dict[str, Any]:
    """Alignment, adjustments and certainty of the last stage."""
    placement, certainty = refinement.placement, refinement.certainty
    alignment = None if placement is None else placement.alignment
    result: dict[str, Any] = {
        "points": int(model.solved.sum()),
        "observations": int(model.kept.sum()),
        "rejected": {
            "observations": refinement.observations_dropped,
            "points": refinement.points_dropped,
            "units": refinement.units_dropped,
        },
        "sigma_observation_px": refinement.sigma_px,
        "adjustments": [_adjustment(r) for r in refinement.adjustments],
        "calibration": {
            "adjusted": refinement.calibration.free,
            "reason": refinement.calibration.reason,
            "heading_change_deg": heading_change_deg(model),
        },
        "georeferenced": refinement.georeferenced,
        "road": _road(refinement.road),
    }
    if certainty is not None and np.isfinite(certainty.sigma_scale):
        result["scale"] = {
            "sigma_relative": certainty.sigma_scale,
            "from": _scale_source(model, refinement),
        }
    if placement is not None and alignment is not None:
        times = model.drive.timestamps_us[placement.units[~alignment.inlier]]
        result["gnss"] = {
            "units_used": int(alignment.inlier.sum()),
            "outliers_at_us": [int(t) for t in times],
            "residual_rms_m": float(np.sqrt((alignment.residual_m[alignment.inlier] ** 2).mean())),
            "noise_factor": alignment.noise_factor,
            "scale_of_rig_against_gnss": alignment.scale,
        }
    elif placement is not None:
        result["gnss"] = {"not_used": placement.reason}
    return result


def _road(judged: RoadJudgement | str) -> dict[str, Any]:
    """Thicknesses are of all points that were taken for the road's, and of those that were kept: none else left out."""
    if isinstance(judged, str):
        return {"source": None, "reason": judged}
    road, kept = judged.road, judged.kept
    result = {
        "source": str(road.source),
        "patches": len(road.surface),
        "points": len(kept),
        "kept": int(kept.sum()),
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


def _poorly_seen(model: Model) -> list[str]:
    """Images that observe too little to be registered alone: occluded, dark, or without texture."""
    images = model.drive.images
    counts = np.bincount(model.keypoints.image[model.kept], minlength=len(images))
    poor = np.flatnonzero(model.registered[model.image_unit] & (counts < MIN_CAMERA_MATCHES))
    return [images[i].file for i in poor]


def _scale_source(model: Model, refinement: Refinement) -> str:
    if model.drive.has_single_camera:
        return "GNSS" if refinement.georeferenced else "rough poses"
    return "baselines of the rig and GNSS" if refinement.georeferenced else "baselines of the rig"


def _adjustment(report: Report) -> dict[str, Any]:
    return {
        "initial_cost": report.initial_cost,
        "final_cost": report.final_cost,
        "iterations": report.iterations,
        "termination": str(report.termination),
        "observations": report.observations,
        "parameters": report.parameters,
    }
