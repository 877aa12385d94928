from __future__ import annotations

import numpy as np

from mrasfm_engine.config import EngineConfig, MappingConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.baseline_without_rig import register_images_singly, retry_missing, take_over
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.mapper import Mapper
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    true_matches,
    with_lorry,
    with_true_poses,
)

UNIT, UNITS, LEFT = 4, 8, 3
ONE_BY_ONE = EngineConfig(threads=1, mapping=MappingConfig(camera_set_registration=False))


def scene(**kwargs: object) -> tuple[SimulatedDrive, Mapper]:
    simulated = make_simulated_drive(units=UNITS, points=1200, **kwargs)
    mapper = make_model(simulated, config=ONE_BY_ONE)
    return simulated, with_true_poses(mapper, simulated, [u for u in range(UNITS) if u != UNIT])


def image_of(simulated: SimulatedDrive, camera: int, unit: int = UNIT) -> int:
    return next(i for i, im in enumerate(simulated.drive.images) if im.unit == unit and im.camera == camera)


def test_images_that_agree_belong_to_the_set() -> None:
    simulated, mapper = scene()
    found = register_images_singly(mapper, UNIT)
    assert found.method == "single images"
    assert found.missing == ()
    assert found.own_poses == {}
    assert found.world_from_rig is not None
    error_m = np.linalg.norm(found.world_from_rig[:3, 3] - simulated.world_from_rig[UNIT, :3, 3])
    assert 1e-5 < error_m < 0.1


def test_an_image_that_sees_nothing_is_missing_until_it_sees_something() -> None:
    simulated, mapper = scene()
    rows = mapper.rows_of_unit[UNIT]
    hidden = rows[mapper.keypoints.camera[rows] == LEFT]
    mapper.rows_of_unit[UNIT] = rows[mapper.keypoints.camera[rows] != LEFT]
    found = register_images_singly(mapper, UNIT)
    assert found.missing == (LEFT,)
    assert found.world_from_rig is not None
    mapper.set_pose(UNIT, found.world_from_rig)
    take_over(mapper, found)
    mapper.rows_of_unit[UNIT] = rows
    mapper.extend(UNIT)
    mapper.complete()
    assert mapper.missing[image_of(simulated, LEFT)]
    assert not mapper.is_inlier[hidden].any()
    retry_missing(mapper)
    assert not mapper.missing.any()
    assert mapper.is_inlier[hidden].mean() > 0.5


def test_an_image_with_another_pose_keeps_it() -> None:
    simulated, mapper = scene()
    wrong = se3.exp_so3(np.radians([0.0, 0.0, 5.0]))
    mapper.state.camera_rotation[LEFT] = wrong @ mapper.state.camera_rotation[LEFT]
    found = register_images_singly(mapper, UNIT)
    assert found.world_from_rig is not None
    assert set(found.own_poses) == {LEFT}
    assert found.voted_out == (simulated.drive.cameras[LEFT].name,)
    mapper.set_pose(UNIT, found.world_from_rig)
    take_over(mapper, found)
    unit_from_image = mapper.motion.unit_from_image(mapper.state)[image_of(simulated, LEFT)]
    pose = mapper.state.world_from_rig[UNIT] @ unit_from_image @ mapper.state.rig_from_cam[LEFT]
    true = simulated.world_from_rig[UNIT] @ simulated.truth.rig_from_cam[LEFT]
    assert 1e-5 < float(se3.rotation_angle_deg(pose[:3, :3] @ true[:3, :3].T)) < 0.3
    assert 1e-5 < np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.15


def test_without_the_set_covered_images_are_lost() -> None:
    """What the camera set is for: its images follow the unit, single ones follow what covers them or are missing."""

    def covered(unit: int, camera: int) -> bool:
        return camera in (1, 4) and 2 <= unit < 6

    simulated = with_lorry(make_simulated_drive(units=UNITS, points=1000), covered, left=0.05)
    off = {}
    for config in (ONE_BY_ONE, EngineConfig(threads=1)):
        mapper = make_model(simulated, config=config)
        mapper = map_drive(simulated.drive, mapper.keypoints, true_matches(simulated), None, config)[0].mapper
        poses = mapper.state.world_from_rig[mapper.image_unit] @ mapper.motion.unit_from_image(mapper.state)
        good = ~mapper.missing & mapper.registered[mapper.image_unit]
        true = simulated.world_from_rig[mapper.image_unit]
        free = good & (mapper.image_unit < 2)  # the first units are nobody's problem: the frame is theirs
        turn = se3.mean_rotation(true[free, :3, :3] @ np.swapaxes(poses[free, :3, :3], 1, 2))
        moved = poses[:, :3, 3] @ turn.T
        moved += (true[free, :3, 3] - moved[free]).mean(0)
        error_m = np.where(good, np.linalg.norm(moved - true[:, :3, 3], axis=1), np.inf)
        which = np.array([covered(i.unit, i.camera) for i in simulated.drive.images])
        off[config.mapping.camera_set_registration] = error_m[which]
    assert (off[False] > 0.5).mean() >= 0.25
    assert 0 < off[True].max() < 0.1
