"""Imports a log of Argoverse 2's sensor data set as it is distributed.

Source: Wilson et al., "Argoverse 2: Next Generation Datasets for Self-Driving Perception and Forecasting", NeurIPS
2021, and its API: `calibration/*.feather`, `city_SE3_egovehicle.feather` and `sensors/cameras/NAME/TIME.jpg`, named by
nanoseconds. The rig frame is its egovehicle frame: x forward, y left, z up, origin on the rear axle. The images are
undistorted already: k1 to k3 of the table of intrinsics are those of the lens before that, and are not applied.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.arrow_tables import Columns, read_feather
from mrasfm_engine.importers.frame_grouping import units_by_time
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    choose_scene,
    interpolated_poses,
    notes_of_poses_elsewhere,
    with_truth,
)
from mrasfm_engine.importers.rig_folder import numbered_images, pinhole_camera
from mrasfm_engine.importers.skipped_images import notes_of_empty_cameras, unread_files
from mrasfm_engine.types import Floats, Ints
from schemas import Camera
from schemas.drive import MAX_CAMERAS

DESCRIPTION = "city_SE3_egovehicle.feather and sensors/cameras (Argoverse 2)"
OPTIONS = ("scene",)
POSES = "city_SE3_egovehicle.feather"
EXTRINSICS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
QUATERNION, TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
TIME_DIGITS = 19  # of nanoseconds
_CITY = re.compile(r"____([A-Z]{3})_city_[0-9]+\.json")
NOTES = [
    "Images: undistorted as distributed; k1 to k3 of Argoverse 2's table of intrinsics are not applied.",
    "Shutter: the tables do not say whether a camera reads its rows one after the other.",
]


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout: a log, or a folder of logs."""
    return bool(_logs(folder))


def _logs(folder: Path) -> dict[str, Path]:
    candidates = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    found = [c for c in candidates if (c / POSES).is_file() and (c / "sensors" / "cameras").is_dir()]
    return {path.resolve().name if path == folder else path.name: path for path in found}


def read(folder: Path, scene: str | None = None) -> Recording:
    """Read one log; of the images only the first of each camera is opened.

    Parameters
    ----------
    scene
        Name of the log's folder; may be left out if there is only one.

    Raises
    ------
    InputError
        If the log is not there, a file is missing or malformed, or pyarrow is not installed.
    """
    log = choose_scene(_logs(folder), scene, folder).resolve()
    every = {
        path.name: numbered_images(path, digits=TIME_DIGITS, named_by="time in nanoseconds")
        for path in sorted((log / "sensors" / "cameras").iterdir())
        if path.is_dir()
    }
    images = {name: files for name, files in every.items() if files}
    if not 1 <= len(images) <= MAX_CAMERAS:
        raise InputError(
            f"{log / 'sensors' / 'cameras'} has images of {len(images)} cameras",
            remedy="Download the log's cameras.",
            code="no-images",
        )
    extrinsics, intrinsics = read_feather(log / EXTRINSICS), read_feather(log / INTRINSICS)
    rig_from_sensor = extrinsics.poses(QUATERNION, TRANSLATION)
    cameras = [
        _camera(name, files, intrinsics, rig_from_sensor[_row(extrinsics, name)]) for name, files in images.items()
    ]
    units = units_by_time(
        {
            name: [SourceImage(file=files[ns], timestamp_us=(ns + 500) // 1000) for ns in sorted(files)]
            for name, files in images.items()
        }
    )
    times_us, world_from_rig = _poses(log / POSES)
    truth = interpolated_poses(times_us, world_from_rig, np.array([unit.timestamp_us for unit in units]))
    city = _city(log)
    return Recording(
        layout="Argoverse 2",
        name=f"av2-{log.name}",
        cameras=cameras,
        units=with_truth(units, truth),
        common_world=None if city is None else f"av2-{city}",
        notes=[*NOTES, *notes_of_empty_cameras(every), *notes_of_poses_elsewhere(units, times_us, truth)],
        unread_files={name: unread_files(log / "sensors" / "cameras" / name) for name in every},
    )


def _row(table: Columns, sensor: str) -> int:
    names = table.texts("sensor_name")
    if names.count(sensor) != 1:
        raise InputError(
            f"table {table.source} has {names.count(sensor)} rows of sensor {sensor}, of which there are images",
            remedy="Download the log's calibration again.",
            code="bad-calibration",
        )
    return names.index(sensor)


def _camera(name: str, images: dict[int, Path], table: Columns, rig_from_cam: Floats) -> Camera:
    row = _row(table, name)
    fx, fy, cx, cy, width, height = table.numbers("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")[row]
    source = f"{table.source}: {name}"
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    camera = pinhole_camera(name, images, matrix, rig_from_cam, source=source)
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{source} is of {width:g}x{height:g} pixels, {images[min(images)]} has {camera.width}x{camera.height}",
            remedy="Give the images as they are distributed.",
            code="bad-calibration",
        )
    return camera


def _poses(file: Path) -> tuple[Ints, Floats]:
    """Times (n,) in microseconds, rising, and poses (n, 4, 4) of the vehicle in the city."""
    table = read_feather(file)
    times_us, first = np.unique(
        (np.array(table.integers("timestamp_ns"), dtype=np.int64) + 500) // 1000, return_index=True
    )
    if not len(times_us):
        raise InputError(f"table {file} is empty", remedy="Download it again.", code="bad-table")
    return times_us, table.poses(QUATERNION, TRANSLATION)[first]


def _city(log: Path) -> str | None:
    """The city's code, which names of the map's files hold."""
    found = {match[1] for path in (log / "map").glob("*.json") if (match := _CITY.search(path.name))}
    return found.pop() if len(found) == 1 else None
