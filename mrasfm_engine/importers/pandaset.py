"""Imports a sequence of PandaSet as it is distributed.

Source: Xiao et al., "PandaSet: Advanced Sensor Suite Dataset for Autonomous Driving", ITSC 2021, and its development
kit: `camera/NAME/NN.jpg` with `intrinsics.json`, `poses.json` (world_from_cam: x right, y down, z forward) and
`timestamps.json`, `lidar/poses.json` and `lidar/timestamps.json` (the vehicle: x right, y forward, z up), and
`meta/gps.json`. The images are rectified already: the distortion in the development kit's table is not theirs. No file
holds the cameras' poses on the vehicle; they follow from the poses of both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, RootModel

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    SourceUnit,
    choose_scene,
    gnss_of_vehicle,
    interpolated_poses,
)
from mrasfm_engine.importers.rig_folder import numbered_images, pinhole_camera
from mrasfm_engine.importers.skipped_images import unread_files
from mrasfm_engine.io.documents import read_document
from mrasfm_engine.types import Bools, Floats, Ints
from schemas import Camera, Gnss
from schemas.drive import MAX_CAMERAS, Finite

DESCRIPTION = "camera/*/intrinsics.json and lidar/poses.json (PandaSet)"
OPTIONS = ("scene",)

# PandaSet does not state it. Its GNSS and the vehicle's poses are two outputs of one inertial navigation system with
# corrections, and agree to some centimetres.
SIGMA_GNSS_M = 0.05
NOTES_OF_GNSS = [
    "GNSS: PandaSet states no accuracy, 0.05 m is assumed. Its heights are above the sea, taken as ellipsoidal.",
    "The truth and the GNSS are outputs of one inertial navigation system: their errors are not independent.",
]
# Beyond this, the poses of a camera and of the vehicle are not those of one rigid vehicle at the times given: the
# extrinsic would be a mean of what never was. Intact sequences stay below a tenth of it.
MAX_SPREAD_M, MAX_SPREAD_DEG = 0.05, 1.0

_VEHICLE_FROM_RIG = se3.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0])  # x right, y forward from flu


class _Row(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class _Position(_Row):
    x: Finite
    y: Finite
    z: Finite


class _Heading(_Position):
    w: Finite


class _PoseRow(_Row):
    position: _Position
    heading: _Heading


class _Intrinsics(_Row):
    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite


class _GpsRow(_Row):
    lat: Finite
    long: Finite
    height: Finite


_Seconds = Annotated[float, Field(ge=0, le=1e11)]


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout: a sequence, or a folder of sequences."""
    return bool(_sequences(folder))


def _sequences(folder: Path) -> dict[str, Path]:
    candidates = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    found = [c for c in candidates if (c / "lidar/poses.json").is_file() and (c / "camera").is_dir()]
    return {path.resolve().name: path for path in found}


def read(folder: Path, scene: str | None = None) -> Recording:
    """Read one sequence; images are not opened.

    A unit's time is the mean of its images' times, which are up to 0.1 s apart.

    Parameters
    ----------
    scene
        Name of the sequence's folder, as `002`; may be left out if there is only one.

    Raises
    ------
    InputError
        If the sequence is not there, a file is missing or malformed, or the cameras' poses do not fit the vehicle's.
    """
    sequence = choose_scene(_sequences(folder), scene, folder).resolve()
    vehicle_times_us, world_from_vehicle = _timed_poses(sequence / "lidar")
    world_from_rig = world_from_vehicle @ _VEHICLE_FROM_RIG
    cameras: list[Camera] = []
    by_frame: dict[int, dict[str, SourceImage]] = {}
    for camera_folder in sorted(path for path in (sequence / "camera").iterdir() if path.is_dir()):
        times_us, world_from_cam = _timed_poses(camera_folder)
        images = _images(camera_folder, times_us)
        rig_from_cam = _extrinsic(camera_folder, times_us, world_from_cam, vehicle_times_us, world_from_rig)
        cameras.append(_camera(camera_folder, images, rig_from_cam))
        for frame, file in images.items():
            image = SourceImage(file=file, timestamp_us=int(times_us[frame]))
            by_frame.setdefault(frame, {})[camera_folder.name] = image
    if not 1 <= len(cameras) <= MAX_CAMERAS:
        raise InputError(f"{sequence / 'camera'} holds {len(cameras)} cameras", remedy="Unpack the sequence again.")
    frames = sorted(by_frame)
    unit_times_us = np.array([_mean_time_us(by_frame[frame]) for frame in frames])
    truth = interpolated_poses(vehicle_times_us, world_from_rig, unit_times_us)
    units = [
        SourceUnit(source_frame=frame, timestamp_us=int(t), images=by_frame[frame], world_from_rig=pose)
        for frame, t, pose in zip(frames, unit_times_us, truth, strict=True)
    ]
    gnss = _gnss(sequence)
    return Recording(
        layout="PandaSet",
        name=f"pandaset-{sequence.name}",
        cameras=cameras,
        units=units,
        gnss=gnss,
        notes=[] if gnss is None else [*NOTES_OF_GNSS],
        unread_files={camera.name: unread_files(sequence / "camera" / camera.name) for camera in cameras},
    )


def _mean_time_us(images: dict[str, SourceImage]) -> int:
    times_us = [image.timestamp_us for image in images.values() if image.timestamp_us is not None]
    return round(sum(times_us) / len(times_us))


def _timed_poses(folder: Path) -> tuple[Ints, Floats]:
    """Times (n,) in microseconds, rising, and poses (n, 4, 4) of `timestamps.json` and `poses.json`."""
    file = folder / "poses.json"
    rows = read_document(file, RootModel[list[_PoseRow]], what="poses").root
    times_us = _times_us(folder, len(rows))
    quaternions = np.array([[r.heading.x, r.heading.y, r.heading.z, r.heading.w] for r in rows]).reshape(-1, 4)
    if not rows or abs(np.linalg.norm(quaternions, axis=1) - 1.0).max() > 1e-3:
        raise InputError(
            f"{file}: its headings are no unit quaternions", remedy="Unpack the sequence again.", code="bad-transform"
        )
    positions = np.array([[r.position.x, r.position.y, r.position.z] for r in rows])
    return times_us, se3.transform(se3.rotation_from_quaternion(quaternions), positions)


def _times_us(folder: Path, rows: int) -> Ints:
    file = folder / "timestamps.json"
    seconds = np.array(read_document(file, RootModel[list[_Seconds]], what="times").root)
    times_us = np.round(seconds * 1e6).astype(np.int64)
    if len(times_us) != rows or (np.diff(times_us) <= 0).any():
        raise InputError(
            f"times {file}: {len(times_us)} of {rows} rows, or not increasing",
            remedy="Unpack the sequence again.",
            code="times-not-increasing",
        )
    return times_us


def _images(folder: Path, times_us: Ints) -> dict[int, Path]:
    images = numbered_images(folder)
    if not images or max(images) >= len(times_us):
        raise InputError(
            f"camera {folder} has {len(images)} images and {len(times_us)} times",
            remedy="Unpack the sequence again.",
            code="missing-times",
        )
    return images


def _extrinsic(
    folder: Path, times_us: Ints, world_from_cam: Floats, vehicle_times_us: Ints, world_from_rig: Floats
) -> Floats:
    """The `rig_from_cam` that the poses of both agree on, over all images within the vehicle's poses."""
    at_images = interpolated_poses(vehicle_times_us, world_from_rig, times_us)
    within: Bools = np.array([pose is not None for pose in at_images])
    if not within.any():
        raise InputError(
            f"camera {folder} has no image within the times of lidar/poses.json",
            remedy="Unpack the sequence again.",
            code="bad-calibration",
        )
    world_from_rig = np.stack([pose for pose in at_images if pose is not None])
    all_found = se3.inverse(world_from_rig) @ world_from_cam[within]
    mean = se3.transform(se3.mean_rotation(all_found[:, :3, :3]), np.median(all_found[:, :3, 3], axis=0))
    away_m = np.linalg.norm(all_found[:, :3, 3] - mean[:3, 3], axis=1)
    away_deg = se3.rotation_angle_deg(mean[:3, :3].T @ all_found[:, :3, :3])
    if np.median(away_m) > MAX_SPREAD_M or np.median(away_deg) > MAX_SPREAD_DEG:
        raise InputError(
            f"camera {folder}: its poses and the vehicle's disagree by {np.median(away_m):.2f} m and "
            f"{np.median(away_deg):.2f} deg from image to image",
            remedy="Unpack the sequence again.",
            code="bad-calibration",
        )
    return mean


def _camera(folder: Path, images: dict[int, Path], rig_from_cam: Floats) -> Camera:
    file = folder / "intrinsics.json"
    k = read_document(file, _Intrinsics, what="calibration")
    matrix = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    return pinhole_camera(folder.name, images, matrix, rig_from_cam, source=str(file))


def _gnss(sequence: Path) -> Gnss | None:
    file = sequence / "meta" / "gps.json"
    if not file.exists():
        return None
    rows = read_document(file, RootModel[list[_GpsRow]], what="GNSS file").root
    geodetic = np.array([[row.lat, row.long, row.height] for row in rows]).reshape(-1, 3)
    sigma_m = np.full(len(rows), SIGMA_GNSS_M)
    times_us = _times_us(sequence / "meta", len(rows))
    return gnss_of_vehicle(times_us, geodetic, sigma_m, sigma_m, source=f"GNSS file {file}")
