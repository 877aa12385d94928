"""Errors of units and of single images."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.evaluation.pose_errors import compare_scene
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import Trajectory
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import MISSING_UNIT, make_scene


def truth_of(scene: Scene) -> tuple[Trajectory, np.ndarray]:
    """What the scene itself says, as the truth, in another frame."""
    elsewhere = se3.transform(se3.exp_so3([0.1, -0.2, 1.0]), [5.0, 6.0, 7.0])
    poses = np.where(np.isnan(scene.world_from_rig), np.eye(4), scene.world_from_rig)
    truth = Trajectory(timestamps_us=scene.drive.timestamps_us, world_from_rig=elsewhere @ poses)
    return truth, np.stack([c.rig_from_cam for c in scene.calibration])


def test_a_scene_that_is_the_truth_has_no_error() -> None:
    scene = make_scene()
    errors = compare_scene(scene, *truth_of(scene))
    assert errors is not None
    assert errors.units.poses == int(scene.unit_registered.sum())
    assert errors.images.poses == int(scene.image_registered.sum())
    for value in (errors.units.metric_rmse_m, errors.images.metric_rmse_m, errors.relative_rotation_median_deg):
        assert value == pytest.approx(0.0, abs=1e-6)


def test_errors_of_units_and_of_images_are_told_apart() -> None:
    scene = make_scene()
    truth, rig_from_cam = truth_of(scene)
    own = np.tile(np.eye(4), (len(scene.drive.images), 1, 1))
    turn = se3.exp_so3([0.0, 0.0, np.radians(0.4)])
    own[1::2, :3, :3] = turn  # the second camera of every unit
    scene.unit_from_image = own
    errors = compare_scene(scene, truth, rig_from_cam)
    assert errors is not None
    assert errors.units.metric_rmse_m == pytest.approx(0.0, abs=1e-6)
    assert errors.camera_rotation_median_deg == pytest.approx(0.4, abs=1e-6)
    assert 0.001 < errors.images.metric_rmse_m < 0.05


def test_relative_rotations_do_not_see_a_slow_drift() -> None:
    scene = make_scene()
    truth, rig_from_cam = truth_of(scene)
    units = np.flatnonzero(scene.unit_registered)
    for step, unit in enumerate(units):
        turn = se3.exp_so3([0.0, 0.0, np.radians(0.2 * step)])
        scene.world_from_rig[unit, :3, :3] = scene.world_from_rig[unit, :3, :3] @ turn
    errors = compare_scene(scene, truth, rig_from_cam)
    assert errors is not None
    assert errors.relative_rotation_median_deg == pytest.approx(0.2, abs=1e-6)
    assert errors.units.rotation_median_deg == pytest.approx(0.2, abs=0.11)


def test_what_has_no_truth_is_left_out() -> None:
    scene = make_scene()
    truth, rig_from_cam = truth_of(scene)
    late = Trajectory(timestamps_us=truth.timestamps_us + 500_000 * 3, world_from_rig=truth.world_from_rig)
    assert compare_scene(scene, late, rig_from_cam) is None
    image = next(i for i in scene.drive.images if i.unit != MISSING_UNIT)
    object.__setattr__(image, "timestamp_us", image.timestamp_us + 5_000)
    errors = compare_scene(scene, truth, rig_from_cam)
    assert errors is not None
    assert errors.images.poses == int(scene.image_registered.sum()) - 1
