from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.local_motion import (
    MAX_ACCELERATION_MPS2,
    MAX_GAP_S,
    REACH,
    local_motion,
    smoothed_velocity,
    third_differences,
)

TWIST = np.array([0.05, -0.02, 0.6, 8.0, 0.3, -0.1])  # rad/s and m/s: a turn with some roll and climb
START = se3.transform(se3.exp_so3([0.1, 0.2, -1.0]), [3.0, -4.0, 1.0])


def driven(time_s: np.ndarray, twist: np.ndarray = TWIST) -> np.ndarray:
    return START @ se3.exp_se3(time_s[:, None] * twist)


def all_known(time_s: np.ndarray) -> np.ndarray:
    return np.ones(len(time_s), dtype=np.bool_)


@pytest.mark.parametrize("offset_s", [-0.05, -0.01, 0.0, 0.03, 0.05])
@pytest.mark.parametrize("unit", [0, 3, 7])
def test_a_steady_turn_is_followed_inside_and_at_both_ends(unit: int, offset_s: float) -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.5, 0.62, 0.7])
    motion = local_motion(driven(time_s), time_s, all_known(time_s))
    found = motion.at(np.array([unit]), np.array([offset_s]))[0]
    expected = se3.exp_se3(offset_s * TWIST)
    np.testing.assert_allclose(found[:3, :3], expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], expected[:3, 3], atol=1e-3)  # a line would be 6 mm off
    assert motion.known.all()


def test_velocities_are_derivatives_of_the_motion_in_the_axes_of_their_time() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.35, 0.4])
    motion = local_motion(driven(time_s), time_s, all_known(time_s))
    unit, offset_s, step_s = np.array([0, 2, 4, 2]), np.array([-0.05, 0.04, 0.03, 0.0]), 1e-5
    before, now, after = (motion.at(unit, offset_s + by_s) for by_s in (-step_s, 0.0, step_s))
    numeric = se3.log_so3(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * step_s)
    found = motion.velocity_at(unit, offset_s)
    np.testing.assert_allclose(found[:, :3], numeric, atol=1e-3)
    numeric = np.swapaxes(now[:, :3, :3], 1, 2) @ (after - before)[:, :3, 3, None] / (2 * step_s)
    np.testing.assert_allclose(found[:, 3:], numeric[..., 0], atol=1e-6)
    assert not motion.velocity_at(np.array([2]), np.array([1.0])).any()


def test_third_differences_say_what_a_parabola_leaves_out() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.5])
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = 7.0 * time_s - 3.0 * time_s**2 + 5.0 * time_s**3
    motion = local_motion(poses, time_s, all_known(time_s))
    found = third_differences(poses, time_s, motion)
    np.testing.assert_allclose(found[1:-1, 3], 5.0)
    assert not found[[0, -1]].any()
    unit, t = 3, 0.02
    a, b = motion.support_s[unit]
    at = time_s[unit] + t
    place_m = poses[unit, 0, 3] + motion.at(np.array([unit]), np.array([t]))[0, 0, 3] + t * (t - a) * (t - b) * 5.0
    assert place_m == pytest.approx(7.0 * at - 3.0 * at**2 + 5.0 * at**3)


def test_places_follow_a_scaling_of_the_whole_way_exactly() -> None:
    """Else a turn would seem to tell the scale."""
    time_s = np.arange(8) * 0.1
    poses, unit, offset_s = driven(time_s), np.array([0, 3, 7]), np.array([0.05, -0.04, 0.03])
    places = (poses[unit] @ local_motion(poses, time_s, all_known(time_s)).at(unit, offset_s))[:, :3, 3]
    poses[:, :3, 3] *= 1.1
    scaled = (poses[unit] @ local_motion(poses, time_s, all_known(time_s)).at(unit, offset_s))[:, :3, 3]
    np.testing.assert_allclose(scaled, 1.1 * places, atol=1e-12)


def test_constant_acceleration_on_a_line_is_exact_between_neighbours() -> None:
    time_s = np.array([0.0, 0.1, 0.25])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 5.0 * time_s + 0.5 * 3.0 * time_s**2
    motion = local_motion(poses, time_s, all_known(time_s))
    at = motion.at(np.array([1, 1]), np.array([-0.04, 0.05]))
    expected = [5.0 * t + 1.5 * t**2 - poses[1, 0, 3] for t in (0.06, 0.15)]
    np.testing.assert_allclose(at[:, 0, 3], expected, atol=1e-12)


def test_a_gap_is_bridged_and_a_far_one_is_not() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 10.0])
    known = np.array([True, False, True, False, True, True])
    poses = driven(time_s)
    poses[~known] = np.eye(4)
    motion = local_motion(poses, time_s, known)
    at = motion.at(np.array([2]), np.array([0.04]))[0]
    np.testing.assert_allclose(at, se3.exp_se3(0.04 * TWIST), atol=1e-3)
    assert time_s[5] - time_s[4] > MAX_GAP_S
    assert motion.known.tolist() == [True, False, True, False, True, False]
    np.testing.assert_array_equal(motion.at(np.array([1, 5]), np.array([0.05, 0.05])), np.tile(np.eye(4), (2, 1, 1)))


def test_a_parabola_goes_on_beyond_the_neighbours() -> None:
    """Else a camera that is late by more than an interval would not say so."""
    time_s = np.arange(4) * 0.1
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 5.0 * time_s + 0.5 * 3.0 * time_s**2
    motion = local_motion(poses, time_s, all_known(time_s))
    unit, offset_s = np.array([1, 2]), np.array([0.19, -0.19])
    np.testing.assert_allclose(
        poses[unit, 0, 3] + motion.at(unit, offset_s)[:, 0, 3],
        5.0 * (time_s[unit] + offset_s) + 1.5 * (time_s[unit] + offset_s) ** 2,
    )
    np.testing.assert_allclose(motion.velocity_at(unit, offset_s)[:, 3], 5.0 + 3.0 * (time_s[unit] + offset_s))


@pytest.mark.parametrize(("unit", "back_s", "ahead_s"), [(0, 0.1, 0.2), (1, 0.1 * REACH, 0.1 * REACH), (2, 0.2, 0.1)])
def test_nothing_is_said_of_times_far_beyond_the_neighbours(unit: int, back_s: float, ahead_s: float) -> None:
    """At the drive's ends there is no neighbour on one side, and noise grows fast towards there."""
    time_s = np.array([0.0, 0.1, 0.2])
    motion = local_motion(driven(time_s), time_s, all_known(time_s))
    units, far_s = np.array([unit, unit]), np.array([-5.0, 5.0])
    np.testing.assert_array_equal(motion.at(units, far_s), motion.at(units, np.array([-back_s, ahead_s])))
    assert not motion.velocity_at(units, far_s).any()


def test_poses_at_almost_the_same_time_do_not_turn_noise_into_speed() -> None:
    time_s = np.array([0.0, 0.1, 0.1001, 0.2])
    poses = driven(time_s)
    poses[2, :3, 3] += 0.02
    velocity = local_motion(poses, time_s, all_known(time_s)).velocity[1]
    np.testing.assert_allclose(velocity, TWIST, atol=0.01)


def test_a_neighbour_that_is_far_off_asks_for_an_acceleration_that_is_not_believed() -> None:
    time_s = np.arange(3) * 0.1
    poses = driven(time_s)
    poses[2, :3, 3] += [3.0, 0.0, 0.0]
    motion = local_motion(poses, time_s, all_known(time_s))
    bend = float(np.linalg.norm(motion.bend[1, 3:]))
    assert bend == pytest.approx(MAX_ACCELERATION_MPS2 / 2)


def test_a_standing_car_does_not_move() -> None:
    time_s = np.arange(4) * 0.1
    motion = local_motion(np.tile(START, (4, 1, 1)), time_s, all_known(time_s))
    np.testing.assert_allclose(motion.at(np.arange(4), np.full(4, 0.05)), np.tile(np.eye(4), (4, 1, 1)), atol=1e-12)


def test_velocity_of_noisy_poses_is_averaged_and_unknown_where_nothing_is_known() -> None:
    time_s = np.arange(40) * 0.1
    rng = np.random.default_rng(0)
    twist = np.array([0.0, 0.0, 0.1, 8.0, 0.0, 0.0])
    poses = driven(time_s, twist)
    poses[:, :3, 3] += 0.3 * rng.normal(size=(40, 3))
    poses[:5] = np.nan
    velocity = smoothed_velocity(poses, time_s, window_s=1.0)
    assert np.isnan(velocity[:5]).all()
    error = np.linalg.norm(velocity[15:30, 3:] - twist[3:], axis=1)
    assert 0.005 < np.median(error) < 0.4  # from one unit to the next it would be 4 m/s
    np.testing.assert_allclose(velocity[15:30, :3], np.tile(twist[:3], (15, 1)), atol=1e-9)


def test_weights_tell_how_the_pose_follows_its_neighbours() -> None:
    time_s = np.array([0.0, 0.1, 0.25, 0.33])
    poses = driven(time_s, np.array([0.0, 0.0, 0.0, 8.0, 0.0, 0.0]))
    motion = local_motion(poses, time_s, all_known(time_s))
    unit, offset_s = np.array([0, 1, 2, 3, 1]), np.array([-0.04, 0.05, -0.06, 0.03, 0.0])
    weight, support = motion.weights(unit, offset_s), motion.support[unit]
    np.testing.assert_array_equal(np.sort(support, axis=1), [[0, 1, 2], [0, 1, 2], [1, 2, 3], [1, 2, 3], [0, 1, 2]])
    np.testing.assert_allclose(weight.sum(1), 1.0)
    np.testing.assert_array_equal(weight[4], [1.0, 0.0, 0.0])
    before = (poses[unit] @ motion.at(unit, offset_s))[:, :3, 3]
    for other in range(4):
        moved = poses.copy()
        moved[other, :3, 3] += [1e-4, 2e-4, -1e-4]
        after = (moved[unit] @ local_motion(moved, time_s, all_known(time_s)).at(unit, offset_s))[:, :3, 3]
        share = np.where(support == other, weight, 0.0).sum(1)
        np.testing.assert_allclose(after - before, share[:, None] * [1e-4, 2e-4, -1e-4], atol=1e-9)
    alone = local_motion(poses, time_s, np.array([False, True, True, False]))
    np.testing.assert_allclose(alone.weights(np.array([1, 0]), np.array([0.03, 0.03])), [[0.8, 0.2, 0.0], [1, 0, 0]])
