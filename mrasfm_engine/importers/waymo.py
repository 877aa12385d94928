"""Imports a segment of the Waymo Open Dataset, version 2 (perception), as it is distributed.

Source: Sun et al., "Scalability in Perception for Autonomous Driving: Waymo Open Dataset", CVPR 2020, and the
definitions of its tables: `camera_image`, `camera_calibration`, `vehicle_pose`, each with a Parquet file per segment.
The rig frame is its vehicle frame: x forward, y left, z up, on the ground below the rear axle's middle. Its cameras
have x forward, y left, z up. Its camera model counts pixels as manifests do, from the corner of the first one: images
span 0 to their width, and the readout takes y of their height. Shutters roll, on some cameras column by column.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.arrow_tables import Columns, parquet_batches, read_parquet
from mrasfm_engine.importers.lenses import lens_from_distortion
from mrasfm_engine.importers.recording import (
    ImageKey,
    Recording,
    SourceImage,
    SourceUnit,
    choose_scene,
    interpolated_poses,
    notes_of_poses_elsewhere,
    with_truth,
)
from mrasfm_engine.importers.rig_folder import checked_camera
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.types import Floats, Ints
from schemas import BodyAxes, Camera
from schemas.drive import MAX_READOUT_US, ReadoutDirection
from schemas.image_header import ImageHeaderError, header_of

DESCRIPTION = "camera_image, camera_calibration and vehicle_pose with Parquet files (Waymo, version 2)"
OPTIONS = ("scene",)
IMAGES, CALIBRATIONS, POSES = "camera_image", "camera_calibration", "vehicle_pose"
CAMERAS = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
GLOBAL_SHUTTER = 5
DIRECTIONS = {
    1: ReadoutDirection.TOP_TO_BOTTOM,
    2: ReadoutDirection.LEFT_TO_RIGHT,
    3: ReadoutDirection.BOTTOM_TO_TOP,
    4: ReadoutDirection.RIGHT_TO_LEFT,
}
MAX_SPREAD_US = 1000  # of a camera's readouts, which are one property of it
ROWS = 4  # images of a batch, 1 MB each

_TIME, _CAMERA = "key.frame_timestamp_micros", "key.camera_name"
_IMAGE, _CALIBRATION = "[CameraImageComponent]", "[CameraCalibrationComponent]"
_CONTENT, _POSE, _POSE_TIME = f"{_IMAGE}.image", f"{_IMAGE}.pose.transform", f"{_IMAGE}.pose_timestamp"
_VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_SHUTTER = f"{_IMAGE}.rolling_shutter_params.shutter"
_TRIGGERED = tuple(
    f"{_IMAGE}.rolling_shutter_params.{name}" for name in ("camera_trigger_time", "camera_readout_done_time")
)
_INTRINSICS = tuple(
    f"{_CALIBRATION}.intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
)
_SIZE, _DIRECTION = (f"{_CALIBRATION}.width", f"{_CALIBRATION}.height"), f"{_CALIBRATION}.rolling_shutter_direction"
_EXTRINSIC = f"{_CALIBRATION}.extrinsic.transform"


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout: one that holds the folders of the tables."""
    return bool(_segments(folder))


def _segments(folder: Path) -> dict[str, Path]:
    """Names of segments whose images and calibration are there."""
    found = sorted((folder / IMAGES).glob("*.parquet"))
    return {path.stem: path for path in found if (folder / CALIBRATIONS / path.name).is_file()}


def read(folder: Path, scene: str | None = None) -> Recording:
    """Read one segment; the images are read by the recording's `contents`.

    An image's time is that of its middle row or column, halfway between the trigger and the end of the readout.

    Parameters
    ----------
    scene
        Name of the segment's files; may be left out if there is only one.

    Raises
    ------
    InputError
        If the segment is not there, a table is missing or malformed, or pyarrow is not installed.
    """
    file = choose_scene(_segments(folder), scene, folder)
    images = read_parquet(file, [_TIME, _CAMERA, _POSE, _POSE_TIME, *_TRIGGERED, _SHUTTER])
    frames_us, cameras = images.integers(_TIME), images.integers(_CAMERA)
    trigger_s, done_s = images.seconds(*_TRIGGERED).T
    times_us = np.round((trigger_s + done_s) * 5e5).astype(np.int64)
    readouts_us = (done_s - trigger_s - images.numbers(_SHUTTER)[:, 0]) * 1e6
    if not frames_us:
        raise InputError(f"table {file} has no images", remedy="Download it again.", code="no-images")
    if unknown := sorted({camera for camera in cameras if camera not in CAMERAS}):
        raise InputError(f"table {file}: camera {unknown[0]} is not known", remedy="Download it again.")
    calibration = read_parquet(
        folder / CALIBRATIONS / file.name, [_CAMERA, *_INTRINSICS, *_SIZE, _DIRECTION, _EXTRINSIC]
    )
    of_camera = {camera: readouts_us[np.array(cameras) == camera] for camera in sorted(set(cameras))}
    rig = [_camera(camera, calibration, own) for camera, own in of_camera.items()]
    if len({*zip(frames_us, cameras, strict=True)}) < len(frames_us):
        raise InputError(
            f"table {file} has several images of one camera at one {_TIME}",
            remedy="Download it again.",
            code="bad-table",
        )
    units = _units(frames_us, cameras, times_us)
    _require_order(units, sorted(set(frames_us)), file)
    poses_us, world_from_rig = _poses(folder / POSES / file.name, images)
    truth = interpolated_poses(poses_us, world_from_rig, np.array([unit.timestamp_us for unit in units]))
    is_unknown = any(camera.readout_us is None for camera in rig)
    return Recording(
        layout="Waymo, version 2",
        name=f"waymo-{file.stem}",
        cameras=rig,
        units=with_truth(units, truth),
        notes=[
            *(["Shutter: the readout direction of a camera is not known."] if is_unknown else []),
            *notes_of_poses_elsewhere(units, poses_us, truth),
        ],
        contents=lambda wanted: _contents(file, wanted, {camera.name: (camera.width, camera.height) for camera in rig}),
    )


def _camera(number: int, table: Columns, readouts_us: Floats) -> Camera:
    name, source = CAMERAS[number], f"{table.source}: camera {CAMERAS[number]}"
    numbers = table.integers(_CAMERA)
    if numbers.count(number) != 1:
        raise InputError(
            f"{source} has {numbers.count(number)} rows", remedy="Download it again.", code="bad-calibration"
        )
    row = numbers.index(number)
    intrinsics, (width, height) = table.numbers(*_INTRINSICS)[row], table.numbers(*_SIZE)[row]
    lens = lens_from_distortion(intrinsics[:4].tolist(), "plumb_bob", intrinsics[4:].tolist(), where=source)
    camera = checked_camera(
        name,
        model=lens.model,
        size=(int(width), int(height)),
        params=lens.params,
        rig_from_cam=table.matrices(_EXTRINSIC)[row] @ flu_from_body(BodyAxes.RDF),
        source=source,
    )
    return camera.model_copy(update=_readout(table.integers(_DIRECTION)[row], readouts_us, source))


def _readout(direction: int, readouts_us: Floats, source: str) -> dict[str, object]:
    if direction == GLOBAL_SHUTTER:
        return {"readout_us": 0}
    if direction not in DIRECTIONS:
        return {}
    middle = float(np.median(readouts_us))
    if not 0 < middle <= MAX_READOUT_US or np.abs(readouts_us - middle).max() > MAX_SPREAD_US:
        raise InputError(
            f"{source}: images are read out in {readouts_us.min():.0f} to {readouts_us.max():.0f} us",
            remedy="Download the images' table again.",
            code="bad-calibration",
        )
    return {"readout_us": round(middle), "readout_direction": DIRECTIONS[direction]}


def _units(frames_us: list[int], cameras: list[int], times_us: Ints) -> list[SourceUnit]:
    """Units of the frames of the table; a unit's time is the mean of its images' times."""
    by_frame: dict[int, dict[str, SourceImage]] = {}
    for frame, camera, time_us in zip(frames_us, cameras, times_us.tolist(), strict=True):
        key = (CAMERAS[camera], frame)
        by_frame.setdefault(frame, {})[CAMERAS[camera]] = SourceImage(
            file=Path(f"{frame}.jpg"), timestamp_us=time_us, key=key
        )
    return [
        SourceUnit(
            source_frame=number,
            timestamp_us=round(
                sum(image.timestamp_us or 0 for image in by_frame[frame].values()) / len(by_frame[frame])
            ),
            images=by_frame[frame],
        )
        for number, frame in enumerate(sorted(by_frame))
    ]


def _require_order(units: list[SourceUnit], frames_us: list[int], file: Path) -> None:
    """Refuse frames whose images were not taken after those of the frame before."""
    for number, (before, after) in enumerate(pairwise(units), start=1):
        if after.timestamp_us <= before.timestamp_us:
            raise InputError(
                f"table {file}: by {' and '.join(_TRIGGERED)}, images of {_TIME} {frames_us[number]} were not taken "
                f"after those of {frames_us[number - 1]}",
                remedy="Download it again.",
                code="bad-table",
            )


def _poses(file: Path, images: Columns) -> tuple[Ints, Floats]:
    """Times (n,), rising, and poses (n, 4, 4) of the images and, where the table is there, of the frames."""
    times_us = np.round(images.seconds(_POSE_TIME)[:, 0] * 1e6).astype(np.int64)
    poses = images.matrices(_POSE)
    if file.is_file():
        table = read_parquet(file, [_TIME, _VEHICLE_POSE])
        times_us = np.concatenate([times_us, np.array(table.integers(_TIME), dtype=np.int64)])
        poses = np.concatenate([poses, table.matrices(_VEHICLE_POSE)])
    times_us, first = np.unique(times_us, return_index=True)
    return times_us, poses[first]


def _contents(
    file: Path, wanted: Collection[ImageKey], sizes: dict[str, tuple[int, int]]
) -> Iterator[tuple[ImageKey, bytes]]:
    """Files of the wanted images, as the table has them one after the other."""
    missing = set(wanted)
    for batch in parquet_batches(file, [_TIME, _CAMERA, _CONTENT], ROWS):
        rows = zip(batch.integers(_CAMERA), batch.integers(_TIME), batch.contents(_CONTENT), strict=True)
        for camera, frame, content in rows:
            key = (CAMERAS.get(camera, ""), frame)
            if key in missing:
                missing.remove(key)
                _require_size(content, f"{file}: {key[0]}, {frame}", sizes[key[0]])
                yield key, content


def _require_size(content: bytes, name: str, size: tuple[int, int]) -> None:
    try:
        header = header_of(content, name)
    except ImageHeaderError as error:
        raise InputError(error.what, remedy=error.remedy, code=error.code) from None
    if header.format != "JPEG" or (header.width, header.height) != size:
        raise InputError(
            f"image {name} is a {header.format} of {header.width}x{header.height} pixels, the calibration is of "
            f"{size[0]}x{size[1]}",
            remedy="Download the table again.",
            code="bad-image",
        )
