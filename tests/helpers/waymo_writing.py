"""Writes a drive as a segment of the Waymo Open Dataset, version 2, with the columns of its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pyarrow import parquet, table

from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.scene.drive import Drive
from schemas import BodyAxes

CAMERAS = ("front", "front_left", "front_right", "side_left", "side_right")
DIRECTIONS = {"top_to_bottom": 1, "left_to_right": 2, "bottom_to_top": 3, "right_to_left": 4}
SHUTTER_S = 0.005
OWN_FROM_OPTICAL = flu_from_body(BodyAxes.RDF)  # Waymo's cameras have x forward, y left, z up


def write_segment(drive: Drive, truth: dict[int, np.ndarray], folder: Path, name: str) -> Path:
    """Write a drive whose cameras have Waymo's names, models of plumb bob and a readout.

    Parameters
    ----------
    truth
        Poses (4, 4) of the vehicle by their times in microseconds, those of all images among them.
    """
    calibration: dict[str, list[Any]] = {}
    for camera, rig_from_cam in zip(drive.cameras, drive.rig_from_cam, strict=True):
        fx, fy, cx, cy, *rest = camera.params
        k1, k2, p1, p2, k3 = [*rest[:5], *[0.0] * (5 - len(rest[:5]))]
        values = {"f_u": fx, "f_v": fy, "c_u": cx, "c_v": cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
        direction = "top_to_bottom" if camera.readout_direction is None else str(camera.readout_direction)
        prefix = "[CameraCalibrationComponent]"
        row = {
            "key.segment_context_name": name,
            "key.camera_name": CAMERAS.index(camera.name) + 1,
            **{f"{prefix}.intrinsic.{key}": value for key, value in values.items()},
            f"{prefix}.extrinsic.transform": (rig_from_cam @ np.linalg.inv(OWN_FROM_OPTICAL)).ravel().tolist(),
            f"{prefix}.width": camera.width,
            f"{prefix}.height": camera.height,
            f"{prefix}.rolling_shutter_direction": 5 if camera.readout_us == 0 else DIRECTIONS[direction],
        }
        for key, value in row.items():
            calibration.setdefault(key, []).append(value)
    images: dict[str, list[Any]] = {}
    for image in drive.images:
        camera, prefix = drive.cameras[image.camera], "[CameraImageComponent]"
        half_s = (camera.readout_us or 0) / 2e6
        trigger_s = image.timestamp_us / 1e6 - half_s - SHUTTER_S / 2
        row = {
            "key.segment_context_name": name,
            "key.frame_timestamp_micros": int(drive.timestamps_us[image.unit]),
            "key.camera_name": CAMERAS.index(camera.name) + 1,
            f"{prefix}.image": jpeg(drive.root / image.file),
            f"{prefix}.pose.transform": truth[image.timestamp_us].ravel().tolist(),
            f"{prefix}.pose_timestamp": image.timestamp_us / 1e6,
            f"{prefix}.rolling_shutter_params.shutter": SHUTTER_S,
            f"{prefix}.rolling_shutter_params.camera_trigger_time": trigger_s,
            f"{prefix}.rolling_shutter_params.camera_readout_done_time": trigger_s + 2 * half_s + SHUTTER_S,
        }
        for key, value in row.items():
            images.setdefault(key, []).append(value)
    times_us = sorted(truth)
    poses = {
        "key.segment_context_name": [name] * len(times_us),
        "key.frame_timestamp_micros": times_us,
        "[VehiclePoseComponent].world_from_vehicle.transform": [truth[t].ravel().tolist() for t in times_us],
    }
    for kind, rows in (("camera_calibration", calibration), ("camera_image", images), ("vehicle_pose", poses)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        parquet.write_table(table(rows), folder / kind / f"{name}.parquet", row_group_size=7)
    return folder


def jpeg(path: Path) -> bytes:
    if path.suffix == ".jpg":
        return path.read_bytes()
    return cv2.imencode(".jpg", cv2.imread(str(path), cv2.IMREAD_UNCHANGED))[1].tobytes()
