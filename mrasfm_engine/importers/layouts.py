"""Recognises the layout of a recording and imports it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers import (
    argoverse2,
    bags,
    colmap_rig,
    kitti,
    kitti_raw,
    nuscenes,
    pandaset,
    rig_folder,
    waymo,
)
from mrasfm_engine.importers.drive_writer import ImportSummary, folder_beside, write_recording
from mrasfm_engine.importers.recording import Recording, RoughQuality, SourceUnit, select_cameras, select_units
from mrasfm_engine.importers.rough_poses import with_rough_poses
from mrasfm_engine.importers.skipped_images import notes_of_missing_images, notes_of_unread_files
from mrasfm_engine.importers.tables import ANTENNA_FILE, read_antenna, read_gnss_csv
from mrasfm_engine.io.axes import flu_from_body
from schemas import Gnss, GnssSample
from schemas.drive import MAX_DRIVE_NAME_CHARACTERS, MAX_RIG_EXTENT_M, PRINTED_NAME, VEHICLE_NAME
from schemas.findings import listed

LAYOUTS: tuple[ModuleType, ...] = (
    rig_folder,
    kitti,
    kitti_raw,
    nuscenes,
    pandaset,
    argoverse2,
    waymo,
    colmap_rig,
    bags,
)

# GNSS samples this long before the first and after the last image are kept: they smooth the ends of the track.
GNSS_MARGIN_US = 2_000_000
MAX_RECORDINGS_NAMED = 10  # in a message


def import_recording(
    folder: Path,
    out: Path,
    *,
    frames: str | None = None,
    cameras: Sequence[str] | None = None,
    gnss_file: Path | None = None,
    scene: str | None = None,
    options: Mapping[str, Any] | None = None,
    name: str | None = None,
    vehicle: str | None = None,
    truth: bool = False,
    rough_noise: RoughQuality | None = None,
    copy: bool = False,
    force: bool = False,
) -> ImportSummary:
    """Turn a recording in a known layout into a drive bundle.

    Parameters
    ----------
    folder
        The recording; a file, if it is a bag.
    out
        Where the drive goes.
    frames
        A slice START:STOP:STEP over the recording's frames in order of time.
    cameras
        Names of those that are wanted; all by default.
    gnss_file
        GNSS table to use instead of the recording's own; a relative path is looked up in `folder`, then in the working
        directory.
    scene
        Name of the scene, for layouts that hold several.
    options
        Further ones of the layout, by the names in its `OPTIONS`.
    name
        Name of the drive instead of the recording's: of two pieces of one recording, say.
    vehicle
        Which vehicle drove, instead of what the recording says.
    truth
        Whether the units' poses become the truth where they are outputs of the system that the GNSS is of, too.
    rough_noise
        Noise with which the units' poses become rough poses.
    copy, force
        See `write_recording`.

    Raises
    ------
    InputError
        If the layout is not known or something in it is missing or malformed.
    StorageError
        If the drive cannot be written.
    """
    folder, out = Path(folder), Path(out)
    _require_names(name, vehicle)
    if not folder.exists():
        raise InputError(f"recording {folder} does not exist", remedy="Check the path.", code="missing-folder")
    if folder.resolve() == out.resolve() or out.resolve() in folder.resolve().parents:
        raise InputError(
            f"the drive {out} would replace the recording {folder}", remedy="Give another folder.", code="output-in-use"
        )
    wanted = {**(options or {}), "scene": scene}
    with folder_beside(out) as scratch:
        recording = select_units(select_cameras(_read(folder, wanted, scratch), cameras), frames)
        recording = replace(recording, name=name or recording.name, vehicle=vehicle or recording.vehicle)
        if rough_noise is not None:
            recording = with_rough_poses(recording, rough_noise)
        if recording.truth_is_gnss and not truth:
            recording = replace(recording, units=[replace(unit, world_from_rig=None) for unit in recording.units])
        recording = _with_notes_of_images(_with_gnss(recording, folder, gnss_file))
        return write_recording(recording, out, copy=copy, force=force)


def _require_names(name: str | None, vehicle: str | None) -> None:
    if name is not None and not (
        len(name) <= MAX_DRIVE_NAME_CHARACTERS and re.fullmatch(PRINTED_NAME.expression, name)
    ):
        raise InputError(
            f"--name {name!r} is no name of a drive",
            remedy=f"Give up to {MAX_DRIVE_NAME_CHARACTERS} {PRINTED_NAME.words}.",
            code="bad-drive-name",
        )
    if vehicle is not None and not re.fullmatch(VEHICLE_NAME.expression, vehicle):
        raise InputError(
            f"--vehicle {vehicle!r} is no name of a vehicle",
            remedy=f"Give {VEHICLE_NAME.words}.",
            code="bad-vehicle",
        )


def _read(path: Path, options: Mapping[str, Any], scratch: Path) -> Recording:
    given = {name: value for name, value in options.items() if value is not None}
    for layout in LAYOUTS if path.is_dir() else (bags,):
        if not layout.recognises(path):
            continue
        if unused := [name for name in given if name not in layout.OPTIONS]:
            if unused == ["scene"]:
                raise InputError(f"recording {path} has only one scene", remedy="Leave --scene out.", code="no-scenes")
            raise InputError(
                f"a recording with {layout.DESCRIPTION} has no use for {', '.join(map(_flag, unused))}",
                remedy="Leave it out.",
                code="unused-option",
            )
        if path.is_dir():
            _require_one_recording(path, layout, given.get("scene"))
        recording: Recording = layout.read(path, **given, **({"scratch": scratch} if layout is bags else {}))
        return recording
    if path.is_dir() and (inside := _recordings_inside(path)):
        raise _several_recordings(path, inside)
    looked_for = "; ".join(layout.DESCRIPTION for layout in LAYOUTS)
    raise InputError(
        f"the layout of {path} is not known. Looked for: {looked_for}",
        remedy="Give a bag or the folder that holds these files, or write a drive.json: `mrasfm describe manifest`.",
        code="unknown-layout",
    )


def _require_one_recording(path: Path, layout: ModuleType, scene: str | None) -> None:
    """Refuse a folder around recordings of the layout that is also one around others, unless one is named."""
    if not any(_is_recognised(layout, folder) for folder in _folders_inside(path)):
        return  # the folder is the recording
    inside = _recordings_inside(path)
    others = [name for name, known in inside.items() if known is not layout]
    if others and (scene is None or scene in others):
        raise _several_recordings(path, inside)


def _recordings_inside(path: Path) -> dict[str, ModuleType]:
    """Names of the folders in a folder that are recordings, with their layouts."""
    found = {}
    for folder in _folders_inside(path):
        layout = next((layout for layout in LAYOUTS if _is_recognised(layout, folder)), None)
        if layout is not None:
            found[folder.name] = layout
    return found


def _folders_inside(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.name.startswith("."))


def _is_recognised(layout: ModuleType, folder: Path) -> bool:
    try:
        return bool(layout.recognises(folder))
    except (OSError, InputError):
        return False  # as a folder that cannot be listed


def _several_recordings(path: Path, inside: Mapping[str, ModuleType]) -> InputError:
    named = listed([f"{name} ({layout.DESCRIPTION})" for name, layout in inside.items()], MAX_RECORDINGS_NAMED)
    return InputError(
        f"{path} is a folder around recordings: {named}",
        remedy=f"Give one of them, as {path / next(iter(inside))}.",
        code="several-recordings",
    )


def _flag(option: str) -> str:
    """The option as the command has it: names there have no unit."""
    return "--" + option.removesuffix("_m").replace("_", "-")


def _with_notes_of_images(recording: Recording) -> Recording:
    cameras = [camera.name for camera in recording.cameras]
    unread = notes_of_unread_files(recording.unread_files)
    return replace(recording, notes=[*recording.notes, *unread, *notes_of_missing_images(cameras, recording.units)])


def _with_gnss(recording: Recording, folder: Path, gnss_file: Path | None) -> Recording:
    file = recording.default_gnss if gnss_file is None else _find(gnss_file, folder)
    if file is None:
        if recording.gnss is None:
            return recording
        own = recording.gnss.model_copy(update={"samples": samples_around(recording.gnss.samples, recording.units)})
        return replace(recording, gnss=own)
    folder = folder if folder.is_dir() else folder.parent
    antenna_file = file.parent / ANTENNA_FILE
    if not antenna_file.exists():
        antenna_file = folder / ANTENNA_FILE
    in_body_m, notes = read_antenna(antenna_file)
    antenna = flu_from_body(recording.body_axes)[:3, :3] @ in_body_m
    if np.abs(antenna).max() > MAX_RIG_EXTENT_M:
        raise InputError(
            f"antenna position {antenna_file} is over {MAX_RIG_EXTENT_M:g} m from the vehicle's origin",
            remedy="Give metres in the body axes of the calibration.",
        )
    samples = samples_around(read_gnss_csv(file), recording.units)
    gnss = Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[float(v) for v in antenna], samples=samples)
    return replace(recording, gnss=gnss, notes=[*recording.notes, *notes])


def _find(gnss_file: Path, folder: Path) -> Path:
    folder = folder if folder.is_dir() else folder.parent
    candidates = [folder / gnss_file, gnss_file]  # joining an absolute path gives that path
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    tried = " and ".join(dict.fromkeys(str(c.absolute()) for c in candidates))
    raise InputError(f"GNSS file {gnss_file} was not found: tried {tried}", remedy="Check the path.")


def samples_around(samples: list[GnssSample], units: list[SourceUnit]) -> list[GnssSample]:
    """The samples that matter to the units, in the order of the file.

    Those within `GNSS_MARGIN_US` of the units' time span, and the nearest beyond each end, so that positions at the
    first and last image can be interpolated. If none is near, and none lies before the units or none after them, all
    are kept: the mismatch is then seen when the drive is checked.
    """
    times = np.array([sample.timestamp_us for sample in samples], dtype=np.int64)
    start, end = units[0].timestamp_us, units[-1].timestamp_us
    before, after = times[times <= start], times[times >= end]
    lower = min(start - GNSS_MARGIN_US, int(before.max()) if len(before) else start)
    upper = max(end + GNSS_MARGIN_US, int(after.min()) if len(after) else end)
    inside = (times >= lower) & (times <= upper)
    is_near = ((times >= start - GNSS_MARGIN_US) & (times <= end + GNSS_MARGIN_US)).any()
    if not is_near and not (len(before) and len(after)):
        return samples
    return [sample for sample, keep in zip(samples, inside, strict=True) if keep]
