from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping import unit_registration
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.per_camera_pnp import largest_agreement
from mrasfm_engine.mapping.unit_registration import (
    camera_votes,
    cameras_of,
    correspondences_of_unit,
    matrix_of,
    pose_covariance,
    register_unit,
    rigid3d,
)
from tests.helpers.simulated_drive import SimulatedDrive, enlarged, make_model, make_simulated_drive, with_true_poses

UNIT = 5


def errors(pose: np.ndarray, simulated: SimulatedDrive, unit: int = UNIT) -> tuple[float, float]:
    """Position error (m) and rotation error (deg) of a unit's pose."""
    true = simulated.world_from_rig[unit]
    turn = float(se3.rotation_angle_deg(pose[:3, :3] @ true[:3, :3].T))
    return float(np.linalg.norm(pose[:3, 3] - true[:3, 3])), turn


def scene(**kwargs: object) -> tuple[SimulatedDrive, Mapper]:
    """All units but one at their true poses, with points."""
    simulated = make_simulated_drive(**{"units": 9, "cameras": 6, "points": 1500, **kwargs})
    mapper = make_model(simulated)
    return simulated, with_true_poses(mapper, simulated, [u for u in range(9) if u != UNIT])


def larger_scene(factor: int) -> tuple[SimulatedDrive, Mapper]:
    """The same by sensors of more pixels."""
    simulated = enlarged(make_simulated_drive(units=9, cameras=6, points=1500), factor)
    return simulated, with_true_poses(make_model(simulated), simulated, [u for u in range(9) if u != UNIT])


def turn_camera(mapper: Mapper, camera: int, deg: float) -> None:
    """The manifest's calibration of a camera is wrong, points come from the others."""
    mapper.state.camera_rotation[camera] = (
        se3.exp_so3(np.radians([0.0, 0.0, deg])) @ mapper.state.camera_rotation[camera]
    )


@pytest.mark.parametrize("cameras", [1, 2, 6])
def test_a_unit_is_registered_over_all_its_cameras(cameras: int) -> None:
    simulated, mapper = scene(cameras=cameras)
    result = register_unit(mapper, UNIT)
    assert result.method == "joint"
    assert result.voted_out == ()
    assert result.reason == ""
    assert result.world_from_rig is not None
    position_m, rotation_deg = errors(result.world_from_rig, simulated)
    assert 1e-5 < position_m < 0.05
    assert 1e-5 < rotation_deg < 0.1
    assert 0.9 * result.correspondences < result.inliers <= result.correspondences
    assert not mapper.registered[UNIT]  # the caller decides


@pytest.mark.parametrize("camera", [0, 5])
@pytest.mark.parametrize("error_deg", [3.0, 15.0])
def test_a_camera_with_a_wrong_extrinsic_is_voted_out_by_name(camera: int, error_deg: float) -> None:
    simulated, mapper = scene()
    turn_camera(mapper, camera, error_deg)
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    assert result.voted_out == (simulated.drive.cameras[camera].name,)
    position_m, rotation_deg = errors(result.world_from_rig, simulated)
    assert 1e-5 < position_m < 0.1
    assert 1e-5 < rotation_deg < 0.3


@pytest.mark.parametrize("turned", [{}, {5: 3.0}, {0: 1.0, 2: 1.0}])
def test_the_same_drive_in_more_pixels_is_registered_alike(turned: dict[int, float]) -> None:
    found = []
    for factor in (1, 2, 4):
        simulated, mapper = larger_scene(factor)
        for camera, deg in turned.items():
            turn_camera(mapper, camera, deg)
        result = register_unit(mapper, UNIT)
        assert result.world_from_rig is not None
        assert errors(result.world_from_rig, simulated)[0] < 0.1
        found.append(result)
    assert len({(r.method, r.voted_out, r.unclear) for r in found}) == 1
    shares = [r.inliers / r.correspondences for r in found]
    assert max(shares) - min(shares) < 0.05
    assert min(shares) > 0.5


def test_cameras_that_are_off_as_their_prior_says_are_not_voted_out() -> None:
    """3 deg are too much where all others agree, and not where all are off by some degrees."""
    for others_deg, agrees in ((0.0, False), (1.5, True)):
        simulated, mapper = scene()
        rng = np.random.default_rng(4)
        for camera in range(6):
            turn = np.array([0.0, 0.0, 3.0]) if camera == 0 else rng.normal(size=3) * others_deg
            mapper.state.camera_rotation[camera] = se3.exp_so3(np.radians(turn)) @ mapper.state.camera_rotation[camera]
        votes = camera_votes(mapper, correspondences_of_unit(mapper, UNIT))
        agreement = largest_agreement(votes)
        assert agreement is not None
        assert [v.camera for v in votes] == list(range(6))
        assert agreement.agreeing[0] == agrees
        assert agreement.agreeing[1:].all()
        assert 1e-4 < errors(agreement.world_from_rig, simulated)[1] < 1.5


@pytest.mark.slow
def test_votes_err_as_their_covariances_say() -> None:
    squares = []
    for seed in range(8):
        simulated, mapper = scene(seed=seed)
        true = simulated.world_from_rig[UNIT]
        for vote in camera_votes(mapper, correspondences_of_unit(mapper, UNIT)):
            turn = se3.log_so3(vote.world_from_rig[:3, :3] @ true[:3, :3].T)
            step = np.concatenate([turn, vote.world_from_rig[:3, 3] - true[:3, 3]])
            squares.append(step @ np.linalg.solve(vote.pnp_covariance, step))
    # Points are as good as noise leaves them here: an image says more than the few observations that it counts for.
    assert 0.02 * 6 < np.mean(squares) < 6


def test_more_points_make_a_pose_no_surer_than_lens_models_allow() -> None:
    simulated, mapper = scene(cameras=1)
    matched, pose = correspondences_of_unit(mapper, UNIT), simulated.world_from_rig[UNIT]
    sigmas = [
        np.sqrt(np.diagonal(pose_covariance(mapper, pose, matched.select(np.arange(0, len(matched.camera), step)))))
        for step in (1, 4)
    ]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.35)
    assert (np.degrees(sigmas[0][:3]) > 0.01).all()
    assert (np.degrees(sigmas[0][:3]) < 0.2).all()
    few = pose_covariance(mapper, pose, matched.select(np.arange(3)))
    assert (np.sqrt(np.diagonal(few)) > 1.5 * sigmas[0]).any()


def test_an_occluded_camera_gets_its_pose_from_the_unit() -> None:
    simulated, mapper = scene(hidden=lambda unit, camera: camera == 0 and unit >= 4)
    names = [c.name for c in simulated.drive.cameras]
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    assert names[0] not in result.voted_out  # it sees nothing: it is not wrong
    assert errors(result.world_from_rig, simulated)[0] < 0.05
    mapper.set_pose(UNIT, result.world_from_rig)
    camera_pose = mapper.state.world_from_rig[UNIT] @ mapper.state.rig_from_cam[0]
    true = simulated.world_from_rig[UNIT] @ simulated.truth.rig_from_cam[0]
    assert 1e-6 < np.linalg.norm(camera_pose[:3, 3] - true[:3, 3]) < 0.05


def test_where_the_joint_pose_fails_the_cameras_vote(monkeypatch: pytest.MonkeyPatch) -> None:
    simulated, mapper = scene()
    monkeypatch.setattr(unit_registration, "_joint_pose", lambda mapper, matched: None)
    monkeypatch.setattr(unit_registration, "_as_expected", lambda *_: None)
    result = register_unit(mapper, UNIT)
    assert result.method == "vote"
    assert result.voted_out == result.unclear == ()
    assert result.world_from_rig is not None
    position_m, rotation_deg = errors(result.world_from_rig, simulated)
    assert 1e-5 < position_m < 0.05
    assert 1e-5 < rotation_deg < 0.1


def test_two_cameras_against_two() -> None:
    """Two are turned alike, so each half agrees in itself: the pose is that of one half, never in between."""
    simulated, mapper = scene(cameras=4)
    for camera in (1, 2):
        turn_camera(mapper, camera, 6.0)
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    names = [c.name for c in simulated.drive.cameras]
    assert set(result.voted_out) in ({names[1], names[2]}, {names[0], names[3]})
    turn = errors(result.world_from_rig, simulated)[1]
    assert turn < 0.3 or 5.7 < turn < 6.3


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("of_unit", [2, 4, 7])
def test_an_image_of_another_instant_does_not_move_a_unit_of_two_cameras(camera: int, of_unit: int) -> None:
    """It repeats an image of the scene, so that more of its points fit than of the right one."""
    simulated = make_simulated_drive(units=9, cameras=2, points=1500)
    at, late = (2 * unit + camera for unit in (UNIT, of_unit))
    for of_images in (simulated.features, simulated.point_of_keypoint):
        of_images[at] = of_images[late]
    mapper = with_true_poses(make_model(simulated), simulated, [u for u in range(9) if u != UNIT])
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    assert result.voted_out == (simulated.drive.cameras[camera].name,)
    assert 1e-5 < errors(result.world_from_rig, simulated)[0] < 0.1


def test_all_cameras_but_one_are_covered() -> None:
    """What covers them shows points that fit no pose of the unit; they have no vote, and are not called wrong."""
    simulated, mapper = scene()
    names = [c.name for c in simulated.drive.cameras]
    rng = np.random.default_rng(3)
    rows = mapper.rows_of_unit[UNIT]
    nonsense = rows[mapper.keypoints.camera[rows] != 0]
    mapper.keypoints.xy_px[nonsense] = rng.uniform(0, 1, (len(nonsense), 2)) * [960, 540]
    keep = np.concatenate([rows[mapper.keypoints.camera[rows] == 0], nonsense[::2]])
    mapper.rows_of_unit[UNIT] = np.sort(keep)
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    position_m, rotation_deg = errors(result.world_from_rig, simulated)
    assert 1e-5 < position_m < 0.15
    assert 1e-5 < rotation_deg < 0.3
    assert result.voted_out == ()
    assert set(result.unclear) == set(names[1:])


def test_wrong_correspondences_are_outvoted() -> None:
    simulated, mapper = scene()
    rng = np.random.default_rng(0)
    rows = mapper.rows_of_unit[UNIT]
    wrong = rng.choice(rows, int(0.4 * len(rows)), replace=False)
    mapper.keypoints.xy_px[wrong] = rng.uniform(0, 1, (len(wrong), 2)) * [960, 540]
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is not None
    assert errors(result.world_from_rig, simulated)[0] < 0.05
    assert 0.5 < result.inliers / result.correspondences < 0.72


def test_too_few_points_are_a_reason_not_an_error() -> None:
    _, mapper = scene(hidden=lambda unit, camera: unit == UNIT and camera != 2)
    rows = mapper.rows_of_unit[UNIT]
    mapper.triangulated[mapper.tracks.of_keypoint[rows[10:]]] = False
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is None
    assert result.method == "none"
    assert result.correspondences <= 10
    assert f"sees {result.correspondences} points" in result.reason
    assert "20 are needed" in result.reason


def test_points_that_fit_no_pose_are_a_reason() -> None:
    _, mapper = scene()
    rng = np.random.default_rng(1)
    rows = mapper.rows_of_unit[UNIT]
    mapper.keypoints.xy_px[rows] = rng.uniform(0, 1, (len(rows), 2)) * [960, 540]
    result = register_unit(mapper, UNIT)
    assert result.world_from_rig is None
    assert "agree with one pose" in result.reason
    least = int(np.ceil(mapper.config.mapping.min_pnp_inlier_ratio * result.correspondences))
    assert result.reason.endswith(f", {least} are needed")
    assert result.inliers < 0.2 * result.correspondences


def test_registration_is_repeatable() -> None:
    _, mapper = scene()
    a, b = register_unit(mapper, UNIT), register_unit(mapper, UNIT)
    assert a.world_from_rig is not None
    np.testing.assert_array_equal(a.world_from_rig, b.world_from_rig)


def test_poses_go_to_pycolmap_and_back() -> None:
    pose = se3.transform(se3.exp_so3([0.1, -2.0, 0.4]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(matrix_of(rigid3d(pose)), pose, atol=1e-12)
    simulated, mapper = scene(cameras=2, points=300)
    cameras = cameras_of(mapper).cameras
    assert [c.model.name for c in cameras] == ["PINHOLE"] * 2
    np.testing.assert_allclose(cameras[1].params, simulated.truth.camera_params[1])
