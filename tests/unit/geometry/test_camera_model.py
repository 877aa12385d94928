from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.geometry.camera_model import (
    PARAMETERS,
    largest_angle_rad,
    pack_camera,
    pack_cameras,
    project,
    project_points,
    unpack_camera,
    unproject_pixels,
)
from schemas import CAMERA_MODELS, Camera, Pose

WIDTH, HEIGHT = 960, 600
PARAMS = {
    "SIMPLE_PINHOLE": [700.0, 470.0, 310.0],
    "PINHOLE": [700.0, 710.0, 470.0, 310.0],
    "SIMPLE_RADIAL": [700.0, 470.0, 310.0, -0.08],
    "RADIAL": [700.0, 470.0, 310.0, -0.09, 0.03],
    "OPENCV": [700.0, 710.0, 470.0, 310.0, -0.09, 0.025, 0.0016, -0.0014],
    "OPENCV_FISHEYE": [330.0, 335.0, 470.0, 310.0, 0.02, -0.008, 0.002, -0.0005],
    "FULL_OPENCV": [700.0, 710.0, 470.0, 310.0, -0.2, 0.05, 0.0016, -0.0014, 0.01, -0.1, 0.02, 0.003],
    # The order of a KITTI-360 fisheye.
    "MEI": [1300.0, 1310.0, 470.0, 310.0, 0.016, 1.6, 0.0006, -0.0004, 2.2],
}
MODELS = sorted(PARAMS)
COLMAPS = sorted(set(PARAMS) - {"MEI"})
WIDE = ["MEI", "OPENCV_FISHEYE"]


def points_in_view(count: int = 200, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 60.0, count)
    return np.stack([depth * rng.uniform(-0.7, 0.7, count), depth * rng.uniform(-0.45, 0.45, count), depth], 1)


def test_every_model_of_the_manifest_is_covered() -> None:
    assert sorted(CAMERA_MODELS) == MODELS


@pytest.mark.parametrize("model", COLMAPS)
def test_projection_agrees_with_colmap(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    points = points_in_view()
    ours = project_points(kind, packed, points)
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model]).img_from_cam(points)
    np.testing.assert_allclose(ours, theirs, atol=1e-9, rtol=0)
    assert np.ptp(ours[:, 0]) > 300  # pixels: the test would be empty at the principal point


@pytest.mark.parametrize("model", MODELS)
def test_the_optical_axis_meets_the_principal_point(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    np.testing.assert_allclose(project_points(kind, packed, [[0.0, 0.0, 3.0]]), [[470.0, 310.0]], atol=1e-9)
    np.testing.assert_allclose(unproject_pixels(kind, packed, [[470.0, 310.0]]), [[0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_agree_with_differences(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    work, out, step = np.empty(6), np.empty(8), 1e-5
    points = np.concatenate([points_in_view(40), [[1e-9, 0.0, 2.0]]])
    for x in points * (2.0 / points[:, 2:]):  # at 2 m: derivatives are far from zero
        project.py_func(kind, packed, *x, work, out)
        numeric = np.stack(
            [
                (project_points(kind, packed, [x + d]) - project_points(kind, packed, [x - d]))[0] / (2 * step)
                for d in np.eye(3) * step
            ],
            1,
        )
        np.testing.assert_allclose(out[2:].reshape(2, 3), numeric, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_unprojection_inverts_projection(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    points = points_in_view(seed=1)
    rays = unproject_pixels(kind, packed, project_points(kind, packed, points))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)


def rays_within(angle_rad: float, count: int = 400, seed: int = 3) -> np.ndarray:
    """Unit rays evenly spread up to an angle from the axis."""
    rng = np.random.default_rng(seed)
    cosine, around = rng.uniform(np.cos(angle_rad), 1.0, count), rng.uniform(0.0, 2 * np.pi, count)
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(around), sine * np.sin(around), cosine], 1)


def test_the_unified_model_is_what_its_authors_wrote() -> None:
    fx, fy, cx, cy, k1, k2, p1, p2, xi = PARAMS["MEI"]
    rays = rays_within(np.radians(100.0))
    kind, packed = pack_camera("MEI", PARAMS["MEI"])
    x, y = (rays[:, :2] / (rays[:, 2:] + xi)).T
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx
    v = fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy
    np.testing.assert_allclose(project_points(kind, packed, 7.0 * rays), np.stack([u, v], 1), atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_everything_within_the_limit_comes_back(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    rays = rays_within(0.995 * largest_angle_rad(packed))
    pixels = project_points(kind, packed, 5.0 * rays)
    np.testing.assert_allclose(unproject_pixels(kind, packed, pixels), rays, atol=1e-8)


@pytest.mark.parametrize("model", WIDE)
def test_wide_cameras_see_beyond_90_degrees(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    assert 110 < np.degrees(largest_angle_rad(packed)) < 125
    sideways = project_points(kind, packed, [[3.0, 0.0, 0.0], [3.0, 0.0, -0.3], [0.1, 0.1, -2.0]])
    assert sideways[1, 0] > sideways[0, 0] > 900
    assert np.isnan(sideways[2]).all()
    work, out, step = np.empty(6), np.empty(8), 1e-6
    for x in 2.0 * rays_within(np.radians(108.0), 60):
        assert project.py_func(kind, packed, *x, work, out)
        numeric = [
            (project_points(kind, packed, [x + d]) - project_points(kind, packed, [x - d]))[0] / (2 * step)
            for d in np.eye(3) * step
        ]
        np.testing.assert_allclose(out[2:].reshape(2, 3), np.stack(numeric, 1), rtol=1e-5, atol=1e-4)


FOLDED = {
    # Half of the image is 25 deg; what lies 50 deg off the axis would come back into it.
    "OPENCV": [1000.0, 1000.0, 466.0, 350.0, -0.32, 0.0, 5e-4, -3e-4],
    "RADIAL": [500.0, 480.0, 300.0, -0.35, 0.02],
    "FULL_OPENCV": [600.0, 600.0, 480.0, 300.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.3, 0.0],
    "OPENCV_FISHEYE": [330.0, 330.0, 480.0, 300.0, -0.2, 0.0, 0.0, 0.0],
}


@pytest.mark.parametrize("model", sorted(FOLDED))
def test_folded_distortion_shows_nothing_far_off(model: str) -> None:
    """COLMAP and OpenCV project what lies beyond the fold into the image."""
    kind, packed = pack_camera(model, FOLDED[model])
    limit = largest_angle_rad(packed)
    rays = rays_within(np.radians(89.0), 3000)
    angle = np.arccos(rays[:, 2])
    pixels = project_points(kind, packed, 10.0 * rays)
    np.testing.assert_array_equal(np.isnan(pixels[:, 0]), angle > limit)
    assert 10 < (angle > limit).sum() < 2990
    # Pixels move outwards up to the limit, and no farther.
    reach = []
    for theta in np.linspace(0.0, 1.15 * limit, 400):
        direction = np.array([[np.sin(theta), 0.0, np.cos(theta)]])
        camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=FOLDED[model])
        reach.append(camera.img_from_cam(direction)[0, 0])
    assert np.linspace(0.0, 1.15, 400)[int(np.argmax(reach))] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        *FOLDED.items(),
        ("OPENCV", [960.0, 960.0, 480.0, 300.0, -0.30, -0.02, 5e-4, -3e-4]),
        ("OPENCV", [500.0, 500.0, 480.0, 300.0, -0.35, 0.05, 5e-4, -3e-4]),
        ("MEI", PARAMS["MEI"]),
    ],
)
def test_pixels_beyond_the_limit_have_rays_at_the_limit(model: str, params: list[float]) -> None:
    """In their direction from the axis, whatever the lens is decentred by."""
    kind, packed = pack_camera(model, params)
    pixels = np.array([[1e5, 300.0], [480.0, -1e5], [-2000.0, -1500.0], [2500.0, 1400.0]])
    rays = unproject_pixels(kind, packed, pixels)
    np.testing.assert_allclose(np.arccos(rays[:, 2]), largest_angle_rad(packed), atol=1e-6)
    towards = (pixels - packed[2:4]) / packed[:2]
    np.testing.assert_allclose(np.arctan2(rays[:, 1], rays[:, 0]), np.arctan2(towards[:, 1], towards[:, 0]), atol=1e-3)


@pytest.mark.parametrize(("model", "at"), [("OPENCV", 4), ("MEI", 4), ("FULL_OPENCV", 5)])
def test_an_image_that_is_inverted_twice_is_none(model: str, at: int) -> None:
    params = list(PARAMS[model])
    params[at] = -1e9
    assert largest_angle_rad(pack_camera(model, params)[1]) < np.radians(2.0)


@pytest.mark.parametrize("model", MODELS)
def test_points_behind_the_camera_have_no_pixel(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    pixels = project_points(kind, packed, [[0.1, 0.1, -2.0], [0.0, 0.0, -2.0], [0.1, 0.1, 2.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()
    if model not in WIDE:
        assert np.isnan(project_points(kind, packed, [[0.1, 0.1, 0.0]])).all()


@pytest.mark.parametrize("model", MODELS)
def test_packing_keeps_colmaps_parameters(model: str) -> None:
    _, packed = pack_camera(model, PARAMS[model])
    assert packed.shape == (PARAMETERS,)
    np.testing.assert_allclose(unpack_camera(model, packed), PARAMS[model], rtol=1e-15)


def test_an_unknown_model_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="EQUIRECTANGULAR"):
        pack_camera("EQUIRECTANGULAR", [1.0, 2.0])


def test_cameras_are_packed_in_manifest_order() -> None:
    pose = Pose(rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0])
    cameras = [
        Camera(name=m.lower(), model=m, width=WIDTH, height=HEIGHT, params=PARAMS[m], rig_from_cam=pose) for m in MODELS
    ]
    kinds, params = pack_cameras(cameras)
    assert kinds.tolist() == [pack_camera(m, PARAMS[m])[0] for m in MODELS]
    np.testing.assert_array_equal(params, [pack_camera(m, PARAMS[m])[1] for m in MODELS])
