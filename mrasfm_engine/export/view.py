"""`view.json`: what a page that shows the scene needs besides the points, in the coordinates of `points.copc.laz`.

Positions are metres from `offset_m`, to the millimetre, so that a page needs no projection library. A frustum is the
camera's centre and the corners of its image, `FRUSTUM_M` in front of it. `observations` of an image are the
place of its keypoints in `model/images.bin`: rows of x, y (float64, px) and the id of the point (uint64, 2**64 - 1 for
a keypoint without one).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.export.copc import epsg_code_of, in_reference_system, offset_of
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.geometry.camera_model import pack_camera, unproject_pixels
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints
from schemas.artifacts import COPC_FILE

FRUSTUM_M = 1.0
OBSERVATION_BYTES = 24
IMAGES_FILE = "model/images.bin"
COLORS = ("#ffb000", "#33aaff", "#57d26b", "#ff6fae", "#b48cff", "#ff7043", "#3fd6d0", "#d4d648")


def view_document(
    scene: Scene,
    scene_of_unit: Sequence[str],
    places: Mapping[int, tuple[int, int]],
    document: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The document of a scene or map.

    Parameters
    ----------
    scene_of_unit
        Name of the scene of each unit.
    places
        By image: where its keypoints begin in `model/images.bin`, in bytes, and how many there are.
    document
        `map.json` of a map.
    """
    images_of, poses = _images_of_scenes(scene, scene_of_unit), scene.world_from_cam
    is_map, epsg = document is not None, epsg_code_of(scene)
    tracks = _tracks(scene, scene_of_unit)
    return {
        "version": 1,
        **({} if epsg is None else {"epsg": epsg, "heights": "ellipsoidal"}),
        "offset_m": offset_of(scene).tolist(),
        "points": COPC_FILE,
        "observations": IMAGES_FILE,
        "scenes": [
            {
                "name": name,
                "color": COLORS[number % len(COLORS)],
                **_trajectory(scene, tracks[name]),
                "images": list(_images(scene, poses, images_of[name], places, prefix=f"{name}/" if is_map else "")),
            }
            for number, name in enumerate(tracks)
        ],
        "seams": [] if document is None else list(_seams(scene, tracks, document)),
    }


def image_places(data: bytes) -> dict[int, tuple[int, int]]:
    """Place of every image's keypoints in a COLMAP `images.bin`, by the image's id: first byte and count."""
    (count,), at, places = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        (image,) = struct.unpack_from("<I", data, at)
        at = data.index(b"\0", at + 4 + 7 * 8 + 4) + 1
        (keypoints,) = struct.unpack_from("<Q", data, at)
        places[image] = (at + 8, keypoints)
        at += 8 + OBSERVATION_BYTES * keypoints
    return places


def read_image_places(folder: Path) -> dict[int, tuple[int, int]]:
    """As `image_places`, by the index of the image, of the model in a result's folder."""
    return {image - 1: place for image, place in image_places((folder / IMAGES_FILE).read_bytes()).items()}


def _relative(scene: Scene, points_m: Floats) -> list[list[float]]:
    """Local points (n, 3) as the file has them."""
    found: list[list[float]] = np.round(in_reference_system(scene, points_m) - offset_of(scene), 3).tolist()
    return found


def _tracks(scene: Scene, scene_of_unit: Sequence[str]) -> dict[str, Ints]:
    """Registered units of every scene in order of time."""
    found: dict[str, list[int]] = {name: [] for name in scene_of_unit}
    for unit in np.argsort(scene.drive.timestamps_us, kind="stable").tolist():
        if scene.unit_registered[unit]:
            found[scene_of_unit[unit]].append(unit)
    return {name: np.array(units, dtype=np.int64) for name, units in found.items()}


def _images_of_scenes(scene: Scene, scene_of_unit: Sequence[str]) -> dict[str, list[int]]:
    """Registered images of every scene."""
    found: dict[str, list[int]] = {name: [] for name in scene_of_unit}
    for index in np.flatnonzero(scene.image_registered).tolist():
        found[scene_of_unit[scene.drive.images[index].unit]].append(index)
    return found


def _trajectory(scene: Scene, units: Ints) -> dict[str, Any]:
    poses = scene.world_from_rig[units]
    found: dict[str, Any] = {"units": units.tolist(), "trajectory_m": _relative(scene, poses[:, :3, 3])}
    places = geodetic_positions(scene, poses)
    if places is not None:
        found["longitude_latitude_deg"] = np.round(places[:, [1, 0]], 9).tolist()
    return found


def _images(
    scene: Scene, poses: Floats, images: Sequence[int], places: Mapping[int, tuple[int, int]], *, prefix: str
) -> Iterator[dict[str, Any]]:
    numbers = sorted({scene.drive.images[index].camera for index in images})
    corners = {number: _corners(scene, number) for number in numbers}
    for index in images:
        image, pose = scene.drive.images[index], poses[index]
        camera = scene.drive.cameras[image.camera]
        yield {
            "file": image.file.removeprefix(prefix),
            "camera": camera.name.removeprefix(prefix),
            "unit": image.unit,
            "size_px": [camera.width, camera.height],
            "frustum_m": _relative(scene, corners[image.camera] @ pose[:3, :3].T + pose[:3, 3]),
            "observations": list(places.get(index, (0, 0))),
        }


def _corners(scene: Scene, camera: int) -> Floats:
    """Centre of a camera and the corners (5, 3) of its frustum, in its own coordinates."""
    given, refined = scene.drive.cameras[camera], scene.calibration[camera]
    w, h = float(given.width), float(given.height)
    pixels = np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)])
    rays = unproject_pixels(*pack_camera(given.model, refined.params), pixels)
    # Corners of a fisheye may have no ray, or one to the side: the frustum then stands for the direction alone.
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = rays / rays[:, 2:3]
    wide = ~np.isfinite(flat).all(axis=1) | (rays[:, 2] <= 0.1) | (np.abs(flat[:, :2]) > 2.0).any(axis=1)
    flat[wide] = np.column_stack([np.sign(pixels[wide] - (w / 2, h / 2)) * (1.2, 0.9), np.ones(int(wide.sum()))])
    return np.vstack([np.zeros((1, 3)), flat * FRUSTUM_M])


def _seams(scene: Scene, tracks: Mapping[str, Ints], document: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Seams as lines between the units of both scenes that are nearest to each other."""
    for seam in document["seams"]:
        own = [tracks.get(seam[side], np.zeros(0, dtype=np.int64)) for side in ("a", "b")]
        shown: dict[str, Any] = {"a": seam["a"], "b": seam["b"], "accepted": bool(seam["accepted"])}
        if all(len(track) for track in own):
            a, b = (scene.world_from_rig[track][:, :3, 3] for track in own)
            distance_m, nearest = map(np.asarray, cKDTree(b).query(a))
            closest = int(np.argmin(distance_m))
            shown["line_m"] = _relative(scene, np.stack([a[closest], b[nearest[closest]]]))
        yield shown
