from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation


@pytest.mark.parametrize("seed", range(3))
def test_wrong_rotations_do_not_move_the_robust_mean(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = se3.exp_so3(rng.normal(size=3))
    good = se3.exp_so3(rng.normal(size=(12, 3)) * np.radians(0.2)) @ centre
    bad = se3.exp_so3(np.radians([[0, 0, 40.0]] * 7)) @ centre
    mean = robust_mean_rotation(np.concatenate([bad, good]))
    assert 1e-4 < float(se3.rotation_angle_deg(mean @ centre.T)) < 0.35
    # The plain mean is what the robust one must not be.
    assert float(se3.rotation_angle_deg(se3.mean_rotation(np.concatenate([bad, good])) @ centre.T)) > 5


def test_the_mean_of_a_long_drive_starts_from_few_rotations() -> None:
    rng = np.random.default_rng(0)
    good = se3.exp_so3(rng.normal(size=(6000, 3)) * np.radians(0.2))
    bad = se3.exp_so3(rng.normal(size=(4000, 3)))
    rotations = np.concatenate([bad, good])
    for order in (rotations, rotations[rng.permutation(10_000)]):
        tracemalloc.start()
        mean = robust_mean_rotation(order)
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert 0 < float(se3.rotation_angle_deg(mean)) < 0.5
        assert peak_bytes < 1e9


def test_one_wrong_camera_of_three_is_outvoted() -> None:
    good = se3.exp_so3(np.radians([[0, 0, 10.0], [0, 0, 10.1]]))
    mean = robust_mean_rotation(np.concatenate([se3.exp_so3(np.radians([[0.0, 0, 13.0]])), good]))
    assert 9.9 < np.degrees(se3.log_so3(mean)[2]) < 10.3


def test_exact_rotations_give_themselves() -> None:
    rotation = se3.exp_so3([0.3, -0.2, 2.0])
    np.testing.assert_allclose(robust_mean_rotation(np.stack([rotation] * 4)), rotation, atol=1e-12)
    np.testing.assert_allclose(robust_mean_rotation(rotation[None]), rotation, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_wrong_points_do_not_move_the_geometric_median(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(15, 3)) * 0.05 + [5.0, -3.0, 1.0]
    points[:6] = [500.0, 0.0, 0.0]
    off = np.linalg.norm(geometric_median(points) - [5.0, -3.0, 1.0])
    assert 1e-4 < off < 0.2
    assert np.linalg.norm(points.mean(0) - [5.0, -3.0, 1.0]) > 100


def test_geometric_median_minimises_the_sum_of_distances() -> None:
    points = np.random.default_rng(5).normal(size=(31, 3))
    found = geometric_median(points)

    def total(at: np.ndarray) -> float:
        return float(np.linalg.norm(points - at, axis=1).sum())

    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 0.01:
        assert total(found + step) > total(found)
