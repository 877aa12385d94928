"""Common result of the importers: a recording in the engine's axes, before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.types import Floats, Ints
from schemas import BodyAxes, Camera, Gnss, GnssSample, LabelMap
from schemas.drive import MAX_RIG_EXTENT_M

# Calibrations made with OpenCV's tools put the origin at the centre of the top left pixel; manifests, as COLMAP, at its
# corner. The principal point moves by this, focal length and distortion are the same in both.
PIXEL_CENTER_PX = 0.5
MAX_SKEW = 1e-4  # of the focal length: it moves no pixel of a usual image by more than a tenth
LAST_ROW_ERROR = 1e-6  # of a 3x3 or 4x4 matrix: those rows are constants, which rounding hardly touches

T = TypeVar("T")

# An image in a file that holds many: of a bag the topic and the stamp.
ImageKey = tuple[str, int]


@dataclass(frozen=True, kw_only=True)
class SourceImage:
    """One image where the recording has it."""

    file: Path  # of an image with a key, only the suffix counts
    timestamp_us: int | None = None  # None: taken with its unit
    mask: Path | None = None
    key: ImageKey | None = None  # of one that `Recording.contents` reads


@dataclass(frozen=True, kw_only=True)
class SourceUnit:
    """All images of one instant."""

    source_frame: int
    timestamp_us: int
    images: dict[str, SourceImage]  # by camera name
    world_from_rig: Floats | None = None  # the truth, where the recording has it
    rough_world_from_rig: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class RoughQuality:
    """Standard deviations of rough poses, along and about each axis."""

    sigma_m: float
    sigma_deg: float


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording with all rotations in the engine's axes: x forward, y left, z up."""

    layout: str
    name: str
    cameras: list[Camera]
    units: list[SourceUnit]  # in order of time
    body_axes: BodyAxes = BodyAxes.FLU  # of files that belong to the recording, as the antenna's position
    default_gnss: Path | None = None
    gnss: Gnss | None = None
    rough_quality: RoughQuality | None = None  # None: the manifest's defaults
    common_world: str | None = None  # of the units' poses, where other recordings have it, too
    truth_is_gnss: bool = False  # the units' poses are of the system that the GNSS is of: truth only where asked for
    label_map: LabelMap | None = None
    notes: list[str] = field(default_factory=list)
    vehicle: str | None = None
    # Names of files that are not read, by the folder of images that they lie in; its last part is the camera's name.
    unread_files: Mapping[str, Sequence[str]] = field(default_factory=dict)
    # Files of images with these keys, in any order, one at a time in memory.
    contents: Callable[[Collection[ImageKey]], Iterator[tuple[ImageKey, bytes]]] | None = None


def choose_scene(scenes: Mapping[str, T], wanted: str | None, folder: Path) -> T:
    """The scene of the wanted name, or the only one.

    Raises
    ------
    InputError
        If there is none at all or none of this name, or none is named and there are several.
    """
    known = ", ".join(sorted(scenes)[:20]) or "none"
    if not scenes:
        raise InputError(f"{folder} holds no scenes", remedy="Unpack the recording again.", code="no-scenes")
    if wanted is None and len(scenes) > 1:
        raise InputError(
            f"{folder} holds {len(scenes)} scenes: {known}",
            remedy="Name one of them with --scene.",
            code="several-scenes",
        )
    name = next(iter(scenes)) if wanted is None else wanted
    if name not in scenes:
        raise InputError(f"{folder} has no scene {name!r}", remedy=f"Name one of: {known}.", code="unknown-scene")
    return scenes[name]


def pinhole_params(k: Floats, *, what: str) -> list[float]:
    """COLMAP's PINHOLE parameters of a calibration matrix (3, 3) that puts the origin at the first pixel's centre.

    Parameters
    ----------
    what
        What it is and where it stands, for messages.

    Raises
    ------
    InputError
        If it is no calibration matrix without skew.
    """
    require_calibration_matrix(k, what=what)
    return [float(v) for v in (k[0, 0], k[1, 1], k[0, 2] + PIXEL_CENTER_PX, k[1, 2] + PIXEL_CENTER_PX)]


def require_calibration_matrix(k: Floats, *, what: str) -> None:
    """Refuse a matrix (3, 3) that is not fx, 0, cx; 0, fy, cy; 0, 0, 1: no camera model here has a skew.

    Raises
    ------
    InputError
        That names the entries at fault. Focal lengths and principal point are the camera's to check.
    """
    rows = "Give it row by row as fx, 0, cx; 0, fy, cy; 0, 0, 1"
    if abs(k[2] - (0, 0, 1)).max() > LAST_ROW_ERROR:
        raise InputError(
            f"{what} is no calibration matrix: the last row is {', '.join(f'{value:g}' for value in k[2])} instead of "
            "0, 0, 1",
            remedy=f"{rows}: is it transposed, or times a factor?",
            code="bad-calibration",
        )
    if max(abs(k[0, 1]), abs(k[1, 0])) > MAX_SKEW * abs(k[0, 0]):
        raise InputError(
            f"{what} is no calibration matrix without skew: beside its focal lengths are {k[0, 1]:g} and {k[1, 0]:g}",
            remedy=f"{rows}, of images that are rectified or a lens model without skew.",
            code="bad-calibration",
        )


def pose_of_projection(projection: Floats, *, what: str) -> Floats:
    """The `cam_from_reference` (4, 4) of a rectified camera's projection (3, 4) of its reference camera's coordinates.

    Raises
    ------
    InputError
        If it does not begin with a calibration matrix.
    """
    require_calibration_matrix(projection[:, :3], what=what)
    if projection[0, 0] * projection[1, 1] == 0.0:
        raise InputError(
            f"{what} has a focal length of 0", remedy="Give the calibration's own file.", code="bad-calibration"
        )
    return se3.transform(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]))


def interpolated_poses(times_us: Ints, world_from_any: Floats, at_us: Ints) -> list[Floats | None]:
    """Poses (4, 4) at the given times between rising ones, None beyond their first and last.

    Parameters
    ----------
    times_us
        Rising times (n,) of the poses (n, 4, 4), n >= 1.
    """
    poses = se3.interpolate(times_us, world_from_any, at_us)
    known = (at_us >= times_us[0]) & (at_us <= times_us[-1])
    return [pose if there else None for pose, there in zip(poses, known, strict=True)]


def notes_of_poses_elsewhere(units: Sequence[SourceUnit], times_us: Ints, poses: Sequence[Floats | None]) -> list[str]:
    """A note that no unit is within the times (n,), rising, of the recording's poses; none where one is.

    Parameters
    ----------
    poses
        Of the units, interpolated.
    """
    if not units or any(pose is not None for pose in poses):
        return []
    own = f"{times_us[0] / 1e6:.3f} to {times_us[-1] / 1e6:.3f} s"
    of_images = f"{units[0].timestamp_us / 1e6:.3f} to {units[-1].timestamp_us / 1e6:.3f} s"
    return [f"Poses: those of the recording are of {own} and its images of {of_images}, so that there is no truth."]


def with_truth(units: Sequence[SourceUnit], poses: Sequence[Floats | None]) -> list[SourceUnit]:
    """The units with true poses (4, 4), where there are any."""
    return [replace(unit, world_from_rig=pose) for unit, pose in zip(units, poses, strict=True)]


def gnss_of_vehicle(
    times_us: Ints, geodetic: Floats, sigma_horizontal_m: Floats, sigma_vertical_m: Floats, *, source: str
) -> Gnss:
    """Positions of the vehicle's origin as samples of a receiver whose antenna is there.

    Parameters
    ----------
    geodetic
        Latitude and longitude in degrees and height in metres (n, 3).
    source
        What messages call their file.

    Raises
    ------
    InputError
        If a value is out of its bounds.
    """
    columns = np.column_stack([geodetic, sigma_horizontal_m, sigma_vertical_m]).tolist()
    names = ("latitude_deg", "longitude_deg", "height_m", "sigma_horizontal_m", "sigma_vertical_m")
    samples = []
    for number, (time_us, row) in enumerate(zip(times_us.tolist(), columns, strict=True)):
        try:
            samples.append(GnssSample(timestamp_us=time_us, **dict(zip(names, row, strict=True))))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise InputError(
                f"{source}, sample {number}: {first['loc'][0]} {first['input']}: {first['msg']}",
                remedy="Correct it at its source.",
                code="bad-gnss-file",
            ) from None
    return Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[0.0, 0.0, 0.0], samples=samples)


def antenna_on_vehicle(antenna_m: Sequence[float]) -> list[float]:
    """The antenna's position (3,) in the rig frame as a manifest may have it.

    Raises
    ------
    InputError
        If it is not on the vehicle.
    """
    antenna = [float(value) for value in antenna_m]
    if not all(abs(value) <= MAX_RIG_EXTENT_M for value in antenna):  # also refuses NaN
        raise InputError(
            f"the antenna is at {antenna} m in the rig frame, over {MAX_RIG_EXTENT_M:g} m away",
            remedy="Give metres with --antenna.",
            code="bad-antenna",
        )
    return antenna


def parse_slice(text: str) -> slice:
    """A Python slice from START:STOP:STEP, of which every part may be empty and the first two negative.

    Raises
    ------
    InputError
        If the text is no slice or its step is not positive.
    """
    remedy = "Give START:STOP or START:STOP:STEP as in Python, such as 0:35:2 or :100; STOP is not included."
    parts = text.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if not 2 <= len(numbers) <= 3:
        raise InputError(f"--frames {text!r} is not a slice", remedy=remedy, code="bad-slice")
    if len(numbers) == 3 and numbers[2] is not None and numbers[2] <= 0:
        raise InputError(f"--frames {text!r} has a step of {numbers[2]}: drives run forward", remedy=remedy)
    return slice(*numbers)


def select_units(recording: Recording, frames: str | None) -> Recording:
    """The recording with only the units that the slice `frames` selects, which keep their numbers and times.

    Raises
    ------
    InputError
        If the slice is malformed or selects nothing.
    """
    if frames is None:
        return recording
    units = recording.units[parse_slice(frames)]
    if not units:
        raise InputError(
            f"--frames {frames!r} selects none of the {len(recording.units)} frames",
            remedy=f"Select among 0:{len(recording.units)}.",
            code="empty-selection",
        )
    return replace(recording, units=units)


def select_cameras(recording: Recording, names: Sequence[str] | None) -> Recording:
    """The recording with only the named cameras, in its own order.

    Raises
    ------
    InputError
        If no camera is named, it has no camera of such a name, or no image of those that are named.
    """
    if names is None:
        return recording
    known = [camera.name for camera in recording.cameras]
    if not names:
        raise InputError(
            "--cameras names no camera",
            remedy=f"Choose among {', '.join(known)}, or leave --cameras out for all.",
            code="empty-selection",
        )
    if unknown := [name for name in names if name not in known]:
        raise InputError(
            f"the recording has no camera {', '.join(unknown)}",
            remedy=f"Choose among {', '.join(known)}.",
            code="unknown-camera",
        )
    units = [
        replace(unit, images={name: image for name, image in unit.images.items() if name in names})
        for unit in recording.units
    ]
    if not any(unit.images for unit in units):
        raise InputError(
            f"the recording has no images of --cameras {','.join(names)}",
            remedy=f"Choose among {', '.join(known)}.",
            code="empty-selection",
        )
    return replace(
        recording,
        cameras=[camera for camera in recording.cameras if camera.name in names],
        unread_files={at: files for at, files in recording.unread_files.items() if PurePath(at).name in names},
        units=[unit for unit in units if unit.images],
    )


def flu_world(world_from_rig: Floats) -> Floats | None:
    """The rotation (4, 4) that turns the world of vehicle poses so that its z axis points up.

    Datasets give poses in a world with z up, with z down, or (KITTI) in the axes of the first camera, y down. Which of
    these holds shows in where the vehicle's own z axis points on average.

    Parameters
    ----------
    world_from_rig
        Poses (n, 4, 4) of a rig with z up.

    Returns
    -------
    NDArray or None
        `upright_from_world`, or None if no axis of the world is within 30 degrees of the vehicle's up.
    """
    up = np.asarray(world_from_rig)[:, :3, 2].mean(0)
    norm = float(np.linalg.norm(up))
    if norm < 0.5:
        return None
    for axes in (BodyAxes.FLU, BodyAxes.RDF, BodyAxes.FRD):
        rotation = flu_from_body(axes)
        if (rotation[:3, :3] @ up)[2] / norm > np.cos(np.radians(30)):
            return rotation
    return None


def proper_transform(matrix: Floats, *, what: str) -> Floats:
    """A rigid transform (4, 4) from a matrix whose rotation is one up to rounding.

    Parameters
    ----------
    matrix
        (3, 4) or (4, 4).
    what
        What it is and where it stands, for messages.

    Raises
    ------
    InputError
        If it is not finite, a fourth row is not 0, 0, 0, 1, or its rotation is not orthonormal within 1e-3 or mirrors.
    """
    remedy = "Give a rotation matrix and a translation in metres."
    r = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise InputError(f"{what} holds a value that is not finite", remedy=remedy, code="bad-transform")
    # The rotation of a transposed matrix is a rotation too, and the translation of one is zero: this row alone tells.
    if len(matrix) == 4 and abs(matrix[3] - (0, 0, 0, 1)).max() > LAST_ROW_ERROR:
        raise InputError(
            f"{what}: the fourth row is {', '.join(f'{value:g}' for value in matrix[3])} instead of 0, 0, 0, 1",
            remedy="Is the matrix transposed? Give it row by row: the translation is its fourth column, in metres.",
            code="bad-transform",
        )
    if abs(r @ r.T - np.eye(3)).max() > 1e-3:
        raise InputError(f"{what} is not a rigid transform: its rotation is not orthonormal", remedy=remedy)
    if np.linalg.det(r) < 0:
        raise InputError(f"{what} mirrors: its rotation has determinant -1", remedy=remedy, code="bad-transform")
    return se3.transform(se3.rotation_from_quaternion(se3.quaternion_from_rotation(r)), matrix[:3, 3])
