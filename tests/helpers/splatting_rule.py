"""The rule by which 3D Gaussian Splatting loads a COLMAP workspace and projects its points, written anew.

Source: graphdeco-inria/gaussian-splatting, `scene/colmap_loader.py`, `scene/dataset_readers.py` (which images and
cameras it takes), `utils/graphics_utils.py` (a camera is its two fields of view: the principal point is the middle),
and `ndc2Pix` of its rasteriser (the centre of the first pixel is at 0).
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

NUMBER_OF_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
SIMPLE_PINHOLE, PINHOLE = 0, 1
NEAR, FAR = 0.01, 100.0


class Loaded(NamedTuple):
    """An image as the rule has it."""

    name: str
    width: int
    height: int
    clip_from_world: np.ndarray  # (4, 4), for column vectors
    xy_px: np.ndarray  # (n, 2) keypoints, from the corner of the first pixel
    point_ids: np.ndarray  # (n,)


def load(workspace: Path) -> tuple[list[Loaded], dict[int, np.ndarray]]:
    """Images, and points by id; AssertionError where the rule does not take a camera or finds no image."""
    model, images = workspace / "sparse" / "0", []
    cameras = _cameras(model / "cameras.bin")
    data = (model / "images.bin").read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<idddddddi", data, at)
        at += 64
        end = data.index(b"\0", at)
        name = data[at:end].decode("utf-8")
        (keypoints,) = struct.unpack_from("<Q", data, end + 1)
        rows = np.frombuffer(data, [("xy", "<f8", 2), ("point", "<i8")], keypoints, end + 9)
        at = end + 9 + rows.nbytes
        model_id, width, height, params = cameras[camera_id]
        assert model_id in (SIMPLE_PINHOLE, PINHOLE), "Colmap camera model not handled"
        focal_x, focal_y = params[0], params[model_id]  # of SIMPLE_PINHOLE one for both
        fov_x, fov_y = (2 * math.atan(size / (2 * focal)) for size, focal in ((width, focal_x), (height, focal_y)))
        picture = cv2.imread(str(workspace / "images" / Path(name).name))
        assert picture is not None, name
        assert picture.shape[1::-1] == (width, height)
        clip = _projection(fov_x, fov_y) @ _view(np.array(pose))
        images.append(Loaded(name, width, height, clip, rows["xy"], rows["point"]))
    return images, _points(model / "points3D.bin")


def errors_px(images: list[Loaded], points: dict[int, np.ndarray]) -> np.ndarray:
    """Distances of keypoints from where the rasteriser has their points."""
    found = []
    for image in images:
        known = np.flatnonzero(image.point_ids >= 0)
        if not len(known):
            continue
        world = np.column_stack([np.stack([points[i] for i in image.point_ids[known].tolist()]), np.ones(len(known))])
        clip = world @ image.clip_from_world.T
        ndc = clip[:, :2] / (clip[:, 3:] + 1e-7)
        pixels = ((ndc + 1.0) * [image.width, image.height] - 1.0) * 0.5
        found.append(np.linalg.norm(pixels + 0.5 - image.xy_px[known], axis=1))
    return np.concatenate(found)


def _cameras(path: Path) -> dict[int, tuple[int, int, int, list[float]]]:
    data, at, found = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, at)
        params = struct.unpack_from(f"<{NUMBER_OF_PARAMS[model_id]}d", data, at + 24)
        at += 24 + 8 * len(params)
        found[camera_id] = (model_id, width, height, list(params))
    return found


def _points(path: Path) -> dict[int, np.ndarray]:
    data, at, found = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        point_id, x, y, z, *_, track = struct.unpack_from("<QdddBBBdQ", data, at)
        at += 51 + 8 * track
        found[point_id] = np.array([x, y, z])
    return found


def _view(pose: np.ndarray) -> np.ndarray:
    w, x, y, z = pose[:4]
    view = np.eye(4)
    view[:3, :3] = [
        [1 - 2 * y**2 - 2 * z**2, 2 * x * y - 2 * w * z, 2 * z * x + 2 * w * y],
        [2 * x * y + 2 * w * z, 1 - 2 * x**2 - 2 * z**2, 2 * y * z - 2 * w * x],
        [2 * z * x - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x**2 - 2 * y**2],
    ]
    view[:3, 3] = pose[4:]
    return view


def _projection(fov_x: float, fov_y: float) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 1 / math.tan(fov_x / 2), 1 / math.tan(fov_y / 2)
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR), 1.0
    return matrix
