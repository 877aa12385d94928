"""Re-reads a written COLMAP model, binary and text, before it is put in place.

Poses composed from rigs and frames by pycolmap are compared with the scene and with the poses that the image files hold
one by one. Those, and the points that the image files name, COLMAP itself overlooks, so they are parsed here.
"""

from __future__ import annotations

import struct
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mrasfm_engine.export.check import POSE_TOLERANCE, checking, matrices, refuse, require, require_close
from mrasfm_engine.export.colmap import BINARY_FILES, RIG_ID, TEXT_FILES, frame_of_image
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints


def check_binary_model(scene: Scene, folder: Path) -> None:
    """Check the binary model against the scene."""
    _require_files(folder, BINARY_FILES)
    with checking(folder / "images.bin"):
        poses = _check_images_binary(scene, folder / "images.bin")
    with checking(folder):
        reconstruction = pycolmap.Reconstruction()
        reconstruction.read_binary(str(folder))
        _check_reconstruction(scene, reconstruction, poses, folder=folder, suffix="bin")


def check_text_model(scene: Scene, folder: Path, *, through_colmap: bool = True) -> None:
    """Check the text model against the scene: every pose, keypoint, point and track.

    Parameters
    ----------
    through_colmap
        Whether COLMAP reads it, too.
    """
    _require_files(folder, TEXT_FILES)
    with checking(folder / "images.txt"):
        poses = _check_images_text(scene, folder / "images.txt")
    with checking(folder / "points3D.txt"):
        _check_points_text(scene, folder / "points3D.txt")
    if through_colmap:
        with checking(folder):
            reconstruction = pycolmap.Reconstruction()
            reconstruction.read_text(str(folder))
            _check_reconstruction(scene, reconstruction, poses, folder=folder, suffix="txt")


def _require_files(folder: Path, names: tuple[str, ...]) -> None:
    for name in names:
        if not (folder / name).is_file() or not (folder / name).stat().st_size:
            refuse(folder / name, "it is missing or empty")


def _expected_cam_from_world(scene: Scene, image: int) -> Floats:
    source = scene.drive.images[image]
    world_from_cam = scene.world_from_rig[source.unit] @ scene.calibration[source.camera].rig_from_cam
    if scene.unit_from_image is not None:
        unit_from_cam = scene.unit_from_image[image] @ scene.calibration[source.camera].rig_from_cam
        world_from_cam = scene.world_from_rig[source.unit] @ unit_from_cam
    return np.asarray(np.linalg.inv(world_from_cam), dtype=np.float64)


def _check_reconstruction(
    scene: Scene, reconstruction: Any, image_poses: dict[int, Floats], *, folder: Path, suffix: str
) -> None:
    images, points = folder / f"images.{suffix}", folder / f"points3D.{suffix}"
    registered = np.flatnonzero(scene.image_registered)
    require(
        sorted(reconstruction.images) == (registered + 1).tolist(), images, "its images are not the registered ones"
    )
    require(sorted(reconstruction.reg_image_ids()) == sorted(image_poses), images, "an image is without its pose")
    counts = np.bincount(scene.observation_image, minlength=len(scene.drive.images))
    composed = {}
    for i in registered.tolist():
        image, source = reconstruction.images[i + 1], scene.drive.images[i]
        known = (image.name, image.camera_id, image.frame_id)
        require(
            known == (source.file, source.camera + 1, frame_of_image(scene, i)), images, f"image {i + 1} is {known}"
        )
        require(image.num_points2D() == len(scene.features[i].xy_px), images, f"keypoints of {image.name} are missing")
        require(image.num_points3D == counts[i], images, f"observations of {image.name} are missing")
        composed[i + 1] = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    _check_cameras(scene, reconstruction, folder / f"cameras.{suffix}", folder / f"rigs.{suffix}")
    _check_image_poses(scene, composed, image_poses, path=images)
    _check_baselines(scene, composed, path=folder / f"rigs.{suffix}")
    require(reconstruction.num_points3D() == len(scene.points_m), points, "points are missing")
    require(reconstruction.compute_num_observations() == len(scene.observation_point), points, "tracks are incomplete")
    require(reconstruction.is_valid(), points, "COLMAP finds it inconsistent")
    ids, xyz = [], []
    for point_id, point in reconstruction.points3D.items():
        ids.append(point_id)
        xyz.append(point.xyz)
    ordered = np.reshape(xyz, (-1, 3))[np.argsort(ids)]
    require_close(ordered, scene.points_m, path=points, what="a point", tolerance=POSE_TOLERANCE)


def _check_cameras(scene: Scene, reconstruction: Any, cameras: Path, rigs: Path) -> None:
    vehicles, sizes = np.unique(scene.rig_of_camera, return_counts=True)
    require(sorted(reconstruction.rigs) == (vehicles + RIG_ID).tolist(), rigs, "its rigs are not the vehicles")
    for vehicle, size in zip(vehicles.tolist(), sizes.tolist(), strict=True):
        rig = reconstruction.rigs[vehicle + RIG_ID]
        require(rig.num_sensors() == size + 1, rigs, "its sensors are not the cameras")
        require(rig.ref_sensor_id.type == pycolmap.SensorType.IMU, rigs, "its reference is not the vehicle")
    for k, (given, refined) in enumerate(zip(scene.drive.cameras, scene.calibration, strict=True)):
        rig = reconstruction.rigs[int(scene.rig_of_camera[k]) + RIG_ID]
        camera = reconstruction.cameras[k + 1]
        known = (camera.model.name, camera.width, camera.height)
        require(known == (given.model, given.width, given.height), cameras, f"{given.name} is {known}")
        require_close(camera.params, refined.params, path=cameras, what=f"{given.name}'s params", tolerance=1e-9)
        sensor_from_rig = rig.sensor_from_rig(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, k + 1)).matrix()
        expected = np.linalg.inv(refined.rig_from_cam)[:3]
        require_close(sensor_from_rig, expected, path=rigs, what=f"{given.name}'s pose", tolerance=POSE_TOLERANCE)


def _check_image_poses(
    scene: Scene, composed: dict[int, Floats], image_poses: dict[int, Floats], *, path: Path
) -> None:
    for image_id, pose in composed.items():
        name, expected = scene.drive.images[image_id - 1].file, _expected_cam_from_world(scene, image_id - 1)
        for actual in (pose, image_poses[image_id]):
            require_close(actual, expected, path=path, what=f"the pose of {name}", tolerance=POSE_TOLERANCE)


def _check_baselines(scene: Scene, composed: dict[int, Floats], *, path: Path) -> None:
    """Distances between the cameras of a unit must be the same in every unit, if they are simultaneous."""
    if scene.unit_from_image is not None:
        return
    centres = np.full((len(scene.unit_registered), len(scene.calibration), 3), np.nan)
    for image_id, pose in composed.items():
        source = scene.drive.images[image_id - 1]
        centres[source.unit, source.camera] = -pose[:3, :3].T @ pose[:3, 3]
    for a, b in combinations(range(centres.shape[1]), 2):
        lengths = np.linalg.norm(centres[:, a] - centres[:, b], axis=1)
        lengths = lengths[np.isfinite(lengths)]
        constant = not len(lengths) or np.ptp(lengths) <= POSE_TOLERANCE
        require(constant, path, f"the distance of cameras {a} and {b} changes")


def _check_images_binary(scene: Scene, path: Path) -> dict[int, Floats]:
    data, poses, at = path.read_bytes(), {}, 8
    expected_points = _points_by_keypoint(scene)
    for _ in range(struct.unpack_from("<Q", data)[0]):
        image_id, *numbers = struct.unpack_from("<I7d", data, at)
        name_end = data.index(b"\0", at + 64)
        (count,) = struct.unpack_from("<Q", data, name_end + 1)
        keypoints = np.frombuffer(data, dtype=[("xy", "<f8", 2), ("point", "<i8")], count=count, offset=name_end + 9)
        _check_keypoints(scene, image_id - 1, keypoints["xy"], keypoints["point"], expected_points, path=path)
        poses[image_id] = _pose(numbers)
        at = name_end + 9 + keypoints.nbytes
    require(at == len(data), path, "its length is wrong")
    return poses


def _check_keypoints(
    scene: Scene, image: int, xy: Floats, point: NDArray[Any], expected_points: list[Ints], *, path: Path
) -> None:
    name = scene.drive.images[image].file
    require_close(xy, scene.features[image].xy_px, path=path, what=f"a keypoint of {name}", tolerance=1e-6)
    require_close(point, expected_points[image], path=path, what=f"a point seen in {name}", tolerance=0.0)


def _pose(numbers: list[float]) -> Floats:
    w, x, y, z, *translation = numbers
    pose: Floats = matrices([x, y, z, w], translation)[0]
    return pose


def _check_images_text(scene: Scene, path: Path) -> dict[int, Floats]:
    lines = [line for line in path.read_text(encoding="utf-8").split("\n") if not line.startswith("#")]
    expected_points = _points_by_keypoint(scene)
    registered = np.flatnonzero(scene.image_registered)
    require(len(lines) == 2 * len(registered) + 1 and not lines[-1], path, f"{len(lines)} lines")
    poses = {}
    for head, keypoints in zip(lines[:-1:2], lines[1::2], strict=True):
        image_id, *numbers, _, name = head.split(" ", maxsplit=9)
        poses[int(image_id)] = _pose([float(v) for v in numbers])
        image = int(image_id) - 1
        require(name == scene.drive.images[image].file, path, f"image {image_id} is {name}")
        rows = _numbers(keypoints).reshape(-1, 3)
        _check_keypoints(scene, image, rows[:, :2], rows[:, 2], expected_points, path=path)
    require(sorted(poses) == (registered + 1).tolist(), path, "its images are not the registered ones")
    return poses


def _points_by_keypoint(scene: Scene) -> list[Ints]:
    points = [np.full(len(features.xy_px), -1, dtype=np.int64) for features in scene.features]
    offsets = np.cumsum([0, *(len(p) for p in points)])
    flat = np.full(offsets[-1], -1, dtype=np.int64)
    flat[offsets[scene.observation_image] + scene.observation_keypoint] = scene.observation_point + 1
    return np.split(flat, offsets[1:-1])


def _check_points_text(scene: Scene, path: Path) -> None:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    require(len(lines) == len(scene.points_m), path, f"{len(lines)} points instead of {len(scene.points_m)}")
    counts = np.array([line.rstrip().count(" ") + 1 for line in lines], dtype=np.int64)
    numbers, ends = _numbers(" ".join(lines)), np.cumsum(counts)
    require(len(numbers) == counts.sum(), path, "it holds something that is no number")
    is_head = np.zeros(len(numbers), dtype=bool)
    at_heads = (ends - counts)[:, None] + np.arange(8)
    is_head[at_heads] = True
    heads = numbers[at_heads]
    point = heads[:, 0].astype(np.int64) - 1
    require(np.array_equal(np.sort(point), np.arange(len(lines))), path, "its point ids are wrong")
    require_close(heads[:, 1:4], scene.points_m[point], path=path, what="a point", tolerance=POSE_TOLERANCE)
    require_close(heads[:, 4:7], scene.point_colors[point], path=path, what="a colour", tolerance=0.0)
    tracks = numbers[~is_head].astype(np.int64).reshape(-1, 2)
    found = np.column_stack([np.repeat(point, (counts - 8) // 2), tracks[:, 0] - 1, tracks[:, 1]])
    expected = np.column_stack([scene.observation_point, scene.observation_image, scene.observation_keypoint])
    require(np.array_equal(_sorted_rows(found), _sorted_rows(expected)), path, "a track is not what the scene says")


def _numbers(text: str) -> Floats:
    # Stops at the first word that is no number; the callers compare shapes.
    return np.fromstring(text, dtype=np.float64, sep=" ") if text.strip() else np.zeros(0)


def _sorted_rows(rows: Ints) -> Ints:
    result: Ints = rows[np.lexsort(rows.T)]
    return result
