"""COLMAP's own reading of whole models.

COLMAP lets no other thread of the interpreter run meanwhile, for seconds where a drive is long: pictures that are drawn
beside it wait, and nobody can cancel. Large models have a process of their own for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.subprocess_run import run_in_subprocess
from mrasfm_engine.types import Floats, StageProgress

BINARY_FILES = ("cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin")
# COLMAP reads and writes as much in the time that a process takes to start.
SMALL_BYTES = 16_000_000

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class CameraRead:
    """A camera as COLMAP has read it."""

    model: str
    size_px: tuple[int, int]
    params: Floats


@dataclass(frozen=True, kw_only=True)
class RigRead:
    """A rig as COLMAP has read it; its cameras' poses (3, 4) by the cameras' ids."""

    sensors: int
    reference_is_imu: bool
    cam_from_rig: Mapping[int, Floats]


@dataclass(frozen=True, kw_only=True)
class ImageRead:
    """An image as COLMAP has read it, with the pose (3, 4) that its frame and its rig compose to; None without one."""

    name: str
    camera_id: int
    frame_id: int
    keypoints: int
    observations: int
    cam_from_world: Floats | None


@dataclass(frozen=True, kw_only=True)
class ModelRead:
    """A model as COLMAP has read it: rigs, cameras and images by id, and points (p, 3) by rising id."""

    rigs: Mapping[int, RigRead]
    cameras: Mapping[int, CameraRead]
    images: Mapping[int, ImageRead]
    points: Floats
    observations: int
    is_valid: bool


def read_binary(folder: Path) -> ModelRead:
    """A binary model as COLMAP reads it."""
    return by_itself(_read_binary, folder)


def binary_model(folder: Path) -> pycolmap.Reconstruction:
    """COLMAP's own object of a binary model."""
    model = pycolmap.Reconstruction()
    model.read_binary(str(folder))
    return model


def by_itself(work: Callable[..., Result], folder: Path, *arguments: Any) -> Result:
    """The result of some work on a binary model, the folder of which it gets first; a large one's in its own process.

    Raises
    ------
    Exception
        What the work raised, wherever it ran.
    MrasfmError
        Where the process ended early.
    """
    sizes = {name: (folder / name).stat().st_size for name in BINARY_FILES}
    for name, size in sizes.items():
        if not size:  # without its file of rigs, COLMAP makes some up
            raise ValueError(f"{name} is empty")
    if sum(sizes.values()) < SMALL_BYTES:
        return work(folder, *arguments)
    ended = run_in_subprocess(_result_or_error, work, (folder, *arguments))
    if ended.result is None:
        raise MrasfmError(
            f"the process in which COLMAP reads or writes the model: {ended.failure}",
            remedy="Free memory: COLMAP holds the model once more. Run it again: finished stages are reused.",
            code="colmap-process",
        )
    result: Result | Exception = ended.result
    if isinstance(result, Exception):
        raise result
    return result


def _result_or_error(
    progress: StageProgress, work: Callable[..., Result], arguments: Sequence[Any]
) -> Result | Exception:
    try:
        return work(*arguments)
    except Exception as error:  # the process would print it, and pass nothing on
        return error


def _read_binary(folder: Path) -> ModelRead:
    return read_of(binary_model(folder))


def read_of(model: pycolmap.Reconstruction) -> ModelRead:
    """The content of COLMAP's object."""
    coordinates = (point.xyz for point in model.points3D.values())
    points: Floats = np.fromiter(coordinates, dtype=np.dtype((np.float64, 3)), count=len(model.points3D))
    posed = set(model.reg_image_ids())
    return ModelRead(
        rigs={number: _rig(rig) for number, rig in model.rigs.items()},
        cameras={number: _camera(camera) for number, camera in model.cameras.items()},
        images={number: _image(image, number in posed) for number, image in model.images.items()},
        points=points[np.argsort(list(model.points3D))],
        observations=model.compute_num_observations(),
        is_valid=model.is_valid(),
    )


def _camera(camera: pycolmap.Camera) -> CameraRead:
    params = np.array(camera.params)  # a view would keep the whole model
    return CameraRead(model=camera.model.name, size_px=(camera.width, camera.height), params=params)


def _rig(rig: pycolmap.Rig) -> RigRead:
    return RigRead(
        sensors=rig.num_sensors(),
        reference_is_imu=rig.ref_sensor_id.type == pycolmap.SensorType.IMU,
        cam_from_rig={
            sensor.id: rig.sensor_from_rig(sensor).matrix()
            for sensor in rig.non_ref_sensors
            if sensor.type == pycolmap.SensorType.CAMERA
        },
    )


def _image(image: pycolmap.Image, has_pose: bool) -> ImageRead:
    return ImageRead(
        name=image.name,
        camera_id=image.camera_id,
        frame_id=image.frame_id,
        keypoints=image.num_points2D(),
        observations=image.num_points3D,
        cam_from_world=image.cam_from_world().matrix() if has_pose else None,
    )
