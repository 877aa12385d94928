"""Format `nerfstudio`: `transforms.json` with undistorted images, their masks, and the points as `points.ply`.

Cameras look along their -z axis there, with y upwards; the world is the local frame.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.export import comparisons, ply, readers
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportWork, Written
from mrasfm_engine.export.scene import write_json
from mrasfm_engine.export.undistorted import IMAGES, MASKS, undistorted, write_images
from mrasfm_engine.scene.scene import Scene

TRANSFORMS, POINTS = "transforms.json", "points.ply"
CAM_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(work: ExportWork) -> Written:
    """Write the folder."""
    made = undistorted(work.source, work.options.image_size_px)
    checks = write_images(work, made)
    masked = (work.folder / MASKS).is_dir()
    digests = {
        TRANSFORMS: write_json(work.folder / TRANSFORMS, _document(made.scene, masked=masked)),
        POINTS: ply.write_ply(made.scene, work.folder / POINTS),
    }
    checks += [
        Check(TRANSFORMS, readers.json_object, partial(_compare, made.scene, masked)),
        Check(POINTS, readers.ply, partial(_compare_points, made.scene)),
    ]
    return Written(checks=checks, notes=made.notes(), digests=digests)


def _document(scene: Scene, *, masked: bool) -> dict[str, Any]:
    frames = []
    for image, pose in zip(scene.drive.images, scene.world_from_cam @ CAM_FROM_OPENGL, strict=True):
        camera = scene.drive.cameras[image.camera]
        fx, fy, cx, cy = camera.params
        frame = {
            "file_path": f"{IMAGES}/{image.file}",
            **({"mask_path": f"{MASKS}/{image.file}.png"} if masked else {}),
            "camera_model": camera.model,
            **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": camera.width, "h": camera.height},
            "transform_matrix": pose.tolist(),
            "timestamp_us": image.timestamp_us,
            "camera": camera.name,
        }
        frames.append(frame)
    return {"camera_model": "PINHOLE", "ply_file_path": POINTS, "frames": frames}


def _compare(scene: Scene, masked: bool, document: dict[str, Any]) -> Rows:
    """Every frame: its files, camera, time, and its pose as rows of the camera's axes in the world."""
    yield Row("its model and points", (document["camera_model"], document["ply_file_path"]), ("PINHOLE", POINTS))
    frames, images = document["frames"], scene.drive.images
    yield Row("its number of frames", len(frames), len(images))
    for number, (frame, image) in enumerate(zip(frames, images, strict=True)):
        name, camera = image.file, scene.drive.cameras[image.camera]
        files = (frame["file_path"], frame.get("mask_path"))
        yield Row(f"the files of {name}", files, (f"{IMAGES}/{name}", f"{MASKS}/{name}.png" if masked else None))
        size = (frame["camera_model"], frame["w"], frame["h"], frame["camera"], frame["timestamp_us"])
        expected = ("PINHOLE", camera.width, camera.height, camera.name, image.timestamp_us)
        yield Row(f"camera and time of {name}", size, expected)
        yield Row(f"intrinsics of {name}", [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")], camera.params)
        world_from_rig = scene.world_from_rig[image.unit]
        if scene.unit_from_image is not None:
            world_from_rig = world_from_rig @ scene.unit_from_image[number]
        right, down, ahead, centre = (world_from_rig @ scene.calibration[image.camera].rig_from_cam).T[:, :3]
        pose = np.vstack([np.stack([right, -down, -ahead, centre], 1), [0.0, 0.0, 0.0, 1.0]])
        yield Row(f"the pose of {name}", frame["transform_matrix"], pose, comparisons.ROUNDING)


def _compare_points(scene: Scene, rows: NDArray[Any]) -> Rows:
    yield from comparisons.ply(scene, rows)
    xyz = np.stack([rows[name] for name in "xyz"], -1)
    yield Row("a point", xyz, scene.points_m.astype(xyz.dtype))
    yield Row("an error", rows["error_px"], scene.point_error_px.astype(np.float32))
    lengths = np.bincount(scene.observation_point, minlength=len(scene.points_m))
    yield Row("a track's length", rows["track_length"], lengths.astype(np.int32))
