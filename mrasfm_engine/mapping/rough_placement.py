"""Moving the reconstruction to where rough poses say that it is, and rough poses as terms of the adjustment."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import RotationPrior
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.mapping.calibration import scale_with_baselines
from mrasfm_engine.mapping.georeferencing import assess_residuals
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import extent_m, move, with_prior
from mrasfm_engine.mapping.receiver_fit import MIN_POSITIONS, Placement
from mrasfm_engine.types import Floats

MIN_ROUGH_POSES = 2
MIN_EXTENT_SIGMAS = 3.0  # of rough poses, to tell one camera's scale


def place_by_rough_poses(mapper: Mapper, rough_world_from_rig: Floats, sigma_translation_m: float) -> bool:
    """Move the reconstruction into the frame of the rough poses (units, 4, 4; NaN where unknown).

    The units' rotations determine by how much it turns, their positions where it comes to lie; a single camera gets its
    scale from them, too. Returns whether there were enough poses.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(rough_world_from_rig[:, 0, 3]))
    if len(units) < MIN_ROUGH_POSES:
        return False
    rough = rough_world_from_rig[units]
    if mapper.drive.has_single_camera:
        if extent_m(rough[:, :3, 3]) < MIN_EXTENT_SIGMAS * sigma_translation_m:
            return False
        scale_with_baselines(mapper, extent_m(rough[:, :3, 3]) / extent_m(mapper.state.unit_position_m[units]))
    move(mapper, between_poses(rough, mapper.state.world_from_rig[units]))
    return True


def between_poses(a_from_rig: Floats, b_from_rig: Floats) -> Floats:
    """Transform a_from_b (4, 4) by which poses (n, 4, 4) of the same units agree: rotations determine its rotation."""
    rotation = robust_mean_rotation(a_from_rig[:, :3, :3] @ np.swapaxes(b_from_rig[:, :3, :3], 1, 2))
    return se3.transform(rotation, geometric_median(a_from_rig[:, :3, 3] - b_from_rig[:, :3, 3] @ rotation.T))


def compare_rough_poses(
    mapper: Mapper,
    rough_world_from_rig: Floats,
    sigma_translation_m: float,
    sigma_rotation_rad: float,
    *,
    scene_stands_there: bool = False,
) -> tuple[Placement, RotationPrior] | None:
    """Rough poses (units, 4, 4; NaN where unknown), moved to where the scene lies, as terms of the adjustment.

    As of a receiver's positions, what they do not scatter by from pose to pose is an error that wanders. None where
    there are too few. A scene that stands where they say is in their world already.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(rough_world_from_rig[:, 0, 3]))
    if len(units) < MIN_POSITIONS:
        return None
    own, rough = mapper.state.world_from_rig[units], rough_world_from_rig[units]
    scene_from_rough = np.eye(4) if scene_stands_there else between_poses(own, rough)
    known = scene_from_rough @ rough_world_from_rig
    off_m = own[:, :3, 3] - known[units, :3, 3]
    sigma_m = np.full((len(known), 3), sigma_translation_m)
    inlier, factor = assess_residuals(
        off_m, sigma_m[units], np.ones(len(units), dtype=np.bool_), outlier_sigmas=mapper.config.gnss.outlier_sigmas
    )
    if inlier.sum() < MIN_POSITIONS:
        return None
    placement = Placement(
        known_m=known[:, :3, 3], known_sigma_m=sigma_m, units=units, inlier=inlier, off_m=off_m, noise_factor=factor
    )
    turn_rad = se3.log_so3(own[:, :3, :3] @ np.swapaxes(rough[:, :3, :3], 1, 2) @ scene_from_rough[:3, :3].T)
    scatter = np.median(np.abs(np.diff(turn_rad, axis=0))) / (0.6745 * np.sqrt(2.0) * sigma_rotation_rad)
    white = float(np.clip(scatter**2, 0.0, 1.0))
    # What does not scatter is one error of all: together they weigh no more than one rotation.
    sigma_rad = sigma_rotation_rad * np.sqrt(white + (1.0 - white) * len(units))
    rotations = RotationPrior(unit=units, rotation=known[units, :3, :3], sigma_rad=np.full(len(units), sigma_rad))
    return with_prior(mapper, placement), rotations
