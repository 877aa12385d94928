"""Imports a synchronised and rectified drive of KITTI raw as it is distributed.

Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and its development kit: a folder of every
day with `calib_*.txt`, and in it `DATE_drive_NNNN_sync` with `image_00` to `image_03` (`data/`, `timestamps.txt`) and
`oxts`. The rig frame is the inertial navigation unit's: x forward, y left, z up.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    SourceUnit,
    choose_scene,
    gnss_of_vehicle,
    interpolated_poses,
    pose_of_projection,
    proper_transform,
)
from mrasfm_engine.importers.rig_folder import numbered_images, pinhole_camera
from mrasfm_engine.importers.skipped_images import notes_of_empty_cameras, unread_files
from mrasfm_engine.importers.tables import read_lines, read_numbers
from mrasfm_engine.types import Floats, Ints
from schemas import Camera, Gnss

DESCRIPTION = "calib_cam_to_cam.txt and DATE_drive_NNNN_sync (KITTI raw)"
OPTIONS = ("scene",)
CAMERAS = ("image_00", "image_01", "image_02", "image_03")

OXTS_COLUMNS = 30
GEODETIC, ROLL, PITCH, YAW, POSITION_ACCURACY = [0, 1, 2], 3, 4, 5, 23
# The unit states one accuracy, of north and east. Satellites stand above and never below: heights are about half as
# well known.
VERTICAL_OVER_HORIZONTAL = 2.0
TIMES_NOTE = "Times: KITTI's local ones, taken as UTC."
GNSS_NOTE = "GNSS: positions of an inertial navigation system. Heights are above the sea, taken as ellipsoidal."


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout: a drive, a day, or a folder of days."""
    return bool(_drives(folder))


def _drives(folder: Path) -> dict[str, Path]:
    pattern = "*_drive_*_sync"
    candidates = [folder.resolve(), *folder.glob(pattern), *folder.glob(f"*/{pattern}")]
    found = [c for c in candidates if c.match(pattern) and any((c / name / "data").is_dir() for name in CAMERAS)]
    count = Counter(path.name for path in found)
    return {
        path.name if count[path.name] == 1 else f"{path.parent.resolve().name}/{path.name}": path
        for path in sorted(found)
    }


def read(folder: Path, scene: str | None = None) -> Recording:
    """Read one drive; images are not opened.

    One trigger releases all cameras, so the images of a frame are simultaneous, and their mean time is the unit's. The
    times in their files lie some milliseconds apart, which the images contradict: on drive 0001 of 2011-09-26 they set
    the grey cameras 6 ms after the coloured ones, 8 cm at its speed, and the mean reprojection error grows from 0.38 to
    0.56 px where they are believed.

    Parameters
    ----------
    scene
        Name of the drive's folder, as `2011_09_26_drive_0001_sync`; may be left out if there is only one.

    Raises
    ------
    InputError
        If the drive is not there, or a file is missing or malformed.
    """
    drive = choose_scene(_drives(folder), scene, folder).resolve()
    day = drive.parent
    every = {camera: numbered_images(drive / camera / "data") for camera in CAMERAS if (drive / camera).is_dir()}
    images = {camera: files for camera, files in every.items() if files}
    frames = sorted({frame for files in images.values() for frame in files})
    if not frames:
        raise InputError(f"recording {drive} has no images", remedy="Unpack the images.", code="no-images")
    times_us = {camera: _times_us(drive / camera / "timestamps.txt") for camera in images}
    for camera, files in images.items():
        _require_time(drive / camera / "timestamps.txt", times_us[camera], max(files))
    unit_times_us = np.array(
        [round(np.mean([times_us[c][f] for c, files in images.items() if f in files])) for f in frames], dtype=np.int64
    )
    ins = _read_ins(drive / "oxts")
    gnss = None if ins is None else _gnss(*ins, drive / "oxts")
    truth = [None] * len(frames) if ins is None else interpolated_poses(ins[0], _poses(ins[1]), unit_times_us)
    calibration = _table(day / "calib_cam_to_cam.txt")
    rig_from_cam0 = _rig_from_cam0(calibration, day)
    return Recording(
        layout="KITTI raw",
        name=f"kitti-{drive.name}",
        cameras=[_camera(camera, files, calibration, rig_from_cam0, day) for camera, files in images.items()],
        units=[
            SourceUnit(
                source_frame=frame,
                timestamp_us=int(unit_times_us[i]),
                images={c: SourceImage(file=files[frame]) for c, files in images.items() if frame in files},
                world_from_rig=truth[i],
            )
            for i, frame in enumerate(frames)
        ],
        gnss=gnss,
        truth_is_gnss=True,
        notes=[*([] if gnss is None else [GNSS_NOTE]), TIMES_NOTE, *notes_of_empty_cameras(every)],
        unread_files={camera: unread_files(drive / camera / "data") for camera in CAMERAS},
    )


def _camera(
    name: str, images: dict[int, Path], calibration: dict[str, Floats], rig_from_cam0: Floats, day: Path
) -> Camera:
    file, key = day / "calib_cam_to_cam.txt", f"P_rect_{name[-2:]}"
    projection = _values(calibration, key, 12, file).reshape(3, 4)
    cam_from_cam0 = pose_of_projection(projection, what=f"{file}: {key}")
    rig_from_cam = rig_from_cam0 @ se3.inverse(cam_from_cam0)
    return pinhole_camera(name, images, projection[:, :3], rig_from_cam, source=f"{file}: {key}")


def _rig_from_cam0(calibration: dict[str, Floats], day: Path) -> Floats:
    """Pose of rectified camera 0 in the frame of the inertial navigation unit."""
    file = day / "calib_cam_to_cam.txt"
    rectified = np.eye(4)
    rectified[:3, :3] = _values(calibration, "R_rect_00", 9, file).reshape(3, 3)
    cam0_from_velodyne = _rigid(day / "calib_velo_to_cam.txt")
    velodyne_from_rig = _rigid(day / "calib_imu_to_velo.txt")
    cam0_from_rig = proper_transform(rectified, what=f"{file}: R_rect_00") @ cam0_from_velodyne @ velodyne_from_rig
    return se3.inverse(cam0_from_rig)


def _rigid(file: Path) -> Floats:
    table = _table(file)
    rotation, translation = _values(table, "R", 9, file).reshape(3, 3), _values(table, "T", 3, file)
    return proper_transform(np.column_stack([rotation, translation]), what=str(file))


def _table(file: Path) -> dict[str, Floats]:
    """Lines `KEY: numbers` by their keys; other lines, as the time of calibration, are left out."""
    found: dict[str, Floats] = {}
    for line in read_lines(file, what="calibration"):
        key, _, rest = line.partition(":")
        try:
            found[key] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    return found


def _values(table: dict[str, Floats], key: str, count: int, file: Path) -> Floats:
    values = table.get(key, np.empty(0))
    if values.shape != (count,) or not np.isfinite(values).all():
        raise InputError(
            f"calibration {file}: {key} is not {count} numbers",
            remedy="Give the calibration files of the day as they are distributed.",
            code="bad-calibration",
        )
    return values


def _times_us(file: Path) -> Ints:
    """Microseconds (n,) since 1970 of lines `2011-09-26 13:02:25.964389445`."""
    times = []
    for number, line in enumerate(read_lines(file, what="times"), start=1):
        whole, _, fraction = line.strip().partition(".")
        try:
            if not re.fullmatch(r"[0-9]{1,12}", fraction):
                raise ValueError(fraction)
            second = datetime.datetime.fromisoformat(whole).replace(tzinfo=datetime.UTC)
            times.append(round(second.timestamp()) * 1_000_000 + round(float(f"0.{fraction}") * 1e6))
        except ValueError:
            raise InputError(
                f"times {file}, line {number}: {line[:60]!r} is no date with a time",
                remedy="Give lines as 2011-09-26 13:02:25.964389445.",
                code="bad-table",
            ) from None
        if len(times) > 1 and times[-1] <= times[-2]:
            raise InputError(
                f"times {file}, line {number}: does not come after the line before it",
                remedy="Give increasing times.",
                code="times-not-increasing",
            )
    return np.array(times, dtype=np.int64)


def _require_time(file: Path, times_us: Ints, frame: int) -> None:
    if frame >= len(times_us):
        raise InputError(
            f"times {file} has {len(times_us)} lines, but there is a file of frame {frame}",
            remedy="Give one time for every frame, counted from 0.",
            code="missing-times",
        )


def _read_ins(folder: Path) -> tuple[Ints, Floats] | None:
    """Times (n,) and values (n, 30) of the inertial navigation system, where there are any."""
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        return None
    times_us = _times_us(folder / "timestamps.txt")
    if unnumbered := [file for file in files if not file.stem.isdecimal()]:
        raise InputError(f"{unnumbered[0]} is not named by a frame number", remedy="Remove it.", code="bad-name")
    files.sort(key=lambda file: int(file.stem))
    numbers = [int(file.stem) for file in files]
    _require_time(folder / "timestamps.txt", times_us, numbers[-1])
    return times_us[numbers], np.stack([_ins_values(file) for file in files])


def _ins_values(file: Path) -> Floats:
    rows = read_numbers(file, what="oxts", columns=OXTS_COLUMNS)
    if not len(rows):
        raise InputError(f"oxts {file} has no values", remedy="Unpack the drive again.", code="bad-table")
    values: Floats = rows[0]
    return values


def _gnss(times_us: Ints, rows: Floats, folder: Path) -> Gnss:
    accuracy_m = rows[:, POSITION_ACCURACY]
    return gnss_of_vehicle(
        times_us, rows[:, GEODETIC], accuracy_m, VERTICAL_OVER_HORIZONTAL * accuracy_m, source=f"oxts {folder}"
    )


def _poses(rows: Floats) -> Floats:
    """`world_from_rig` (n, 4, 4) in the east-north-up frame at the first sample."""
    geodetic = rows[:, GEODETIC]
    positions = geodesy.local_from_geodetic(geodetic, geodesy.ecef_from_local(geodetic[0]))
    about_x, about_y, about_z = (
        se3.exp_so3(np.outer(rows[:, column], axis)) for column, axis in zip((ROLL, PITCH, YAW), np.eye(3), strict=True)
    )
    return se3.transform(about_z @ about_y @ about_x, positions)
