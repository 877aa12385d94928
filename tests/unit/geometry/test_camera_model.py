from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.geometry.camera_model import (
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
}
MODELS = sorted(PARAMS)


def points_in_view(count: int = 200, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 60.0, count)
    return np.stack([depth * rng.uniform(-0.7, 0.7, count), depth * rng.uniform(-0.45, 0.45, count), depth], 1)


def test_every_model_of_the_manifest_is_covered() -> None:
    assert sorted(CAMERA_MODELS) == MODELS


@pytest.mark.parametrize("model", MODELS)
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


def test_a_wide_fisheye_comes_back_up_to_80_degrees_off_axis() -> None:
    kind, packed = pack_camera("OPENCV_FISHEYE", PARAMS["OPENCV_FISHEYE"])
    angle, around = np.meshgrid(np.radians(np.linspace(0, 80, 41)), np.radians(np.arange(0, 360, 30)))
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1).reshape(-1, 3)
    pixels = project_points(kind, packed, 5.0 * rays)
    np.testing.assert_allclose(unproject_pixels(kind, packed, pixels), rays, atol=1e-8)
    camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=WIDTH, height=HEIGHT, params=PARAMS["OPENCV_FISHEYE"])
    np.testing.assert_allclose(pixels, camera.img_from_cam(5.0 * rays), atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_points_behind_the_camera_have_no_pixel(model: str) -> None:
    kind, packed = pack_camera(model, PARAMS[model])
    pixels = project_points(kind, packed, [[0.1, 0.1, -2.0], [0.1, 0.1, 0.0], [0.1, 0.1, 2.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


@pytest.mark.parametrize("model", MODELS)
def test_packing_keeps_colmaps_parameters(model: str) -> None:
    _, packed = pack_camera(model, PARAMS[model])
    assert packed.shape == (8,)
    np.testing.assert_array_equal(unpack_camera(model, packed), PARAMS[model])


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
