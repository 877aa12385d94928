"""Cameras as COLMAP's solvers and files have them."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, project_points
from mrasfm_engine.geometry.colmap_cameras import SolverCameras, nearest_model
from schemas import Camera, Pose

MEI = [1300.0, 1310.0, 470.0, 310.0, 0.016, 1.6, 0.0006, -0.0004, 2.2]
PARAMS = {
    "PINHOLE": [500.0, 505.0, 470.0, 310.0],
    "OPENCV_FISHEYE": [300.0, 302.0, 470.0, 310.0, 0.02, -0.008, 0.002, -0.0005],
    "MEI": MEI,
}


def camera(model: str) -> Camera:
    pose = Pose(rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0])
    return Camera(name=model.lower(), model=model, width=960, height=600, params=PARAMS[model], rig_from_cam=pose)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE"])
def test_colmaps_own_models_stay(model: str) -> None:
    nearest = nearest_model(camera(model), np.array(PARAMS[model]))
    assert (nearest.model, nearest.error_px) == (model, 0.0)
    np.testing.assert_array_equal(nearest.params, PARAMS[model])


def test_the_nearest_fisheye_is_as_near_as_it_says() -> None:
    nearest = nearest_model(camera("MEI"), np.array(MEI))
    assert nearest.model == "OPENCV_FISHEYE"
    rng = np.random.default_rng(0)
    angle, around = rng.uniform(0, np.radians(70.0), 2000), rng.uniform(0, 2 * np.pi, 2000)
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
    (kind,), (params,) = pack_cameras([camera("MEI")])
    ours = project_points(int(kind), params, rays)
    inside = ((ours > 0) & (ours < [960, 600])).all(1)
    theirs = pycolmap.Camera(model="OPENCV_FISHEYE", width=960, height=600, params=nearest.params).img_from_cam(rays)
    off_px = np.linalg.norm(ours - theirs, axis=1)[inside]
    assert inside.sum() > 1000
    assert 0.0 < off_px.max() <= 1.05 * nearest.error_px
    assert nearest.error_px < 1.0  # mostly the tangential terms, which no fisheye of COLMAP's has


def test_a_lens_that_shows_nothing_has_no_nearest_model_but_breaks_nothing() -> None:
    broken = [*MEI[:4], 0.0, 0.0, 1e3, 0.0, 2.2]
    nearest = nearest_model(camera("MEI").model_copy(update={"params": broken}), np.array(broken))
    assert nearest.model == "OPENCV_FISHEYE"
    assert nearest.error_px == np.inf
    assert np.isfinite(nearest.params).all()


def test_generalised_pnp_finds_a_pose_whatever_the_models_are() -> None:
    """Points around the vehicle, of which many lie where COLMAP's plane z = 1 does not reach."""
    cameras = [camera(model) for model in PARAMS]
    kind, params = pack_cameras(cameras)
    rng = np.random.default_rng(1)
    rig_from_cam = np.stack([se3.transform(se3.exp_so3([0.0, 0.4 * c, 0.0]), [0.3 * c, 0.0, 0.0]) for c in range(3)])
    rig_from_world = se3.transform(se3.exp_so3([0.05, -0.3, 0.02]), [0.4, -0.1, 1.2])
    points, of_camera, xy = [], [], []
    for c in range(3):
        world = rng.normal(size=(400, 3)) * 8.0
        seen = project_points(int(kind[c]), params[c], se3.apply(se3.inverse(rig_from_cam[c]) @ rig_from_world, world))
        inside = ((seen > 0) & (seen < [960, 600])).all(1)
        points.append(world[inside])
        xy.append(seen[inside])
        of_camera += [c] * int(inside.sum())
    camera_of, xy_px = np.array(of_camera), np.concatenate(xy)
    solver = SolverCameras.from_cameras(cameras, kind, params)
    pixels, usable = solver.pixels(camera_of, xy_px)
    assert usable[camera_of == 0].all()
    assert 0.3 < usable.mean() < 1.0
    np.testing.assert_array_equal(pixels[camera_of < 2], xy_px[camera_of < 2])
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        pixels[usable],
        np.concatenate(points)[usable],
        camera_of[usable].tolist(),
        [pycolmap.Rigid3d(m[:3]) for m in se3.inverse(rig_from_cam)],
        solver.cameras,
        estimation_options=pycolmap.RANSACOptions(max_error=2.0),
    )
    assert result["num_inliers"] == usable.sum()
    np.testing.assert_allclose(result["rig_from_world"].matrix(), rig_from_world[:3], atol=1e-6)
