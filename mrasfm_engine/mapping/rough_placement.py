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
# Of the way's extent, that most rough poses of another shape are off by at least. Inverse poses and those of another
# body's axes are off by all of it, and odometry that drifts by a tenth at most.
OTHER_SHAPE = 0.3
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


def shape_fault(mapper: Mapper, rough_world_from_rig: Floats, sigma_translation_m: float) -> str:
    """Words on how the way of rough poses (units, 4, 4; NaN where unknown) differs from the scene's, if it does.

    Wherever it is, and however large: rough poses may tell the scale. A vehicle that hardly moves has no way to
    compare.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(rough_world_from_rig[:, 0, 3]))
    if len(units) < MIN_POSITIONS:
        return ""
    own, rough = mapper.state.world_from_rig[units], rough_world_from_rig[units]
    off_m, reach_m = _off_m(own, rough)
    if off_m < max(OTHER_SHAPE * reach_m, MIN_EXTENT_SIGMAS * sigma_translation_m):
        return ""
    inverse_off_m, inverse_reach_m = _off_m(own, se3.inverse(rough))
    inverse = "; their inverses have it" if inverse_off_m < OTHER_SHAPE * inverse_reach_m else ""
    return f"half of them are over {off_m:.2g} m off, of {reach_m:.2g} m that they reach{inverse}"


def _off_m(own: Floats, rough: Floats) -> tuple[float, float]:
    """Medians over rough poses (n, 4, 4): of their distance from the scene's own, and from their middle.

    The scene is turned as both say that they are turned against each other, moved to their middle, and scaled to them.
    """
    turned_m = own[:, :3, 3] @ between_poses(rough, own)[:3, :3].T
    way_m, rough_m = (places - np.median(places, axis=0) for places in (turned_m, rough[:, :3, 3]))
    scale = max(0.0, float((way_m * rough_m).sum() / max((way_m**2).sum(), 1e-12)))
    off_m, reach_m = (np.median(np.linalg.norm(by_m, axis=1)) for by_m in (scale * way_m - rough_m, rough_m))
    return float(off_m), float(reach_m)


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
