from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping import unit_registration
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.resection import pose_information, resect
from mrasfm_engine.mapping.unit_registration import cameras_of, correspondences_of_unit, register_unit
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_true_poses

UNIT = 5


def scene(**kwargs: object) -> tuple[np.ndarray, Mapper]:
    """The true poses, and a model with all units but one at them."""
    simulated = make_simulated_drive(**{"units": 9, "cameras": 6, "points": 1500, **kwargs})
    mapper = with_true_poses(make_model(simulated), simulated, [u for u in range(9) if u != UNIT])
    return simulated.world_from_rig, mapper


def found(mapper: Mapper, start: np.ndarray, *, wrong: float = 0.0) -> np.ndarray | None:
    matched = correspondences_of_unit(mapper, UNIT)
    rng = np.random.default_rng(0)
    points = (
        matched.points_m
        + 20 * rng.normal(size=matched.points_m.shape) * (rng.random(len(matched.points_m)) < wrong)[:, None]
    )
    state = mapper.state
    return resect(
        start, matched.xy_px, points, matched.camera, state.rig_from_cam, mapper.camera_kind, state.camera_params
    )


def off(pose: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm(pose[:3, 3] - true[:3, 3])), float(
        se3.rotation_angle_deg(pose[:3, :3] @ true[:3, :3].T)
    )


def moved(pose: np.ndarray, *, by_m: float, by_deg: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    axis, way = rng.normal(size=3), rng.normal(size=3)
    turn = se3.exp_so3(np.radians(by_deg) * axis / np.linalg.norm(axis))
    return se3.transform(turn @ pose[:3, :3], pose[:3, 3] + by_m * way / np.linalg.norm(way))


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_a_pose_is_found_from_one_that_is_some_way_off(wrong: float) -> None:
    true, mapper = scene()
    pose = found(mapper, moved(true[UNIT], by_m=0.4, by_deg=2.0), wrong=wrong)
    assert pose is not None
    position_m, rotation_deg = off(pose, true[UNIT])
    assert 1e-5 < position_m < 0.03
    assert 1e-5 < rotation_deg < 0.05


def test_the_information_of_a_pose_is_that_of_its_pixels_derivatives() -> None:
    true, mapper = scene(cameras=2, points=300)
    matched, state = correspondences_of_unit(mapper, UNIT), mapper.state
    pose = true[UNIT]
    views = matched.camera, state.rig_from_cam, mapper.camera_kind, state.camera_params
    found = pose_information(pose, matched.xy_px, matched.points_m, *views)

    def pixels(step: np.ndarray) -> np.ndarray:
        moved_pose = se3.transform(se3.exp_so3(step[:3]) @ pose[:3, :3], pose[:3, 3] + step[3:])
        result = np.empty((len(matched.camera), 2))
        for c, camera in enumerate(cameras_of(mapper).cameras):
            rows = matched.camera == c
            cam_from_world = se3.inverse(moved_pose @ state.rig_from_cam[c])
            result[rows] = camera.img_from_cam(se3.apply(cam_from_world, matched.points_m[rows]))
        return result.ravel()

    steps = 1e-5 * np.eye(6)
    jacobian = np.stack([(pixels(step) - pixels(-step)) / 2e-5 for step in steps], axis=1)
    np.testing.assert_allclose(found, jacobian.T @ jacobian, rtol=1e-5, atol=1e-6 * np.abs(found).max())
    assert np.linalg.eigvalsh(found)[0] > 0


def test_nothing_in_front_of_any_camera_gives_no_pose() -> None:
    true, mapper = scene(cameras=1)
    turned = true[UNIT] @ se3.transform(se3.exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    assert found(mapper, turned) is None


def test_the_expected_pose_follows_from_the_units_around() -> None:
    true, mapper = scene()
    expected = mapper.motion.expected_pose(mapper.state, mapper.registered, UNIT)
    assert expected is not None
    position_m, rotation_deg = off(expected, true[UNIT])
    assert 1e-6 < position_m < 0.1
    assert rotation_deg < 1.0
    # Between two units that are 0.1 s away: an eighth of the hardest acceleration times the square of 0.2 s, halved.
    np.testing.assert_allclose(mapper.motion.expected_sigma_m(mapper.registered, UNIT), 0.025)
    alone = np.zeros_like(mapper.registered)
    alone[0] = True
    assert mapper.motion.expected_pose(mapper.state, alone, UNIT) is None


def test_a_unit_is_registered_from_its_expected_pose_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    true, mapper = scene()
    searched = register_unit_with_search(mapper)
    monkeypatch.setattr(unit_registration, "_joint_pose", None)  # nobody may call it
    result = register_unit(mapper, UNIT)
    assert result.method == "joint"
    assert result.world_from_rig is not None
    assert searched is not None
    position_m, rotation_deg = off(result.world_from_rig, searched)
    assert position_m < 0.02
    assert rotation_deg < 0.05
    assert off(result.world_from_rig, true[UNIT])[0] < 0.03


def register_unit_with_search(mapper: Mapper) -> np.ndarray | None:
    matched = correspondences_of_unit(mapper, UNIT)
    return unit_registration.register_from_correspondences(mapper, UNIT, matched, min_inliers=20).world_from_rig
