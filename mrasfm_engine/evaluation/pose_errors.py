"""Errors of a scene's units and of its single images."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mrasfm_engine.evaluation.trajectory import MIN_POSES, TrajectoryErrors, compare_trajectories, match_timestamps
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import Trajectory
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints

TOLERANCE_US = 1000


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Errors of a scene against the vehicle's true poses and the true calibration.

    Attributes
    ----------
    units, images
        Positions and rotations of the vehicle, and of every image's camera, each after an alignment of its own.
    relative_rotation_median_deg
        Of the rotation from one unit to the next.
    camera_rotation_median_deg
        Of the rotation from one camera of a unit to another; NaN with a single camera.
    """

    units: TrajectoryErrors
    images: TrajectoryErrors
    relative_rotation_median_deg: float
    camera_rotation_median_deg: float


def compare_scene(scene: Scene, truth: Trajectory, true_rig_from_cam: Floats) -> PoseErrors | None:
    """Errors of a scene in memory; None where fewer than 3 of its units have a truth.

    Images whose own time is more than a millisecond from that of their unit are left out: of them there is no truth.

    Parameters
    ----------
    true_rig_from_cam
        (cameras, 4, 4).
    """
    units = np.flatnonzero(scene.unit_registered)
    kept, matched = match_timestamps(scene.drive.timestamps_us[units], truth.timestamps_us, tolerance_us=TOLERANCE_US)
    if len(kept) < MIN_POSES:
        return None
    units = units[kept]
    own, true = scene.world_from_rig[units], truth.world_from_rig[matched]
    truth_of_unit = np.full(len(scene.unit_registered), -1)
    truth_of_unit[units] = matched
    image, unit, camera = _images(scene, truth_of_unit)
    own_image = scene.world_from_cam[image]
    true_image = truth.world_from_rig[truth_of_unit[unit]] @ true_rig_from_cam[camera]
    rows = np.arange(len(own), dtype=np.int64)
    groups = np.split(np.arange(len(unit)), np.flatnonzero(np.diff(unit)) + 1)
    pairs = [pair for group in groups for pair in combinations(group.tolist(), 2)]
    return PoseErrors(
        units=compare_trajectories(own, true),
        images=compare_trajectories(own_image, true_image),
        relative_rotation_median_deg=_relative_deg(own, true, np.column_stack([rows[:-1], rows[1:]])),
        camera_rotation_median_deg=_relative_deg(own_image, true_image, np.array(pairs, dtype=np.int64).reshape(-1, 2)),
    )


def _images(scene: Scene, truth_of_unit: Ints) -> tuple[Ints, Ints, Ints]:
    """Registered images (n,) that have a truth, and their units and cameras."""
    times_us = scene.drive.timestamps_us
    rows = [
        (i, image.unit, image.camera)
        for i, image in enumerate(scene.drive.images)
        if scene.image_registered[i]
        and truth_of_unit[image.unit] >= 0
        and abs(image.timestamp_us - int(times_us[image.unit])) <= TOLERANCE_US
    ]
    image, unit, camera = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    return image, unit, camera


def _relative_deg(own: Floats, true: Floats, pairs: Ints) -> float:
    """Median error (deg) of the rotation between the poses of pairs (m, 2); NaN without any."""
    if not len(pairs):
        return float("nan")
    a, b = pairs.T
    turns = [np.swapaxes(poses[a, :3, :3], 1, 2) @ poses[b, :3, :3] for poses in (own, true)]
    return float(np.median(se3.rotation_angle_deg(np.swapaxes(turns[1], 1, 2) @ turns[0])))
