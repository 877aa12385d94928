"""The scene as a COLMAP model with rigs and frames.

The binary files are packed here: point by point through pycolmap's Python objects takes many times as long. Ids:
image = index + 1, frame = unit + 1, camera = index + 1, point = index + 1; keypoints keep their indices. The rig frame
is the vehicle's, so the rig's reference sensor is a virtual inertial unit and every camera has a `sensor_from_rig`. A
map has a rig for every vehicle.

A frame is one instant. Where images have poses at their own times, every image is a frame of its own (frame = image),
at the rig's pose at that time: whoever loads the model then finds the poses under which the points were seen.

Source of the layout: COLMAP 4.2, src/colmap/scene/reconstruction_io_binary.cc.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.export.colmap_io import BINARY_FILES
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.colmap_cameras import NearestModel, nearest_model
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints
from schemas.findings import Finding, warning

RIG_ID = 1
REFERENCE_SENSOR_ID = 1
SENSOR_CAMERA, SENSOR_IMU = 0, 1


def write_model(scene: Scene, folder: Path) -> dict[str, str]:
    """Write the binary model of all registered images into an existing folder; the SHA-256 of its files by name."""
    return {name: write_content(folder / name, binary_file(scene, name)) for name in BINARY_FILES}


def binary_file(scene: Scene, name: str) -> bytes:
    """Content of one of `BINARY_FILES`."""
    writers = {
        "cameras.bin": _cameras,
        "rigs.bin": _rigs,
        "frames.bin": _frames,
        "images.bin": _images,
        "points3D.bin": _points,
    }
    return writers[name](scene)


def text_model_fits(scene: Scene) -> bool:
    """Return whether COLMAP's text format can hold the image names: it ends a name at the first space."""
    return not any(any(c.isspace() for c in image.file) for image in scene.drive.images)


def frame_of_image(scene: Scene, image: int) -> int:
    """The id of the frame that an image belongs to."""
    return 1 + (scene.drive.images[image].unit if scene.unit_from_image is None else image)


def images_of_frames(scene: Scene) -> dict[int, list[int]]:
    """Registered images by frame id, for frames that have any; both rising."""
    frames: dict[int, list[int]] = {}
    for i in np.flatnonzero(scene.image_registered).tolist():
        frames.setdefault(frame_of_image(scene, i), []).append(i)
    return dict(sorted(frames.items()))


def colmap_models(scene: Scene) -> list[NearestModel]:
    """COLMAP's models of the cameras, with their refined parameters."""
    return [
        nearest_model(camera, refined.params)
        for camera, refined in zip(scene.drive.cameras, scene.calibration, strict=True)
    ]


def approximations(scene: Scene) -> list[Finding]:
    """Findings of cameras whose model COLMAP does not have."""
    return [
        warning(
            "colmap-model-approximate",
            f"COLMAP has no model {camera.model}: `model/` and `features.db` have camera {camera.name} as "
            f"{nearest.model}, "
            + (
                f"which is off by up to {nearest.error_px:.2g} px in its image"
                if np.isfinite(nearest.error_px)
                else "without distortion, as its lens shows next to nothing"
            ),
            "Take the camera's own model from calibration.json where that matters.",
        )
        for camera, nearest in zip(scene.drive.cameras, colmap_models(scene), strict=True)
        if nearest.model != camera.model
    ]


def _wxyz_and_translation(transforms: Floats) -> Floats:
    """COLMAP's seven numbers (..., 7) of a pose: w x y z of the quaternion, translation."""
    q = se3.quaternion_from_rotation(transforms[..., :3, :3])
    return np.concatenate([q[..., 3:], q[..., :3], transforms[..., :3, 3]], -1)


def _cameras(scene: Scene) -> bytes:
    parts = [struct.pack("<Q", len(scene.drive.cameras))]
    for k, (camera, nearest) in enumerate(zip(scene.drive.cameras, colmap_models(scene), strict=True)):
        model = int(getattr(pycolmap.CameraModelId, nearest.model).value)
        parts.append(struct.pack("<IiQQ", k + 1, model, camera.width, camera.height))
        parts.append(np.asarray(nearest.params, dtype="<f8").tobytes())
    return b"".join(parts)


def _rigs(scene: Scene) -> bytes:
    poses = _wxyz_and_translation(se3.inverse(np.stack([c.rig_from_cam for c in scene.calibration])))
    rigs = np.unique(scene.rig_of_camera)
    parts = [struct.pack("<Q", len(rigs))]
    for rig in rigs:
        cameras = np.flatnonzero(scene.rig_of_camera == rig)
        parts.append(struct.pack("<IIiI", RIG_ID + rig, len(cameras) + 1, SENSOR_IMU, REFERENCE_SENSOR_ID + rig))
        parts += [struct.pack("<iIB7d", SENSOR_CAMERA, k + 1, 1, *poses[k]) for k in cameras.tolist()]
    return b"".join(parts)


def _frames(scene: Scene) -> bytes:
    frames = images_of_frames(scene)
    parts = [struct.pack("<Q", len(frames))]
    for frame, images in frames.items():
        first = scene.drive.images[images[0]]
        world_from_rig = scene.world_from_rig[first.unit]
        if scene.unit_from_image is not None:
            world_from_rig = world_from_rig @ scene.unit_from_image[images[0]]
        pose = _wxyz_and_translation(se3.inverse(world_from_rig))
        rig = RIG_ID + int(scene.rig_of_camera[first.camera])
        parts.append(struct.pack("<II7dI", frame, rig, *pose, len(images)))
        parts += [struct.pack("<iIQ", SENSOR_CAMERA, scene.drive.images[i].camera + 1, i + 1) for i in images]
    return b"".join(parts)


def _images(scene: Scene) -> bytes:
    poses = _wxyz_and_translation(se3.inverse(scene.world_from_cam))
    observations = _observations_by_image(scene)
    registered = np.flatnonzero(scene.image_registered)
    parts = [struct.pack("<Q", len(registered))]
    for i in registered.tolist():
        image, xy = scene.drive.images[i], scene.features[i].xy_px
        rows = np.zeros(len(xy), dtype=[("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
        rows["x"], rows["y"], rows["point"] = xy[:, 0], xy[:, 1], -1
        mine = observations[i]
        rows["point"][scene.observation_keypoint[mine]] = scene.observation_point[mine] + 1
        parts.append(struct.pack("<I7dI", i + 1, *poses[i], image.camera + 1))
        parts.append(image.file.encode("utf-8") + b"\0" + struct.pack("<Q", len(xy)) + rows.tobytes())
    return b"".join(parts)


def _observations_by_image(scene: Scene) -> list[Ints]:
    order = np.argsort(scene.observation_image, kind="stable")
    ends = np.cumsum(np.bincount(scene.observation_image, minlength=len(scene.drive.images)))
    return np.split(order, ends[:-1])


def _points(scene: Scene) -> bytes:
    n = len(scene.points_m)
    lengths = np.bincount(scene.observation_point, minlength=n)
    heads = np.zeros(
        n, dtype=[("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    )
    heads["id"], heads["xyz"], heads["color"] = np.arange(1, n + 1), scene.points_m, scene.point_colors
    heads["error"], heads["length"] = scene.point_error_px, lengths
    tracks = np.zeros(len(scene.observation_point), dtype=[("image", "<u4"), ("keypoint", "<u4")])
    tracks["image"], tracks["keypoint"] = scene.observation_image + 1, scene.observation_keypoint
    # Heads and tracks of different lengths alternate: scatter both to their places in one buffer.
    head_size, track_size = heads.dtype.itemsize, tracks.dtype.itemsize
    out = np.zeros(n * head_size + len(tracks) * track_size, dtype=np.uint8)
    starts = np.arange(n) * head_size + (np.cumsum(lengths) - lengths) * track_size
    out[starts[:, None] + np.arange(head_size)] = heads.view(np.uint8).reshape(n, head_size)
    places = (scene.observation_point + 1) * head_size + np.arange(len(tracks)) * track_size
    out[places[:, None] + np.arange(track_size)] = tracks.view(np.uint8).reshape(len(tracks), track_size)
    return struct.pack("<Q", n) + out.tobytes()
