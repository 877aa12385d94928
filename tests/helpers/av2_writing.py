"""Writes a drive as a log of Argoverse 2, with tables of its schema."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from pyarrow import feather, table

from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import Drive

CITY = "PIT"
LENS = (-0.24, -0.21, 0.11)  # k1 to k3 of a real table: of the lens, which the images do not show any more


def columns_of_poses(a_from_b: np.ndarray) -> dict[str, np.ndarray]:
    xyzw = se3.quaternion_from_rotation(a_from_b[:, :3, :3])
    values = np.hstack([xyzw[:, [3, 0, 1, 2]], a_from_b[:, :3, 3]])
    return dict(zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), values.T, strict=True))


def write_log(drive: Drive, truth: dict[int, np.ndarray], folder: Path) -> Path:
    """Write a drive of pinhole cameras whose images are simultaneous.

    Parameters
    ----------
    truth
        Poses (4, 4) of the vehicle in the city by their times in microseconds.
    """
    (folder / "calibration").mkdir(parents=True)
    (folder / "map").mkdir()
    (folder / "map" / f"log_map_archive_{folder.name}____{CITY}_city_31785.json").write_text("{}")
    names = [camera.name for camera in drive.cameras]
    poses = {"sensor_name": names, **columns_of_poses(drive.rig_from_cam)}
    feather.write_feather(table(poses), folder / "calibration" / "egovehicle_SE3_sensor.feather")
    fx, fy, cx, cy = np.array([camera.params for camera in drive.cameras]).T
    intrinsics = {"sensor_name": names, "fx_px": fx, "fy_px": fy, "cx_px": cx - 0.5, "cy_px": cy - 0.5}
    intrinsics |= {name: np.full(len(names), value) for name, value in zip(("k1", "k2", "k3"), LENS, strict=True)}
    intrinsics |= {
        "height_px": np.array([camera.height for camera in drive.cameras], dtype=np.uint32),
        "width_px": np.array([camera.width for camera in drive.cameras], dtype=np.uint32),
    }
    feather.write_feather(table(intrinsics), folder / "calibration" / "intrinsics.feather")
    times_us = sorted(truth)
    city = {"timestamp_ns": np.array(times_us) * 1000, **columns_of_poses(np.stack([truth[t] for t in times_us]))}
    feather.write_feather(table(city), folder / "city_SE3_egovehicle.feather")
    for image in drive.images:
        target = folder / "sensors" / "cameras" / names[image.camera]
        target.mkdir(parents=True, exist_ok=True)
        source = drive.root / image.file
        shutil.copyfile(source, target / f"{image.timestamp_us * 1000}{source.suffix}")
    return folder
