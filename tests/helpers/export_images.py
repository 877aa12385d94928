"""The example's scene with a drive whose images show a world that is known along every ray."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry.camera_model import pack_camera, unproject_pixels
from mrasfm_engine.preflight.drive_reader import write_manifest
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats
from schemas import Camera, FrameImage, Pose
from tests.helpers.export_example import make_scene

WIDTH, HEIGHT = 960, 600
FISHEYES = {
    "OPENCV_FISHEYE": [290.0, 291.0, 478.0, 302.0, 0.01, -0.006, 0.001, 0.0],
    "MEI": [900.0, 905.0, 480.0, 300.0, 0.02, 0.4, 0.0, 0.0, 2.2],
}
USUAL = {"PINHOLE": [800.0, 810.0, 480.0, 300.0], "OPENCV": [700.0, 705.0, 470.0, 310.0, -0.05, 0.01, 1e-3, -5e-4]}


def seen_along(rays: Floats) -> Floats:
    """The colour of a world at infinity, smooth in the direction (..., 3)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    return 127.5 + 100.0 * np.stack([np.sin(3.0 * x + y), np.sin(4.0 * y - z), np.cos(2.0 * z + 3.0 * x)], -1)


def camera_of(model: str, params: Sequence[float]) -> Camera:
    pose = Pose(rotation_xyzw=[0.0, 0.0, 0.0, 1.0], translation_m=[0.0, 0.0, 0.0])
    return Camera(name="c", model=model, width=WIDTH, height=HEIGHT, params=list(params), rig_from_cam=pose)


@cache
def image_of(model: str, params: tuple[float, ...], kind: str) -> bytes:
    """A file of what a camera shows."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = unproject_pixels(*pack_camera(model, params), np.stack([u, v], -1).reshape(-1, 2))
    rgb = np.round(seen_along(rays)).reshape(HEIGHT, WIDTH, 3).astype(np.uint8)
    return cv2.imencode(f".{kind}", rgb[..., ::-1])[1].tobytes()


def written(
    tmp_path: Path,
    models: Mapping[str, list[float]],
    *,
    kind: str = "png",
    masked: bool = False,
    moving: bool = True,
) -> Scene:
    """A scene in `scene` and its drive in `drive`; `moving` as in `make_scene`."""
    scene = make_scene(models=models, moving=moving)
    (tmp_path / "drive").mkdir(parents=True)
    manifest = scene.drive.manifest
    frames = []
    for frame in manifest.frames:
        images = {
            name: FrameImage(
                file=f"{name}/{frame.source_frame}.{kind}", mask=f"{name}/m{frame.source_frame}.png" if masked else None
            )
            for name in frame.images
        }
        frames.append(frame.model_copy(update={"images": images}))
    manifest = manifest.model_copy(update={"frames": frames})
    for camera, found in zip(manifest.rig.cameras, scene.calibration, strict=True):
        (tmp_path / "drive" / camera.name).mkdir()
        pixels = image_of(camera.model, tuple(map(float, found.params)), kind)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, 500:600] = 13  # a car
        for frame in manifest.frames:
            (tmp_path / "drive" / frame.images[camera.name].file).write_bytes(pixels)
            if masked:
                cv2.imwrite(str(tmp_path / "drive" / frame.images[camera.name].mask), mask)
    write_manifest(manifest, tmp_path / "drive")
    scene = replace(scene, drive=replace(scene.drive, manifest=manifest))
    write_scene(scene, tmp_path / "scene", {})
    return scene
