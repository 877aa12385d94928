"""Writes a recording as a drive bundle: whole or not at all."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from mrasfm_engine.errors import InputError, storage_error
from mrasfm_engine.importers.recording import ImageKey, Recording, SourceImage, SourceUnit
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.preflight.drive_reader import MANIFEST_NAME, foreign_file, write_manifest
from mrasfm_engine.scene.drive import pose_from_matrix
from schemas import DriveManifest, Frame, FrameImage, Rig, RoughPose, RoughTrajectory
from schemas.drive import FIELDS_OF_VERSION_2, GNSS_FIELDS_OF_VERSION_2
from schemas.file_names import TRUTH_NAME
from schemas.parsing import file_problems


@dataclass(frozen=True, kw_only=True)
class ImportSummary:
    """Summary of a written drive."""

    layout: str
    drive: Path
    cameras: int
    units: int
    images: int
    masks: int
    gnss_samples: int
    rough_poses: int
    truth: bool
    notes: list[str]


def write_recording(recording: Recording, out: Path, *, copy: bool = False, force: bool = False) -> ImportSummary:
    """Write the recording to the folder `out`, which appears when everything is in it.

    Parameters
    ----------
    copy
        Copy images instead of making hard links where the file system allows them.
    force
        Replace a drive that is already there.

    Raises
    ------
    InputError
        If `out` is in use, or a source file cannot be read.
    StorageError
        If the disk is full or cannot be written.
    """
    out = Path(out).resolve()
    _check_target(out, force=force)
    with folder_beside(out) as partial:
        try:
            partial.mkdir(parents=True)
            summary = _fill(recording, partial, drive=out, copy=copy)
            _put_in_place(partial, out)
        except OSError as error:
            raise storage_error(out, error) from error
    return summary


@contextmanager
def folder_beside(out: Path) -> Iterator[Path]:
    """A free name beside `out`, on its disk; a folder of this name is gone when the `with` block ends."""
    out = Path(out).resolve()
    folder = out.with_name(f".{out.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield folder
    finally:  # also on Ctrl-C: nothing half-written stays
        shutil.rmtree(folder, ignore_errors=True)


def _check_target(out: Path, *, force: bool) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out} is a file", remedy="Give the drive's folder another name.", code="output-in-use")
    first = min(out.iterdir(), default=None)
    if first is None:
        return
    if not (out / MANIFEST_NAME).exists():
        raise InputError(
            f"{out} holds files that are not a drive, as {first.name}",
            remedy="Give a new or empty folder.",
            code="output-in-use",
        )
    if not force:
        raise InputError(
            f"{out} already holds a drive",
            remedy="Give another folder, or --force to replace it.",
            code="output-in-use",
        )
    foreign = foreign_file(out)
    if foreign is not None:
        raise InputError(
            f"{foreign} is no file of an imported drive, and would be removed with the drive in {out}",
            remedy="Give another folder, or keep it elsewhere.",
            code="output-in-use",
        )


def _put_in_place(partial: Path, out: Path) -> None:
    if not out.exists() or not any(out.iterdir()):
        partial.replace(out)
        return
    old = partial.with_suffix(".old")
    out.replace(old)
    try:
        partial.replace(out)
    except BaseException:
        old.replace(out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _fill(recording: Recording, folder: Path, *, drive: Path, copy: bool) -> ImportSummary:
    manifest = _manifest(recording)
    for camera in recording.cameras:
        (folder / "images" / camera.name).mkdir(parents=True)
    masks = 0
    targets: dict[ImageKey, Path] = {}
    for unit, frame in zip(recording.units, manifest.frames, strict=True):
        for name, image in frame.images.items():
            source = unit.images[name]
            if source.key is None:
                _place(source.file, folder / image.file, copy=copy)
            else:
                targets[source.key] = folder / image.file
            if source.mask is not None and image.mask is not None:
                (folder / image.mask).parent.mkdir(parents=True, exist_ok=True)
                _place(source.mask, folder / image.mask, copy=copy)
                masks += 1
    _write_contents(recording, targets)
    known = [unit for unit in recording.units if unit.world_from_rig is not None]
    if known:
        poses = np.stack([unit.world_from_rig for unit in known if unit.world_from_rig is not None])
        text = format_tum([unit.timestamp_us for unit in known], poses)
        (folder / TRUTH_NAME).write_text(text, encoding="utf-8")
    write_manifest(manifest, folder)
    return ImportSummary(
        layout=recording.layout,
        drive=drive,
        cameras=len(recording.cameras),
        units=len(recording.units),
        images=sum(len(unit.images) for unit in recording.units),
        masks=masks,
        gnss_samples=len(manifest.gnss.samples) if manifest.gnss else 0,
        rough_poses=len(manifest.rough_poses.poses) if manifest.rough_poses else 0,
        truth=bool(known),
        notes=recording.notes,
    )


def _write_contents(recording: Recording, targets: dict[ImageKey, Path]) -> None:
    """Write the images that lie in a file with others."""
    if not targets or recording.contents is None:
        return
    for key, content in recording.contents(targets.keys()):
        with targets.pop(key).open("xb") as sink:
            sink.write(content)
    if targets:
        raise InputError(
            f"recording {recording.name}: {len(targets)} images are gone, the first {next(iter(targets))}",
            remedy="Import again while nothing writes to the recording.",
            code="missing-file",
        )


def _manifest(recording: Recording) -> DriveManifest:
    try:
        rough = [
            RoughPose(timestamp_us=unit.timestamp_us, world_from_rig=pose_from_matrix(unit.rough_world_from_rig))
            for unit in recording.units
            if unit.rough_world_from_rig is not None
        ]
        manifest = DriveManifest(
            version=2 if _needs_version_2(recording) else 1,
            **({} if recording.vehicle is None else {"vehicle": recording.vehicle}),
            name=recording.name,
            rig=Rig(cameras=recording.cameras),
            frames=[_frame(unit) for unit in recording.units],
            gnss=recording.gnss,
            rough_poses=_trajectory(recording, rough) if rough else None,
            label_map=recording.label_map,
            notes=recording.notes,
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        what = ": ".join([*map(str, first["loc"]), str(first["msg"]).removeprefix("Value error, ")])
        if isinstance(first["input"], int | float):
            what = f"{what} (is {first['input']})"
        remedy = "Give a name with --name." if first["loc"] == ("name",) else "Correct it at its source."
        raise InputError(f"recording {recording.name}: {what}", remedy=remedy) from None
    for problem in file_problems(manifest):
        what = f"the drive's file {problem.path} {problem.what}"
        raise InputError(f"recording {recording.name}: {what}", remedy="Rename its camera at its source.")
    return manifest


def _needs_version_2(recording: Recording) -> bool:
    fields = [FIELDS_OF_VERSION_2 & camera.model_fields_set for camera in recording.cameras]
    if recording.gnss is not None:
        fields.append(GNSS_FIELDS_OF_VERSION_2 & recording.gnss.model_fields_set)
    return recording.vehicle is not None or any(fields)


def _trajectory(recording: Recording, poses: list[RoughPose]) -> RoughTrajectory:
    quality = recording.rough_quality
    sigmas = (
        {} if quality is None else {"sigma_translation_m": quality.sigma_m, "sigma_rotation_deg": quality.sigma_deg}
    )
    return RoughTrajectory(poses=poses, common_world=recording.common_world, **sigmas)


def _frame(unit: SourceUnit) -> Frame:
    return Frame(
        timestamp_us=unit.timestamp_us,
        source_frame=unit.source_frame,
        images={name: _frame_image(name, unit.source_frame, image) for name, image in unit.images.items()},
    )


def _frame_image(camera: str, frame: int, image: SourceImage) -> FrameImage:
    mask = None if image.mask is None else f"masks/{camera}/{frame:06d}{image.mask.suffix.lower()}"
    file = f"images/{camera}/{frame:06d}{image.file.suffix.lower()}"
    return FrameImage(file=file, timestamp_us=image.timestamp_us, mask=mask)


def _place(source: Path, target: Path, *, copy: bool) -> None:
    if not source.is_file():  # also a link that leads nowhere, or in a circle
        raise InputError(f"{source} does not exist or is not a file", remedy="Restore it.", code="missing-file")
    source = source.resolve()  # a link to a symbolic link would not be self-contained
    if not copy:
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system, or one without hard links
    try:
        stream = source.open("rb")
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror}", remedy="Check its permissions.") from error
    with stream, target.open("xb") as sink:
        shutil.copyfileobj(stream, sink, 1 << 20)
