from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera
from mrasfm_engine.geometry.frustum import frustum_samples, view_overlap

WIDTH, HEIGHT, DEPTH_M = 800, 600, 50.0
RIG_FROM_FORWARD_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def camera_at(x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.transform(se3.exp_so3([0, 0, np.radians(yaw_deg)]) @ RIG_FROM_FORWARD_CAM, [x_m, y_m, 1.5])


def overlap(*poses: np.ndarray, pairs: list[tuple[int, int]] | None = None, focal_px: float = 400.0) -> np.ndarray:
    kind, params = pack_camera("PINHOLE", [focal_px, focal_px, WIDTH / 2, HEIGHT / 2])
    return view_overlap(
        np.array(pairs or [(0, 1)], dtype=np.int64),
        world_from_cam=np.stack(poses),
        camera=np.zeros(len(poses), dtype=np.int64),
        kind=np.array([kind], dtype=np.int64),
        params=params[None],
        size_px=np.array([[WIDTH, HEIGHT]], dtype=np.int64),
        max_depth_m=DEPTH_M,
    )


def test_samples_fill_the_frustum() -> None:
    kind, params = pack_camera("PINHOLE", [400.0, 400.0, 400.0, 300.0])
    samples = frustum_samples(kind, params, WIDTH, HEIGHT, DEPTH_M)
    assert samples.shape[1] == 3
    distance = np.linalg.norm(samples, axis=1)
    assert distance.max() == pytest.approx(DEPTH_M)
    assert 1.0 < distance.min() < 0.2 * DEPTH_M
    a, b = samples[:, 0] / samples[:, 2], samples[:, 1] / samples[:, 2]
    assert 0.6 < np.abs(a).max() < 1.0  # the edge of the image is at 1.0
    assert 0.4 < np.abs(b).max() < 0.75


def test_a_view_overlaps_itself_completely() -> None:
    assert overlap(camera_at(), camera_at())[0] == 1.0


@pytest.mark.parametrize("yaw_deg", [180.0, 120.0])
def test_views_in_other_directions_do_not_overlap(yaw_deg: float) -> None:
    assert overlap(camera_at(), camera_at(yaw_deg=yaw_deg))[0] == 0.0


def test_cameras_back_to_back_apart_do_not_overlap() -> None:
    assert overlap(camera_at(), camera_at(x_m=-2.0, yaw_deg=180.0))[0] == 0.0


def test_folded_distortion_sees_nothing_beyond_its_fold() -> None:
    """Two cameras of 50 deg that look 60 deg apart: their frustums do not meet, but the formula of the distortion maps
    what lies 58 deg off an axis back into the image."""
    params = [1000.0, 1000.0, 466.0, 350.0, -0.32, 0.0, 0.0, 0.0]
    kind, packed = pack_camera("OPENCV", params)
    width, height = 932, 700
    camera = pycolmap.Camera(model="OPENCV", width=width, height=height, params=params)
    off = np.radians(58.0)
    u, v = camera.img_from_cam(np.array([[np.sin(off), 0.0, np.cos(off)]]))[0]
    assert 0 < u < width, "the formula alone is fooled"
    assert 0 < v < height
    found = {
        yaw_deg: view_overlap(
            np.array([[0, 1]]),
            world_from_cam=np.stack([camera_at(), camera_at(yaw_deg=yaw_deg)]),
            camera=np.zeros(2, dtype=np.int64),
            kind=np.array([kind], dtype=np.int64),
            params=packed[None],
            size_px=np.array([[width, height]], dtype=np.int64),
            max_depth_m=DEPTH_M,
        )[0]
        for yaw_deg in (10.0, 55.0, 60.0, 75.0)
    }
    assert found[10.0] > 0.4
    assert [found[yaw_deg] for yaw_deg in (55.0, 60.0, 75.0)] == [0.0] * 3


def test_a_turn_by_half_the_view_halves_the_overlap() -> None:
    # 90 degrees across; of 5 rays across at -38.7, -21.8, 0, 21.8, 38.7 degrees, two and a half stay.
    assert 0.3 < overlap(camera_at(), camera_at(yaw_deg=45.0))[0] < 0.65


def test_overlap_falls_with_distance_and_is_symmetric() -> None:
    poses = [camera_at(x_m=x) for x in (0.0, 2.0, 10.0, 30.0, 200.0)]
    pairs = [(0, k) for k in range(5)]
    found = overlap(*poses, pairs=pairs)
    assert (np.diff(found) < 0).all()
    assert found[-1] == 0.0
    assert 0.3 < found[2] < 0.95
    np.testing.assert_array_equal(found, overlap(*poses, pairs=[(b, a) for a, b in pairs]))


def test_moving_the_world_changes_nothing() -> None:
    poses = np.stack([camera_at(), camera_at(x_m=6.0, y_m=1.0, yaw_deg=20.0)])
    moved = se3.transform(se3.exp_so3([0.3, -0.5, 2.0]), [100.0, -50.0, 7.0]) @ poses
    np.testing.assert_allclose(overlap(*moved), overlap(*poses), atol=1e-12)
    assert 0.1 < overlap(*poses)[0] < 0.95
