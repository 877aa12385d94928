"""Imports a folder with `rig.json`, a folder of numbered images per camera, and tables of poses and times."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    SourceUnit,
    flu_world,
    pinhole_params,
    proper_transform,
)
from mrasfm_engine.importers.skipped_images import is_image, notes_of_masks_without_a_frame, unread_files
from mrasfm_engine.importers.tables import read_poses, read_times
from mrasfm_engine.importers.unknown_fields import notes_of_unknown_fields
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.io.documents import read_document
from mrasfm_engine.io.image_header import read_header
from mrasfm_engine.scene.drive import pose_from_matrix
from mrasfm_engine.types import Floats
from schemas import BodyAxes, Camera, LabelMap
from schemas.drive import MAX_CAMERAS, Finite, Name, Vehicle

DESCRIPTION = "rig.json and a folder of numbered images for every camera"
OPTIONS: tuple[str, ...] = ()
DEFAULT_FRAME_INTERVAL_US = 100_000  # where times.txt is missing

_Row3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]


# Fields of a manifest's camera that a `rig.json` has in the same form: they become the manifest's.
MANIFEST_FIELDS = frozenset(name for name in Camera.model_fields if name.startswith(("sigma_", "readout_")))


class _RigCamera(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    model: str = "PINHOLE"
    width: int
    height: int
    K: Annotated[list[_Row3], Field(min_length=3, max_length=3)] | None = None
    params: list[Finite] | None = None
    T_body_cam: Annotated[list[_Row4], Field(min_length=3, max_length=4)]

    @model_validator(mode="after")
    def _one_way(self) -> _RigCamera:
        if self.params is None and (self.K is None or self.model != "PINHOLE"):
            raise ValueError(f"camera model {self.model} needs 'params' (PINHOLE: 'K' or 'params')")
        if self.params is not None and self.K is not None:
            raise ValueError("give 'K' or 'params', not both")
        return self

    @property
    def declared(self) -> dict[str, Any]:
        """Fields of the manifest's camera; the manifest checks their values."""
        given = self.model_extra or {}
        return {name: value for name, value in given.items() if name in MANIFEST_FIELDS and value is not None}


class RigFile(BaseModel):
    """A `rig.json`."""

    model_config = ConfigDict(extra="allow")

    body_axes: BodyAxes
    vehicle: Vehicle | None = None
    cameras: Annotated[dict[Name, _RigCamera], Field(min_length=1, max_length=MAX_CAMERAS)]

    def notes(self, file: Path) -> list[str]:
        """Notes on fields that are not read."""
        of_cameras = {name for camera in self.cameras.values() for name in camera.model_extra or ()}
        known = {*_RigCamera.model_fields, *MANIFEST_FIELDS}
        return [
            *notes_of_unknown_fields(file.name, self.model_extra or (), known=RigFile.model_fields),
            *notes_of_unknown_fields(f"{file.name}: cameras", sorted(of_cameras - known), known=known),
        ]


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout."""
    return (folder / "rig.json").is_file()


def read(folder: Path) -> Recording:
    """Read the recording; images are not opened.

    Raises
    ------
    InputError
        If a file is missing or malformed.
    """
    cameras, rig = read_rig(folder / "rig.json")
    flu_body = flu_from_body(rig.body_axes)
    images = {name: numbered_images(folder / name) for name in rig.cameras}
    masks = {name: _masks(folder / "semantics" / name) for name in rig.cameras}
    frames = sorted({frame for files in images.values() for frame in files})
    if not frames:
        raise InputError(
            f"recording {folder} has no images in {', '.join(rig.cameras)}",
            remedy="Give a folder of images named by frame number, as 000000.png, for every camera of rig.json.",
            code="no-images",
        )
    times_us = frame_times(folder, frames)
    truth = read_upright_poses(folder / "poses.txt", frames, flu_body, required_up=False)
    rough = read_upright_poses(folder / "rough_poses.txt", frames, flu_body, required_up=True)
    units = [
        SourceUnit(
            source_frame=frame,
            timestamp_us=times_us[i],
            images={
                name: SourceImage(file=files[frame], mask=masks[name].get(frame))
                for name, files in images.items()
                if frame in files
            },
            world_from_rig=None if truth is None else truth[i],
            rough_world_from_rig=None if rough is None else rough[i],
        )
        for i, frame in enumerate(frames)
    ]
    gnss = folder / "gnss.csv"
    return Recording(
        layout="rig folder",
        name=folder.resolve().name,
        cameras=cameras,
        units=units,
        body_axes=rig.body_axes,
        vehicle=rig.vehicle,
        default_gnss=gnss if gnss.exists() else None,
        label_map=LabelMap.cityscapes() if any(masks.values()) else None,
        notes=[
            *rig.notes(folder / "rig.json"),
            *notes_of_masks_without_a_frame({name: sorted(own.keys() - {*frames}) for name, own in masks.items()}),
        ],
        unread_files={at: unread_files(folder / at) for name in rig.cameras for at in (name, f"semantics/{name}")},
    )


def read_rig(file: Path) -> tuple[list[Camera], RigFile]:
    """Cameras of a `rig.json`, on a rig with x forward, y left and z up, and the file's content.

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    rig = read_document(file, RigFile, what="calibration")
    flu_body = flu_from_body(rig.body_axes)
    return [_camera(name, camera, flu_body, file) for name, camera in rig.cameras.items()], rig


def _camera(name: str, camera: _RigCamera, flu_body: Floats, rig_file: Path) -> Camera:
    source = f"{rig_file}: cameras.{name}"
    given = camera.params
    if given is None:  # those that are given are COLMAP's, in COLMAP's convention
        given = pinhole_params(np.array(camera.K), what=f"{source}.K")
    body_cam = proper_transform(np.array(camera.T_body_cam), what=f"{source}.T_body_cam")
    return checked_camera(
        name,
        model=camera.model,
        size=(camera.width, camera.height),
        params=given,
        rig_from_cam=flu_body @ body_cam,
        source=source,
        declared=camera.declared,
    )


def checked_camera(
    name: str,
    *,
    model: str,
    size: tuple[int, int],
    params: list[float],
    rig_from_cam: Floats,
    source: str,
    declared: Mapping[str, Any] | None = None,
) -> Camera:
    """A manifest's camera, whose errors name where the calibration comes from.

    Parameters
    ----------
    size
        Width and height in pixels.
    params
        In COLMAP's order and convention.
    declared
        Further fields of the camera, such as standard deviations.

    Raises
    ------
    InputError
        If the calibration is not plausible.
    """
    try:
        return Camera(
            name=name,
            model=model,
            width=size[0],
            height=size[1],
            params=params,
            rig_from_cam=pose_from_matrix(rig_from_cam),
            **(declared or {}),
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        what = str(first["msg"]).removeprefix("Value error, ")
        raise InputError(
            f"{source}: {field}: {what}", remedy="Correct the calibration.", code="bad-calibration"
        ) from None


def pinhole_camera(name: str, images: dict[int, Path], k: Floats, rig_from_cam: Floats, *, source: str) -> Camera:
    """A manifest's camera of rectified images with a calibration matrix (3, 3), of the first image's size.

    Raises
    ------
    InputError
        If the calibration is not plausible, or the first image cannot be read.
    """
    header = read_header(images[min(images)])
    return checked_camera(
        name,
        model="PINHOLE",
        size=(header.width, header.height),
        params=pinhole_params(k, what=source),
        rig_from_cam=rig_from_cam,
        source=source,
    )


def numbered_images(folder: Path, *, digits: int = 12, named_by: str = "frame number") -> dict[int, Path]:
    """Images of a folder by the number that is their name.

    Parameters
    ----------
    digits
        Of the longest number.
    named_by
        What the number is.

    Raises
    ------
    InputError
        If the folder is missing, or an image in it is not named by a number, or two have the same.
    """
    if not folder.is_dir():
        raise InputError(f"camera folder {folder} does not exist", remedy="Give every camera's images, or take the "
                         "camera out of the calibration.", code="missing-folder")  # fmt: skip
    found: dict[int, Path] = {}
    for file in sorted(folder.iterdir()):
        if not is_image(file):
            continue
        if not re.fullmatch(rf"[0-9]{{1,{digits}}}", file.stem):
            raise InputError(
                f"image {file} is not named by its {named_by}",
                remedy="Name images by digits alone, as 000000.png, or take this one out of the folder.",
                code="bad-name",
            )
        frame = int(file.stem)
        if frame in found:
            raise InputError(
                f"images {found[frame]} and {file} are both of frame {frame}",
                remedy="Keep one of them.",
                code="bad-name",
            )
        found[frame] = file
    return found


def _masks(folder: Path) -> dict[int, Path]:
    return numbered_images(folder) if folder.is_dir() else {}


def frame_times(folder: Path, frames: list[int]) -> list[int]:
    """Microseconds of the frames from `times.txt`, or 10 Hz from frame 0 on where there is none."""
    if (folder / "times.txt").exists():
        return read_times(folder / "times.txt", frames=frames)
    return [frame * DEFAULT_FRAME_INTERVAL_US for frame in frames]


def read_upright_poses(path: Path, frames: list[int], flu_body: Floats, *, required_up: bool) -> Floats | None:
    """`world_from_rig` (frames, 4, 4) in a world with z up, from `world_from_body`; None if the file is missing.

    Raises
    ------
    InputError
        If the file is malformed, or with `required_up`, if no axis of its world points up.
    """
    if not path.exists():
        return None
    world_from_rig: Floats = read_poses(path, what="poses", frames=frames) @ flu_body.T
    upright = flu_world(world_from_rig)
    if upright is None:
        if required_up:
            raise InputError(
                f"poses {path}: no axis of their world points up along the vehicle's",
                remedy="Give poses in a gravity aligned world, and the right body_axes in the calibration.",
                code="world-not-upright",
            )
        return world_from_rig
    result: Floats = upright @ world_from_rig
    return result
