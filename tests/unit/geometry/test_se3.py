from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from mrasfm_engine.geometry import se3

ANGLES_RAD = [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 0.01, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi]


def random_axes(count: int, seed: int = 0) -> np.ndarray:
    axes = np.random.default_rng(seed).normal(size=(count, 3))
    axes = np.concatenate([axes, np.eye(3), -np.eye(3)])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def random_transforms(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.transform(se3.exp_so3(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)) * 10)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_exp_and_log_agree_with_scipy_at_every_angle(angle_rad: float) -> None:
    vectors = random_axes(50) * angle_rad
    rotations = se3.exp_so3(vectors)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (56, 1, 1)), atol=1e-14)
    logs = se3.log_so3(rotations)
    assert np.linalg.norm(logs, axis=1).max() <= np.pi + 1e-12
    if angle_rad < np.pi - 1e-9:
        # Absolute, so small angles have to come back with the same relative precision as the matrix can hold.
        np.testing.assert_allclose(logs, vectors, atol=1e-14 if angle_rad < 1 else 1e-9)
    # At a half turn both signs are right.
    np.testing.assert_allclose(se3.exp_so3(logs), rotations, atol=1e-12)
    np.testing.assert_allclose(se3.rotation_angle_deg(rotations), np.degrees(angle_rad), atol=1e-7)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-5, 0.9e-4, 1.1e-4, 0.3, 2.0, 3.1])
def test_twists_and_transforms_agree_with_the_matrix_exponential(angle_rad: float) -> None:
    rng = np.random.default_rng(1)
    axis = rng.normal(size=(10, 3))
    twist = np.concatenate(
        [angle_rad * axis / np.linalg.norm(axis, axis=1, keepdims=True), 3 * rng.normal(size=(10, 3))], axis=1
    )
    generator = np.zeros((10, 4, 4))
    generator[:, :3, :3], generator[:, :3, 3] = se3.skew(twist[:, :3]), twist[:, 3:]
    moved = se3.exp_se3(twist)
    np.testing.assert_allclose(moved, scipy.linalg.expm(generator), atol=1e-12)


def test_small_and_large_angles_meet_at_the_threshold() -> None:
    for angle in (0.999e-6, 1.001e-6):
        exact = np.array([[1, -angle, 0], [angle, 1, 0], [0, 0, 1]])
        assert 0 < np.abs(se3.exp_so3([0, 0, angle]) - exact).max() < 1e-12


def test_quaternions_are_xyzw_as_scipys() -> None:
    rotations = se3.exp_so3(np.concatenate([random_axes(60) * a for a in (1e-8, 1.0, np.pi - 1e-8, np.pi)]))
    ours, theirs = se3.quaternion_from_rotation(rotations), Rotation.from_matrix(rotations).as_quat()
    np.testing.assert_allclose(np.abs((ours * theirs).sum(1)), 1.0, atol=1e-12)
    assert (ours[:, 3] >= 0).all()
    np.testing.assert_allclose(se3.rotation_from_quaternion(ours), rotations, atol=1e-12)
    np.testing.assert_allclose(se3.quaternion_from_rotation(np.eye(3)), [0, 0, 0, 1])
    np.testing.assert_allclose(
        se3.quaternion_from_rotation(se3.exp_so3([0, 0, np.pi / 2])), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15
    )


@pytest.mark.parametrize("shape", [(), (0,), (6,), (2, 3), (2, 0), (1, 2, 3)])
def test_rotations_have_any_number_of_batch_dimensions(shape: tuple[int, ...]) -> None:
    vectors = 0.9 * random_axes(6)[: int(np.prod(shape))].reshape(*shape, 3)
    rotations = se3.exp_so3(vectors)
    assert se3.quaternion_from_rotation(rotations).shape == (*shape, 4)
    np.testing.assert_allclose(se3.log_so3(rotations), vectors, atol=1e-14)


def test_quaternions_are_normalised_first() -> None:
    quaternion = np.array([[0.1, -0.2, 0.3, 0.9]])
    np.testing.assert_allclose(
        se3.rotation_from_quaternion(7.0 * quaternion), Rotation.from_quat(quaternion).as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_about_the_axes_have_a_quaternion(axis: int) -> None:
    # Trace -1: the division by w that most implementations start with is impossible here.
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    expected = np.zeros(4)
    expected[axis] = 1.0
    np.testing.assert_allclose(np.abs(se3.quaternion_from_rotation(rotation)), expected, atol=1e-15)
    np.testing.assert_allclose(np.abs(se3.log_so3(rotation)), np.pi * expected[:3], atol=1e-12)


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 20, 3))
    np.testing.assert_allclose((se3.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


def test_inverse_and_apply() -> None:
    a_from_b, b_from_c = random_transforms(20), random_transforms(20, seed=1)
    np.testing.assert_allclose(se3.inverse(a_from_b), np.linalg.inv(a_from_b), atol=1e-12)
    points = np.random.default_rng(2).normal(size=(20, 7, 3))
    homogeneous = np.concatenate([points, np.ones((20, 7, 1))], -1)
    expected = (homogeneous @ np.swapaxes(a_from_b, 1, 2))[..., :3]
    np.testing.assert_allclose(se3.apply(a_from_b, points), expected, atol=1e-12)
    np.testing.assert_allclose(
        se3.apply(a_from_b @ b_from_c, points), se3.apply(a_from_b, se3.apply(b_from_c, points)), atol=1e-11
    )
    np.testing.assert_allclose(se3.apply(se3.inverse(a_from_b), se3.apply(a_from_b, points)), points, atol=1e-12)
    np.testing.assert_allclose(se3.apply(a_from_b[0], points[0]), expected[0], atol=1e-12)


def test_transform_broadcasts() -> None:
    result = se3.transform(np.eye(3), np.arange(6.0).reshape(2, 3))
    assert result.shape == (2, 4, 4)
    np.testing.assert_array_equal(result[1], [[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]])


def test_mean_rotation_minimises_the_chordal_distance() -> None:
    rng = np.random.default_rng(3)
    centre = se3.exp_so3(rng.normal(size=3))
    rotations = se3.exp_so3(rng.normal(size=(200, 3)) * 0.1) @ centre
    mean = se3.mean_rotation(rotations)
    assert np.linalg.det(mean) == pytest.approx(1.0)
    assert 0.01 < float(se3.rotation_angle_deg(mean @ centre.T)) < 3 * np.degrees(0.1) * np.sqrt(3 / 200)
    distance = ((rotations - mean) ** 2).sum()
    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 0.01:
        assert ((rotations - se3.exp_so3(step) @ mean) ** 2).sum() > distance


def test_mean_rotation_follows_weights() -> None:
    a, b = np.eye(3), se3.exp_so3([0, 0, 1.0])
    np.testing.assert_allclose(se3.mean_rotation([a, b]), se3.exp_so3([0, 0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(se3.mean_rotation([a, b], [0.0, 2.0]), b, atol=1e-12)
    leaning = se3.log_so3(se3.mean_rotation([a, b], [3.0, 1.0]))
    assert 0.2 < leaning[2] < 0.3


def test_slerp_goes_the_short_way_at_constant_speed() -> None:
    a, b = se3.exp_so3(np.random.default_rng(4).normal(size=(2, 3)))
    angle = float(se3.rotation_angle_deg(a.T @ b))
    fractions = np.array([0.0, 0.25, 0.5, 1.0])
    path = se3.slerp(a, b, fractions)
    np.testing.assert_allclose(path[[0, -1]], [a, b], atol=1e-12)
    np.testing.assert_allclose(se3.rotation_angle_deg(a.T @ path), fractions * angle, atol=1e-9)
    almost_around = se3.slerp(np.eye(3), se3.exp_so3([0, 0, np.radians(350)]), 0.5)
    np.testing.assert_allclose(se3.log_so3(almost_around), [0, 0, np.radians(-5)], atol=1e-12)


def test_poses_are_interpolated_and_held_beyond_their_ends() -> None:
    poses = se3.transform(se3.exp_so3([[0, 0, 0.0], [0, 0, 0.2], [0, 0, 0.6]]), [[0, 0, 0], [2, 0, 0], [2, 4, 0.0]])
    times = np.array([0, 100, 300])
    found = se3.interpolate(times, poses, np.array([-50, 0, 50, 100, 150, 300, 400]))
    np.testing.assert_allclose(found[:, 0, 3], [0, 0, 1, 2, 2, 2, 2], atol=1e-12)
    np.testing.assert_allclose(found[:, 1, 3], [0, 0, 0, 0, 1, 4, 4], atol=1e-12)
    np.testing.assert_allclose(se3.log_so3(found[:, :3, :3])[:, 2], [0, 0, 0.1, 0.2, 0.3, 0.6, 0.6], atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(times[:1], poses[:1], np.array([-1, 0, 9])), poses[[0, 0, 0]])
