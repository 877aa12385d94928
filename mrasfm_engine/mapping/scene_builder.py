"""The finished scene from the refined reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior
from mrasfm_engine.geometry.camera_model import unpack_camera
from mrasfm_engine.mapping.calibration import calibration_prior
from mrasfm_engine.mapping.keyframes import nearest_keyframes
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.road import RoadAssessment
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.scene import (
    CalibrationObservability,
    CameraCalibration,
    ImageFeatures,
    PairMatches,
    Scene,
    observed_colors,
)
from mrasfm_engine.scene.semantics import majority_class


def build_scene(
    mapper: Mapper,
    refinement: Refinement,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    prior: PriorTrajectory,
    *,
    notes: Sequence[str] = (),
) -> Scene:
    """Everything that is exported, as arrays. All images of a registered unit are part of the scene, unless
    images were registered one by one or left out."""
    rows = mapper.observation_rows()
    tracks, point = np.unique(mapper.tracks.of_keypoint[rows], return_inverse=True)
    errors = mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, mapper.tracks.of_keypoint[rows])
    counts = np.bincount(point, minlength=len(tracks)).clip(1)
    image, keypoint = mapper.keypoints.image[rows], mapper.keypoints.number[rows]
    colors = observed_colors(features, image, keypoint).astype(np.float64)
    mean_color = np.stack([np.bincount(point, colors[:, k], minlength=len(tracks)) for k in range(3)], 1)
    left_out = np.array([f.left_out is not None for f in features])
    units = len(mapper.registered)
    poses = mapper.state.world_from_rig.copy()
    poses[~mapper.registered] = np.nan
    sigma = np.full((units, 3), np.nan)
    if refinement.certainty is not None:
        sigma = refinement.certainty.sigma_unit_position_m.copy()
        between = ~mapper.keyframe & mapper.registered
        sigma[between] = sigma[nearest_keyframes(mapper)[between]]
    georeferenced = refinement.georeferenced
    if georeferenced and refinement.placement is not None:
        sigma = np.hypot(sigma, refinement.placement.unseen_m)
    patches, judged = np.full(len(mapper.tracks), -1, dtype=np.int32), refinement.road
    if isinstance(judged, RoadAssessment):
        patches[judged.tracks] = judged.patches_of(mapper.state.points_m[judged.tracks])
    return Scene(
        drive=mapper.drive,
        unit_registered=mapper.registered.copy(),
        image_registered=mapper.image_posed & ~left_out,
        world_from_rig=poses,
        sigma_position_m=sigma,
        calibration=_calibrations(mapper, refinement),
        calibration_observability=_observability(refinement),
        points_m=mapper.state.points_m[tracks],
        point_colors=np.round(mean_color / counts[:, None]).astype(np.uint8),
        point_error_px=np.bincount(point, errors, minlength=len(tracks)) / counts,
        observation_point=point.astype(np.int64),
        observation_image=image,
        observation_keypoint=keypoint,
        features=list(features),
        pairs=list(pairs),
        georeference=prior.georeference if georeferenced else None,
        rough_world_from_local=prior.rough_world_from_local if refinement.placed_by_rough_poses else None,
        notes=list(notes),
        unit_from_image=None if mapper.state.simultaneous else mapper.motion.unit_from_image(mapper.state),
        point_classes=majority_class(mapper.keypoints.classes[rows], point.astype(np.int64), len(tracks)),
        point_patches=patches[tracks],
        road=judged.road if isinstance(judged, RoadAssessment) else None,
    )


def _observability(refinement: Refinement) -> CalibrationObservability:
    directions = refinement.directions
    return CalibrationObservability(
        adjusted=refinement.calibration.free,
        reason=refinement.calibration.reason,
        scale_observed=refinement.calibration.free and directions is not None and directions.scale_observed,
        scale_rests_on="what was given"
        if directions is None or not refinement.calibration.free
        else directions.scale_in_words,
        sigma_scale=np.nan if directions is None else directions.sigma_scale,
    )


def _time_offset(mapper: Mapper, refinement: Refinement, camera: int) -> dict[str, Any]:
    times = refinement.times
    if times is None:
        return {}
    sigma_s, errors = times.sigma_s, refinement.systematic
    if errors is not None:
        sigma_s = errors.sigma_time_s(sigma_s)
    return {
        "time_offset_s": float(mapper.state.camera_time_offset_s[camera]),
        "sigma_time_offset_s": float(sigma_s[camera]),
        "time_offset_observed": bool(times.observed[camera]),
    }


def _calibrations(mapper: Mapper, refinement: Refinement) -> list[CameraCalibration]:
    prior: CalibrationPrior = calibration_prior(mapper)
    sigma = prior.sigma
    sigma_focal_px = np.array([c.sigma_focal_px or np.nan for c in mapper.drive.cameras])
    intrinsics, asked = refinement.intrinsics, refinement.intrinsics_are_asked
    observed = np.zeros((len(sigma), 6), dtype=np.bool_)
    if refinement.certainty is not None and np.isfinite(refinement.certainty.sigma_camera[:, :6]).all():
        # What is held is as good as what was given, whatever the drive would know of it.
        sigma = np.where(refinement.recalibrated[:, None], refinement.certainty.sigma_camera[:, :6], sigma)
        if asked and intrinsics is not None:
            focal_px = [
                unpack_camera(c.model, p)[0]
                for c, p in zip(mapper.drive.cameras, mapper.state.camera_params, strict=True)
            ]
            found, held = refinement.certainty.sigma_camera[:, 6], intrinsics.prior_sigma_focal
            sigma_focal = np.where(intrinsics.free[:, 0], found, held) * np.array(focal_px)
            sigma_focal_px = np.where(intrinsics.asked, sigma_focal, sigma_focal_px)
    # What was given scatters by nothing, and priors of lenses are no scatter.
    scatter = np.where(refinement.recalibrated[:, None] & (not asked), sigma, np.nan)
    if refinement.systematic is not None:
        sigma = np.where(refinement.recalibrated[:, None], refinement.systematic.sigma_camera(sigma), sigma)
    if refinement.directions is not None:
        observed = refinement.directions.observed & refinement.recalibrated[:, None]
    wrong = {w.camera for w in refinement.miscalibrations}
    return [
        CameraCalibration(
            rig_from_cam=mapper.state.rig_from_cam[c],
            params=unpack_camera(camera.model, mapper.state.camera_params[c]),
            sigma_rotation_deg=np.degrees(sigma[c, :3]),
            sigma_translation_m=sigma[c, 3:],
            repeatability_rotation_deg=np.degrees(scatter[c, :3]),
            repeatability_translation_m=scatter[c, 3:],
            sigma_focal_px=float(sigma_focal_px[c]),
            observed=observed[c],
            is_wrong=c in wrong,
            focal_observed=bool(intrinsics.free[c, 0]) if intrinsics is not None and intrinsics.asked[c] else None,
            **_time_offset(mapper, refinement, c),
        )
        for c, camera in enumerate(mapper.drive.cameras)
    ]
