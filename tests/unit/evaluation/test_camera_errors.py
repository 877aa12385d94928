from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from tests.helpers.camera_errors import compare_calibrations, compare_camera_poses

WORLD = se3.transform(se3.exp_so3([0.3, -0.4, 2.0]), [1000.0, -500.0, 20.0])


def poses(n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return se3.transform(se3.exp_so3(rng.normal(size=(n, 3))), rng.uniform(-50, 50, (n, 3)))


def test_one_wrong_camera_is_the_maximum() -> None:
    truth = poses()
    estimate = truth.copy()
    estimate[7, :3, 3] += [0.3, 0, 0.4]
    estimate[9, :3, :3] = estimate[9, :3, :3] @ se3.exp_so3([0, np.radians(2.0), 0])
    errors = compare_camera_poses(WORLD @ estimate, truth)
    assert 0.48 < errors.translation_max_m < 0.51
    assert int(errors.translation_m.argmax()) == 7
    assert 0 < errors.translation_median_m < 0.01
    assert errors.rotation_max_deg == pytest.approx(2.0, abs=0.01)
    assert int(errors.rotation_deg.argmax()) == 9
    assert 0 < errors.rotation_median_deg < 0.01


def test_scale_is_not_aligned_away() -> None:
    truth = poses()
    estimate = se3.transform(truth[:, :3, :3], truth[:, :3, 3] * 1.01)
    assert 0.3 < compare_camera_poses(estimate, truth).translation_max_m < 1.0


def test_no_or_unequal_poses_are_refused() -> None:
    for estimate, truth in ((poses(0), poses(0)), (poses(3), poses(4))):
        with pytest.raises(ValueError, match="poses"):
            compare_camera_poses(estimate, truth)


def test_calibrations_are_compared_between_cameras() -> None:
    names = ("front", "left", "right")
    truth = {name: se3.transform(p[:3, :3], p[:3, 3] / 50) for name, p in zip(names, poses(3), strict=True)}
    gauge = se3.transform(se3.exp_so3([0, 0.05, 0]), [0.1, 0, 0])
    # A motion of the whole camera set is a gauge, a turn of one camera is not.
    estimate = {name: gauge @ pose for name, pose in truth.items()}
    estimate["left"] = estimate["left"] @ se3.transform(se3.exp_so3([np.radians(0.2), 0, 0]), [0, 0.01, 0])
    estimate["not-in-truth"] = np.eye(4)
    errors = {(e.camera_a, e.camera_b): e for e in compare_calibrations(estimate, truth)}
    assert set(errors) == {("front", "left"), ("front", "right"), ("left", "right")}
    assert errors["front", "left"].rotation_deg == pytest.approx(0.2)
    assert errors["left", "right"].rotation_deg == pytest.approx(0.2)
    assert errors["front", "right"].rotation_deg < 1e-6
    assert errors["front", "left"].translation_m == pytest.approx(0.01)


def test_one_common_camera_is_not_enough() -> None:
    with pytest.raises(ValueError, match="two cameras"):
        compare_calibrations({"a": np.eye(4), "b": np.eye(4)}, {"a": np.eye(4), "c": np.eye(4)})
