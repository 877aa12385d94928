"""Imports images of COLMAP's rig configuration (`rig_config.json`), with positions of EXIF or of OpenDroneMap.

Source: COLMAP's documentation of rigs: images of one frame have one name after their camera's `image_prefix`;
`cam_from_rig_rotation` is a quaternion w, x, y, z; the reference camera's frame is the rig's. Parameters are COLMAP's.
COLMAP knows no vehicle and no times.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, RootModel

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.geotags import GeoTag, read_exif, read_geo_txt
from mrasfm_engine.importers.recording import (
    Recording,
    SourceImage,
    SourceUnit,
    antenna_on_vehicle,
    choose_scene,
    gnss_of_vehicle,
)
from mrasfm_engine.importers.rig_folder import checked_camera
from mrasfm_engine.importers.skipped_images import is_image, notes_of_images_without_a_camera
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.io.documents import read_document
from mrasfm_engine.io.image_header import read_header
from mrasfm_engine.types import Floats
from schemas import BodyAxes, Camera, Gnss
from schemas.drive import MAX_CAMERAS, MAX_FRAMES, Finite, Vector3
from schemas.file_names import is_ignored

DESCRIPTION = "rig_config.json (COLMAP)"
SIGMA_ANTENNA_M = 1.0  # of an antenna of which nothing is said: it stands somewhere on the vehicle
OPTIONS = ("scene", "forward_camera", "rate_hz", "antenna_m", "gnss_sigma_m")
CONFIG, POSITIONS = "rig_config.json", "geo.txt"
VERTICAL_OVER_HORIZONTAL = 2.0  # where only one standard deviation is known
_Quaternion = Annotated[list[Finite], Field(min_length=4, max_length=4)]  # w, x, y, z


class _Camera(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    image_prefix: Annotated[str, Field(min_length=1, max_length=300)]
    ref_sensor: bool = False
    cam_from_rig_rotation: _Quaternion | None = None
    cam_from_rig_translation: Vector3 | None = None
    camera_model_name: str | None = None
    camera_params: list[Finite] | None = None


class _Rig(BaseModel):
    model_config = ConfigDict(extra="ignore")

    cameras: Annotated[list[_Camera], Field(min_length=1, max_length=MAX_CAMERAS)]


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout."""
    return (folder / CONFIG).is_file()


def read(
    folder: Path,
    scene: str | None = None,
    *,
    forward_camera: str | None = None,
    rate_hz: float | None = None,
    antenna_m: Sequence[float] | None = None,
    gnss_sigma_m: float | None = None,
) -> Recording:
    """Read one rig's images; the headers and EXIF of all are read.

    Parameters
    ----------
    scene
        Name of the rig, the first part of its cameras' prefixes; may be left out if there is only one.
    forward_camera
        Name of the camera that looks level and straight ahead; the reference camera by default.
    rate_hz
        Frames a second, where EXIF has no times or too coarse ones.
    antenna_m
        Position (3,) of the receiver's antenna: forward, left and up of the reference camera; there by default.
    gnss_sigma_m
        Standard deviation of horizontal positions where no file has it; heights have twice that.

    Raises
    ------
    InputError
        If a file is missing or malformed, or something is not known that an option gives.
    """
    file = folder / CONFIG
    rigs = read_document(file, RootModel[list[_Rig]], what="rig configuration", strict=False).root
    rig = choose_scene(_by_name(rigs), scene, folder)
    names = _names(rig, file)
    root = folder / "images" if (folder / "images").is_dir() else folder
    paths = _paths(root)
    images = _images(root, paths, rig, names, file)
    turn = _rig_from_reference(rig, names, forward_camera, file)
    cameras = [_camera(name, camera, images[name], turn, file) for name, camera in zip(names, rig.cameras, strict=True)]
    frames = _frames(images)
    tags = {path: read_exif(path) for own in images.values() for path in own.values()}
    times_us, time_note = _times_us(frames, {path: time for path, (time, _) in tags.items()}, rate_hz, folder)
    positions = _positions(folder, frames, {path: tag for path, (_, tag) in tags.items()})
    gnss, notes = _gnss(frames, times_us, positions, antenna_m, gnss_sigma_m, folder)
    units = [
        SourceUnit(source_frame=i, timestamp_us=times_us[i], images={n: SourceImage(file=p) for n, p in own.items()})
        for i, own in enumerate(frames)
    ]
    ahead = forward_camera or names[_reference(rig, file)]
    return Recording(
        layout="COLMAP rig",
        name=folder.resolve().name if scene is None else f"{folder.resolve().name}-{scene}",
        cameras=cameras,
        units=units,
        gnss=gnss,
        notes=[f"Rig frame: at the reference camera. {ahead} is taken to look level and straight ahead.", *time_note,
               *notes, *notes_of_images_without_a_camera(_without_a_camera(paths, rigs)),
               "Shutter: nothing says whether a camera reads its rows one after the other."],
    )  # fmt: skip


def _by_name(rigs: list[_Rig]) -> dict[str, _Rig]:
    """Rigs by the first part of their cameras' prefixes, else by their number."""
    heads = [{camera.image_prefix.strip("/").split("/")[0] for camera in rig.cameras} for rig in rigs]
    unique = all(len(head) == 1 for head in heads) and len(set().union(*heads)) == len(rigs)
    return {
        (next(iter(head)) if unique else f"rig{i + 1}"): rig
        for i, (head, rig) in enumerate(zip(heads, rigs, strict=True))
    }


def _names(rig: _Rig, file: Path) -> list[str]:
    """Names of cameras: the last part of their prefixes, or all of it where that is not unique."""
    parts = [camera.image_prefix.strip("/_-.").split("/") for camera in rig.cameras]
    short, full = [part[-1] for part in parts], ["_".join(part) for part in parts]
    names = [re.sub(r"[^A-Za-z0-9_.-]", "-", name) for name in (short if len(set(short)) == len(short) else full)]
    if len(set(names)) != len(names) or not all(names):
        raise InputError(
            f"rig configuration {file}: two cameras have one image_prefix", remedy="Give each its own.", code="bad-name"
        )
    return names


def _paths(root: Path) -> dict[str, Path]:
    """All images below a folder by their paths in it, without what macOS leaves beside them."""
    images = {path.relative_to(root).as_posix(): path for path in sorted(_files_below(root)) if is_image(path)}
    return {name: path for name, path in images.items() if not is_ignored(name) and path.is_file()}


def _files_below(folder: Path, above: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """All files below a folder, also in folders that are links, as to another disk; not in circles of them."""
    resolved = folder.resolve()
    if resolved in above:
        return
    for path in folder.iterdir():
        if path.is_dir():
            yield from _files_below(path, above | {resolved})
        else:
            yield path


def _images(
    root: Path, paths: Mapping[str, Path], rig: _Rig, names: list[str], file: Path
) -> dict[str, dict[str, Path]]:
    """Images of each camera by their names after its prefix."""
    found: dict[str, dict[str, Path]] = {}
    prefixes = [camera.image_prefix for camera in rig.cameras]
    # Images of cam10 begin with cam1, too: the longest prefix says whose an image is.
    of = {k: max((prefix for prefix in prefixes if k.startswith(prefix)), key=len, default=None) for k in paths}
    for name, camera in zip(names, rig.cameras, strict=True):
        own = {k.removeprefix(camera.image_prefix): p for k, p in paths.items() if of[k] == camera.image_prefix}
        if not own:
            raise InputError(
                f"rig configuration {file}: {root} has no images that begin with {camera.image_prefix!r}",
                remedy="Put the images there, or correct image_prefix.",
                code="no-images",
            )
        found[name] = own
    return found


def _without_a_camera(paths: Iterable[str], rigs: Iterable[_Rig]) -> list[str]:
    """Images that begin with the prefix of no camera, of whatever rig."""
    prefixes = tuple(camera.image_prefix for rig in rigs for camera in rig.cameras)
    return [path for path in paths if not path.startswith(prefixes)]


def _reference(rig: _Rig, file: Path) -> int:
    marked = [i for i, camera in enumerate(rig.cameras) if camera.ref_sensor]
    if len(marked) != 1:
        raise InputError(
            f"rig configuration {file}: {len(marked)} cameras are ref_sensor",
            remedy="Mark one.",
            code="bad-calibration",
        )
    return marked[0]


def _cam_from_reference(camera: _Camera, name: str, file: Path) -> Floats:
    if camera.ref_sensor:
        return np.eye(4)
    if camera.cam_from_rig_rotation is None or camera.cam_from_rig_translation is None:
        raise InputError(
            f"rig configuration {file}: camera {name} has no cam_from_rig_rotation and cam_from_rig_translation",
            remedy="Give them; `colmap rig_configurator` writes them of a reconstruction.",
            code="missing-calibration",
        )
    w, x, y, z = camera.cam_from_rig_rotation
    if abs(np.linalg.norm([w, x, y, z]) - 1.0) > 1e-3:
        raise InputError(
            f"rig configuration {file}: camera {name}: cam_from_rig_rotation is no unit quaternion",
            remedy="Give w, x, y, z.",
            code="bad-transform",
        )
    return se3.transform(se3.rotation_from_quaternion([x, y, z, w]), camera.cam_from_rig_translation)


def _rig_from_reference(rig: _Rig, names: list[str], forward: str | None, file: Path) -> Floats:
    """Rotation (4, 4) into x forward, y left, z up, about the reference camera's centre."""
    if forward is not None and forward not in names:
        raise InputError(
            f"rig configuration {file} has no camera {forward!r}",
            remedy=f"Name one of {', '.join(names)} with --forward-camera.",
            code="unknown-camera",
        )
    index = _reference(rig, file) if forward is None else names.index(forward)
    forward_from_reference = _cam_from_reference(rig.cameras[index], names[index], file)
    return se3.transform(flu_from_body(BodyAxes.RDF)[:3, :3] @ forward_from_reference[:3, :3], np.zeros(3))


def _camera(name: str, camera: _Camera, images: dict[str, Path], rig_from_reference: Floats, file: Path) -> Camera:
    if camera.camera_model_name is None or camera.camera_params is None:
        raise InputError(
            f"rig configuration {file}: camera {name} has no camera_model_name and camera_params",
            remedy="Give them, in COLMAP's order.",
            code="missing-calibration",
        )
    header = read_header(images[min(images)])
    return checked_camera(
        name,
        model=camera.camera_model_name,
        size=(header.width, header.height),
        params=camera.camera_params,
        rig_from_cam=rig_from_reference @ se3.inverse(_cam_from_reference(camera, name, file)),
        source=f"rig configuration {file}: camera {name}",
    )


def _frames(images: dict[str, dict[str, Path]]) -> list[dict[str, Path]]:
    """Images of one name together, in the order of names; numbers in them count as numbers."""
    keys = sorted({key for own in images.values() for key in own}, key=_in_natural_order)
    if len(keys) > MAX_FRAMES:
        raise InputError(f"there are images of {len(keys)} frames", remedy="Import some of them.", code="bad-size")
    return [{name: own[key] for name, own in images.items() if key in own} for key in keys]


def _in_natural_order(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", name) if part]


def _times_us(
    frames: list[dict[str, Path]], times_us: dict[Path, int | None], rate_hz: float | None, folder: Path
) -> tuple[list[int], list[str]]:
    """The mean times of each frame's images, or those of a constant rate."""
    if rate_hz is not None:
        note = f"Times: {rate_hz:g} frames a second, as --rate-hz says."
        return [round(i * 1e6 / rate_hz) for i in range(len(frames))], [note]
    means = []
    for frame in frames:
        known = [time for path in frame.values() if (time := times_us[path]) is not None]
        means.append(round(sum(known) / len(known)) if known else None)
    rising = [time for time in means if time is not None]
    if len(rising) < len(frames) or any(b <= a for a, b in pairwise(rising)):
        problem = "do not increase" if len(rising) == len(frames) else f"{len(frames) - len(rising)} frames have none"
        raise InputError(
            f"images in {folder}: their EXIF times do not make frames: {problem}",
            remedy="Give the frames a second with --rate-hz.",
            code="missing-times",
        )
    return rising, []


def _positions(folder: Path, frames: list[dict[str, Path]], exif: dict[Path, GeoTag | None]) -> list[GeoTag | None]:
    """A position of each frame: of geo.txt where there is one, else the first that EXIF has."""
    file = next((f for f in (folder / POSITIONS, folder / "images" / POSITIONS) if f.is_file()), None)
    if file is None:
        return [next((tag for path in frame.values() if (tag := exif[path]) is not None), None) for frame in frames]
    rows = read_geo_txt(file)
    found, used = [], set()
    for frame in frames:
        of_frame = None
        for path in frame.values():
            relative = path.relative_to(folder).as_posix()
            for key in (relative, relative.removeprefix("images/"), path.name):
                if key in rows:
                    used.add(key)
                    of_frame = of_frame or rows[key]
        found.append(of_frame)
    if unused := [name for name in rows if name not in used]:
        raise InputError(
            f"image positions {file} has {unused[0]}{' and more' if len(unused) > 1 else ''}, which no image is",
            remedy="Name the images as they lie in the folder.",
            code="bad-table",
        )
    return found


def _gnss(
    frames: list[dict[str, Path]],
    times_us: list[int],
    positions: list[GeoTag | None],
    antenna_m: Sequence[float] | None,
    sigma_m: float | None,
    folder: Path,
) -> tuple[Gnss | None, list[str]]:
    known = [(time, tag) for time, tag in zip(times_us, positions, strict=True) if tag is not None]
    if not known:
        return None, []
    horizontal = [tag.sigma_horizontal_m or sigma_m for _, tag in known]
    vertical = [
        tag.sigma_vertical_m or (h and VERTICAL_OVER_HORIZONTAL * h)
        for (_, tag), h in zip(known, horizontal, strict=True)
    ]
    if None in horizontal:
        raise InputError(
            f"images in {folder}: {horizontal.count(None)} of {len(known)} positions state no accuracy",
            remedy="Give the receiver's standard deviation with --gnss-sigma METRES.",
            code="missing-sigma",
        )
    if without := sum(tag.height_m is None for _, tag in known):
        raise InputError(
            f"images in {folder}: {without} of {len(known)} positions have no height",
            remedy="Add the heights to geo.txt.",
            code="bad-table",
        )
    gnss = gnss_of_vehicle(
        np.array([time for time, _ in known], dtype=np.int64),
        np.array([[tag.latitude_deg, tag.longitude_deg, tag.height_m] for _, tag in known], dtype=np.float64),
        np.array(horizontal, dtype=np.float64),
        np.array(vertical, dtype=np.float64),
        source=f"positions of images in {folder}",
    )
    notes = ["GNSS: heights are taken as ellipsoidal."]
    if len(known) < len(frames):
        notes.append(f"GNSS: {len(frames) - len(known)} frames have no position.")
    if antenna_m is None:
        notes.append(
            f"GNSS: the antenna is taken to be at the reference camera, but for {SIGMA_ANTENNA_M:g} m; --antenna gives "
            "its place."
        )
        return gnss.model_copy(update={"sigma_antenna_m": SIGMA_ANTENNA_M}), notes
    return gnss.model_copy(update={"antenna_in_rig_m": antenna_on_vehicle(antenna_m)}), notes
