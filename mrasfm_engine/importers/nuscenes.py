"""Imports one scene of nuScenes: the keyframes of its cameras, at 2 Hz, or all their images, at 12 Hz.

Source: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020, and the schema of its
development kit. The rig frame is the dataset's ego frame: x forward, y left, z up, origin below the rear axle's middle.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, RootModel

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.frame_grouping import units_by_time
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    SourceUnit,
    choose_scene,
    interpolated_poses,
    pinhole_params,
    with_truth,
)
from mrasfm_engine.importers.rig_folder import checked_camera
from mrasfm_engine.io.documents import read_document
from mrasfm_engine.types import Floats
from schemas import Camera
from schemas.drive import LAST_TIMESTAMP_US, MAX_VEHICLE_CHARACTERS, Finite, RelativePath, Vector3

DESCRIPTION = "v1.0-*/scene.json (nuScenes)"
OPTIONS = ("scene", "sweeps")
LIDAR = "LIDAR_TOP"
FLAT_NOTE = "The truth is nuScenes' ego poses: they are plane (z = 0) and good to about 0.1 m; compare x and y apart."
FLAT_M = 1e-6  # other data sets come in these tables, too, with heights
SHUTTER_NOTE = "Shutter: the tables do not say whether a camera reads its rows one after the other."
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_.:-]+")
MAX_TABLE_BYTES = 4_000_000_000  # sample_data.json of the full set has over 1 GB


_Timestamp = Annotated[int, Field(ge=0, le=LAST_TIMESTAMP_US)]


class _Row(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, frozen=True)

    token: str


class _Scene(_Row):
    name: str
    first_sample_token: str
    log_token: str | None = None


class _Log(_Row):
    vehicle: Any = None
    location: Any = None


class _Sample(_Row):
    timestamp: _Timestamp
    next: str
    scene_token: str


class _Sensor(_Row):
    channel: str
    modality: str


def _of_norm_1(wxyz: list[float]) -> list[float]:
    if abs(float(np.linalg.norm(wxyz)) - 1.0) > 1e-3:
        raise ValueError("is no unit quaternion")
    return wxyz


_Quaternion = Annotated[list[Finite], Field(min_length=4, max_length=4), AfterValidator(_of_norm_1)]  # w, x, y, z


class _Posed(_Row):
    rotation: _Quaternion
    translation: Vector3

    def matrix(self) -> Floats:
        w, x, y, z = self.rotation
        return se3.transform(se3.rotation_from_quaternion([x, y, z, w]), self.translation)


def _no_intrinsics(value: Any) -> Any:
    return value or None  # [] for sensors that are not cameras


class _Calibrated(_Posed):
    sensor_token: str
    camera_intrinsic: Annotated[list[list[Finite]] | None, BeforeValidator(_no_intrinsics)] = None


class _SampleData(_Row):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: _Timestamp
    is_key_frame: bool
    filename: RelativePath
    width: int | None = None
    height: int | None = None


Row = TypeVar("Row", bound=_Row)


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout."""
    return bool(_versions(folder))


def _versions(folder: Path) -> list[Path]:
    candidates = [folder] if folder.name.startswith("v1.0-") else sorted(folder.glob("v1.0-*"))
    return [path for path in candidates if (path / "scene.json").is_file()]


def read(folder: Path, scene: str | None = None, *, sweeps: bool = False) -> Recording:
    """Read one scene; images are not opened.

    Parameters
    ----------
    scene
        Its name, as `scene-0061`; may be left out if there is only one.
    sweeps
        Whether the images between the keyframes are wanted, too.

    Raises
    ------
    InputError
        If the scene is not there, or a table is missing or malformed.
    """
    tables = _tables(folder)
    data = tables.resolve().parent
    chosen = choose_scene({s.name: s for s in _table(tables, "scene", _Scene)}, scene, tables)
    samples = _samples_of(chosen, _by_token(_table(tables, "sample", _Sample)), tables)
    sensors = _by_token(_table(tables, "sensor", _Sensor))
    calibrated = _by_token(_table(tables, "calibrated_sensor", _Calibrated))
    wanted = {sample.token for sample in samples}
    taken = [
        d for d in _table(tables, "sample_data", _SampleData) if (d.is_key_frame or sweeps) and d.sample_token in wanted
    ]
    channels = {d.token: _channel(d, calibrated, sensors, tables) for d in taken}
    needed = {d.ego_pose_token for d in taken}
    ego = {pose.token: pose for pose in _table(tables, "ego_pose", _Posed) if pose.token in needed}
    cameras = _cameras(taken, channels, calibrated, tables)
    names = {camera.name for camera in cameras}
    if sweeps:
        units = _units_of_sweeps([d for d in taken if channels[d.token].channel in names], channels, ego, data)
    else:
        by_sample: dict[str, dict[str, _SampleData]] = {sample.token: {} for sample in samples}
        for d in taken:
            by_sample[d.sample_token][channels[d.token].channel] = d
        units = [_unit(i, sample, by_sample[sample.token], names, ego, data) for i, sample in enumerate(samples)]
    log = _log(chosen, tables)
    city = _name(log.location if log else None)
    return Recording(
        layout="nuScenes",
        name=f"nuscenes-{chosen.name}",
        cameras=cameras,
        units=units,
        notes=[*([FLAT_NOTE] if _is_flat(ego) else []), SHUTTER_NOTE],
        vehicle=_name(log.vehicle if log else None),
        common_world=None if city is None else f"nuscenes-{city}",
    )


def _is_flat(ego: Mapping[str, _Posed]) -> bool:
    """Return whether there are ego poses, and all of them are in a plane."""
    return bool(ego) and all(abs(pose.translation[2]) < FLAT_M for pose in ego.values())


def _log(scene: _Scene, tables: Path) -> _Log | None:
    """The log that the scene is of, where the tables have it."""
    if scene.log_token is None or not (tables / "log.json").is_file():
        return None
    return _by_token(_table(tables, "log", _Log)).get(scene.log_token)


def _name(given: Any) -> str | None:
    """A name from a log as a manifest may have it."""
    found = _NOT_IN_A_NAME.sub("-", given if isinstance(given, str) else "").lstrip("_.:-")[:MAX_VEHICLE_CHARACTERS]
    return found or None


def _units_of_sweeps(
    taken: list[_SampleData], channels: dict[str, _Sensor], ego: dict[str, _Posed], data: Path
) -> list[SourceUnit]:
    """All images, put together by their times; a unit's pose is interpolated between those of its and other images."""
    by_camera: dict[str, dict[int, _SampleData]] = {}
    for d in taken:
        by_camera.setdefault(channels[d.token].channel, {})[d.timestamp] = d
    units = units_by_time(
        {
            name: [SourceImage(file=data / rows[t].filename, timestamp_us=t) for t in sorted(rows)]
            for name, rows in by_camera.items()
        }
    )
    posed = {d.timestamp: ego[d.ego_pose_token].matrix() for d in taken if d.ego_pose_token in ego}
    if not posed:
        return units
    times_us = np.array(sorted(posed), dtype=np.int64)
    poses = np.stack([posed[int(t)] for t in times_us])
    return with_truth(units, interpolated_poses(times_us, poses, np.array([unit.timestamp_us for unit in units])))


def scene_names(folder: Path) -> list[str]:
    """Names of all scenes, in the order of the table.

    Raises
    ------
    InputError
        If the folder is not nuScenes', or its table of scenes is malformed.
    """
    return [scene.name for scene in _table(_tables(folder), "scene", _Scene)]


def _tables(folder: Path) -> Path:
    versions = _versions(folder)
    if not versions:
        raise InputError(
            f"{folder} has no table v1.0-*/scene.json", remedy="Give the folder of nuScenes.", code="unknown-layout"
        )
    if len(versions) > 1:
        raise InputError(
            f"{folder} holds several versions: {', '.join(v.name for v in versions)}",
            remedy="Give the folder of one of them.",
            code="several-versions",
        )
    return versions[0]


def _table(folder: Path, name: str, row: type[Row]) -> list[Row]:
    file = folder / f"{name}.json"
    rows: RootModel[list[Row]] = read_document(
        file, RootModel[list[row]], what="nuScenes table", strict=False, max_bytes=MAX_TABLE_BYTES  # type: ignore[valid-type]
    )  # fmt: skip
    return rows.root


def _by_token(rows: Iterable[Row]) -> dict[str, Row]:
    return {row.token: row for row in rows}


def _missing(kind: str, token: str, tables: Path) -> InputError:
    return InputError(
        f"nuScenes tables {tables} refer to {kind} {token!r}, which is not there",
        remedy="Unpack the tables again.",
        code="broken-tables",
    )


def _samples_of(scene: _Scene, samples: dict[str, _Sample], tables: Path) -> list[_Sample]:
    chain: list[_Sample] = []
    token = scene.first_sample_token
    while token:
        if token not in samples:
            raise _missing("sample", token, tables)
        if len(chain) == len(samples):
            raise InputError(
                f"nuScenes tables {tables}: samples after {scene.first_sample_token!r} lead in a circle",
                remedy="Unpack the tables again.",
                code="broken-tables",
            )
        chain.append(samples[token])
        token = chain[-1].next
    return chain


def _channel(
    data: _SampleData, calibrated: dict[str, _Calibrated], sensors: dict[str, _Sensor], tables: Path
) -> _Sensor:
    if data.calibrated_sensor_token not in calibrated:
        raise _missing("calibrated_sensor", data.calibrated_sensor_token, tables)
    token = calibrated[data.calibrated_sensor_token].sensor_token
    if token not in sensors:
        raise _missing("sensor", token, tables)
    return sensors[token]


def _cameras(
    keyframes: list[_SampleData], channels: dict[str, _Sensor], calibrated: dict[str, _Calibrated], tables: Path
) -> list[Camera]:
    first: dict[str, _SampleData] = {}
    for d in keyframes:
        sensor = channels[d.token]
        if sensor.modality == "camera":
            earlier = first.setdefault(sensor.channel, d)
            if earlier.calibrated_sensor_token != d.calibrated_sensor_token:
                raise InputError(
                    f"nuScenes tables {tables}: camera {sensor.channel} has two calibrations in one scene",
                    remedy="Import a scene of one calibration.",
                    code="broken-tables",
                )
    if not first:
        raise InputError(f"nuScenes tables {tables}: the scene has no camera keyframes", remedy="Unpack them again.")
    return [
        _camera(name, first[name], calibrated[first[name].calibrated_sensor_token], tables) for name in sorted(first)
    ]


def _camera(name: str, data: _SampleData, calibration: _Calibrated, tables: Path) -> Camera:
    source = f"nuScenes tables {tables}: calibrated_sensor {calibration.token} ({name})"
    rows = calibration.camera_intrinsic or []
    if [len(row) for row in rows] != [3, 3, 3] or not data.width or not data.height:
        raise InputError(f"{source} has no 3x3 camera_intrinsic or image size", remedy="Unpack the tables again.")
    return checked_camera(
        name,
        model="PINHOLE",
        size=(data.width, data.height),
        params=pinhole_params(np.array(rows, dtype=np.float64), what=f"{source}: camera_intrinsic"),
        rig_from_cam=calibration.matrix(),
        source=source,
    )


def _unit(
    number: int,
    sample: _Sample,
    channels: dict[str, _SampleData],
    cameras: set[str],
    ego: dict[str, _Posed],
    data: Path,
) -> SourceUnit:
    """The unit at its laser scanner's time, whose ego pose belongs to it; without one, at its cameras' mean."""
    images = {name: d for name, d in channels.items() if name in cameras}
    poses = [(d.timestamp, ego[d.ego_pose_token].matrix()) for d in images.values() if d.ego_pose_token in ego]
    lidar = channels.get(LIDAR)
    if lidar is not None and lidar.ego_pose_token in ego:
        timestamp_us, world_from_rig = lidar.timestamp, ego[lidar.ego_pose_token].matrix()
    elif poses:
        timestamp_us = round(sum(t for t, _ in poses) / len(poses))
        mean = se3.mean_rotation(np.stack([m[:3, :3] for _, m in poses]))
        world_from_rig = se3.transform(mean, np.mean([m[:3, 3] for _, m in poses], axis=0))
    else:
        timestamp_us, world_from_rig = sample.timestamp, None
    return SourceUnit(
        source_frame=number,
        timestamp_us=timestamp_us,
        images={name: SourceImage(file=data / d.filename, timestamp_us=d.timestamp) for name, d in images.items()},
        world_from_rig=world_from_rig,
    )
