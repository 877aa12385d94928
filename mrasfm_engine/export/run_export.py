"""An export of a scene or map: formats are written, read back, and put in place with a report."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from mrasfm_engine import __version__
from mrasfm_engine.errors import CancelledError, InputError, MrasfmError, StorageError
from mrasfm_engine.export.check import ReadBack
from mrasfm_engine.export.contract import DriveFiles, ExportOptions, ExportSource, ExportWork, Written
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.export.formats import CHECKS, WRITERS
from mrasfm_engine.export.publishing import publishing, while_nothing_moves
from mrasfm_engine.export.scene import write_json
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.geometry.earth_system import named_system, system_of_name
from mrasfm_engine.io.stage_store import fingerprints_of_images, sha256_of_files
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Cancel, StageProgress
from schemas import LabelMap
from schemas.artifacts import REPORT_FILE, ROAD_TIFF_FILE, drive_of_scene
from schemas.exports import EXPORT_FORMATS, MAX_IMAGE_SIZE_PX, MIN_IMAGE_SIZE_PX, unknown_formats

VERSION = 1  # of the report
REPORT_KEYS = {"version", "engine_version", "source", "options", "formats"}
POINT_BYTES, IMAGE_BYTES = 400, 1000  # on disk, at most, of each in any format without images


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """Wanted formats of a scene or map.

    Attributes
    ----------
    drives
        Folders of the drives: of a scene by the empty name, of a map by the scenes' names. Only formats with images
        need them.
    """

    folder: Path
    out: Path
    formats: Sequence[str]
    options: ExportOptions = field(default_factory=ExportOptions)
    drives: Mapping[str, Path]
    threads: int = 1


def run_export(request: ExportRequest, *, progress: StageProgress, cancel: Cancel) -> dict[str, Any]:
    """Write the formats into folders of their names below `out`, and `report.json`; what that says.

    Raises
    ------
    InputError
        Where the scene or map does not have what a format needs, or an option is out of range.
    CancelledError
        Where `cancel` says so. Nothing is published then.
    StorageError
        Where the disk is full or cannot be written.
    MrasfmError
        Where every format is withheld.
    """
    check_request(request)
    source = read_source(request.folder)
    _check_needs(request, source)
    if any(EXPORT_FORMATS[name].needs_images for name in request.formats):
        source = replace(source, files=_drive_files(request, source))
    else:
        for folder in request.drives.values():  # no format needs them, and a slip in their names would go unseen
            read_drive(folder)
    results: dict[str, Any] = {}
    replaced = partial(_replaced, request)
    with publishing(request.out, _size_bytes(request, source), replaced=replaced) as work:
        for name in dict.fromkeys(request.formats):
            step = partial(_step, progress, cancel, name)
            step(0, 0)
            own = ExportWork(
                source=source, options=request.options, folder=work / name, step=step, threads=request.threads
            )
            results[name] = _format(name, own)
            step(1, 1)
        if all("withheld" in result for result in results.values()):
            raise MrasfmError(
                f"nothing was exported: {'; '.join(result['withheld'] for result in results.values())}",
                remedy="Check that the disk is not full and run again; if it happens again, report it as a defect of "
                "mrasfm.",
                code="export-check-failed",
            )
        report = {
            "version": VERSION,
            "engine_version": __version__,
            "source": {"name": source.name, "kind": "map" if source.is_map else "scene"},
            "options": {key: value for key, value in asdict(request.options).items() if value is not None},
            "formats": results,
        }
        write_json(work / REPORT_FILE, report)
    return report


def _step(progress: StageProgress, cancel: Cancel, name: str, done: int, total: int) -> None:
    if cancel():
        raise CancelledError
    progress(name, done, total)


def _format(name: str, work: ExportWork) -> dict[str, Any]:
    """Write a format and read it back; its files, or why it is withheld."""
    work.folder.mkdir()
    try:
        written = WRITERS[name](work)
        fault = _fault(written, work.folder)
    except (InputError, CancelledError, OSError, StorageError):
        raise
    except Exception as error:
        fault = f"it cannot be written: {type(error).__name__}: {error}"
    if fault is not None:
        shutil.rmtree(work.folder)
        return {"withheld": f"{name} is withheld: {fault}"}
    known, crs = EXPORT_FORMATS[name], work.options.crs
    without = [] if crs is None or known.takes_crs else [f"{crs} does not apply: {known.without_crs}"]
    without += [f"{part} is a scene of its own, and not in it" for part in work.source.components_elsewhere]
    return {"files": list(_files(work.folder)), "notes": [*written.notes, *without]}


def _fault(written: Written, folder: Path) -> str | None:
    """The first file that does not read back, and why."""
    read_back = ReadBack(folder)
    read_back.expect(written.digests)
    for check in written.checks:
        fault = read_back.fault(check)
        if fault is not None:
            return f"{check.file} was written but does not read back: {fault}"
    try:
        read_back.require_all()
    except MrasfmError as error:
        return error.what
    return None


def _files(folder: Path) -> Iterator[dict[str, Any]]:
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        yield {"path": f"{folder.name}/{name}", "bytes": path.stat().st_size, "sha256": sha256(path)}


def check_request(request: ExportRequest) -> None:
    """Refuse formats and options that no scene could have.

    Raises
    ------
    InputError
        That names what is wrong, and what there is.
    """
    unknown = unknown_formats(request.formats)
    if unknown or not request.formats:
        raise InputError(
            f"unknown format {unknown[0]!r}" if unknown else "no format is given",
            remedy=f"Known formats are {', '.join(EXPORT_FORMATS)}.",
            code="unknown-format",
        )
    size = request.options.image_size_px
    if size is not None and not MIN_IMAGE_SIZE_PX <= size <= MAX_IMAGE_SIZE_PX:
        raise InputError(
            f"an image size of {size} px is out of range",
            remedy=f"Give {MIN_IMAGE_SIZE_PX} to {MAX_IMAGE_SIZE_PX} px for the longest side.",
            code="bad-image-size",
        )
    if request.options.crs is not None and not any(EXPORT_FORMATS[name].takes_crs for name in request.formats):
        raise InputError(
            "none of the formats takes a coordinate reference system",
            remedy=_listed("Formats that do", (f.name for f in EXPORT_FORMATS.values() if f.takes_crs)),
            code="crs-not-taken",
        )
    if request.options.crs is not None:
        system_of_name(request.options.crs)  # before the scene is read
    with while_nothing_moves(request.out):
        _replaced(request)


def _replaced(request: ExportRequest) -> list[str]:
    """Formats of the export that is in `out`, whose folders go.

    Raises
    ------
    InputError
        Where there is anything that no export has made.
    """
    out = request.out
    if not out.is_dir() or all(path.name.startswith(".") for path in out.iterdir()):
        return []
    earlier = _earlier_files(out)
    if earlier is None:
        raise _not_ours(f"{out} is not empty, and holds no earlier export: its files could be replaced")
    for name in dict.fromkeys([*earlier, *request.formats]):
        for path in _everything_in(out / name):
            # A folder is the export's where everything in it is: an empty one holds nothing to lose.
            if path.is_symlink() or (not path.is_dir() and not _is_as_listed(path, out, earlier.get(name, {}))):
                raise _not_ours(f"{path} is no file of the export in {out}, and would be removed with its folder")
    return [*earlier]


def _not_ours(what: str) -> InputError:
    return InputError(
        what,
        remedy="Give a new or empty folder for the export, or that of an earlier one, and keep other files elsewhere.",
        code="bad-out-folder",
    )


def _earlier_files(out: Path) -> dict[str, dict[str, int]] | None:
    """Files with their sizes, by format, that the report of an export in `out` lists; None where it is no export."""
    try:
        report = json.loads((out / REPORT_FILE).read_bytes())
        if set(report) != REPORT_KEYS or not set(report["formats"]) <= EXPORT_FORMATS.keys():
            return None
        return {
            name: {file["path"]: file["bytes"] for file in result.get("files", ())}
            for name, result in report["formats"].items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _everything_in(folder: Path) -> Iterator[Path]:
    """A file or folder with all that is below it; links are not followed."""
    if os.path.lexists(folder):
        yield folder
    for parent, folders, files in os.walk(folder):
        yield from (Path(parent, name) for name in sorted([*folders, *files]))


def _is_as_listed(path: Path, out: Path, listed: Mapping[str, int]) -> bool:
    return listed.get(path.relative_to(out).as_posix()) == path.lstat().st_size


def _listed(what: str, names: Iterator[str]) -> str:
    return f"{what}: {', '.join(names) or 'none'}."


def _check_needs(request: ExportRequest, source: ExportSource) -> None:
    for known in (EXPORT_FORMATS[name] for name in request.formats):
        if known.needs_place and source.scene.georeference is None:
            raise InputError(
                f"{request.folder} is not georeferenced, which {known.name} needs",
                remedy="Leave the format out, or reconstruct the drive with GNSS.",
                code="not-georeferenced",
            )
        if known.needs_images and not request.drives:
            raise InputError(
                f"{known.name} needs the images of the drive, and none is given",
                remedy="Give --drive NAME=DRIVE for each scene of the map."
                if source.is_map
                else "Give --drive DRIVE, the folder with drive.json.",
                code="drive-needed",
            )
    place = source.scene.georeference
    # Writers refuse these too, but after others have written for minutes what is then lost.
    if request.options.crs is not None and place is not None:
        named_system(request.options.crs, at=place.origin_deg)
    for check in (CHECKS[name] for name in request.formats if name in CHECKS):
        try:
            check(source, request.options)
        except MrasfmError:
            raise
        except Exception:
            continue  # a defect, which withholds the format where its writer meets it, and leaves the others


def _drive_files(request: ExportRequest, source: ExportSource) -> DriveFiles:
    """The drives' folders, each checked to be the one that its scene was made of."""
    folders: dict[str, Path] = {}
    labels: dict[str, LabelMap | None] = {}
    listed = _named_files(source)
    for scene, files in listed.items():
        folder = request.drives.get(scene, request.drives.get(drive_of_scene(scene)))
        if folder is None:
            raise InputError(
                f"no drive is given for scene {scene} of the map" if scene else "the drive of a scene has no name",
                remedy=f"Give --drive {scene}=DRIVE." if scene else "Give --drive DRIVE.",
                code="drive-needed",
            )
        drive = read_drive(folder)
        times_us = {image.file: image.timestamp_us for image in drive.images}
        # Drives of one vehicle have cameras and files of the same names: their times tell them apart.
        for file, time_us in files.items():
            if times_us.get(file) == time_us:
                continue
            there = f"has image {file} at {times_us.get(file)} us, the scene at {time_us} us"
            raise InputError(
                f"drive {folder} {there if file in times_us else f'has no image {file}'}",
                remedy=f"Give the drive that scene {scene} was made of." if scene else "Give the scene's own drive.",
                code="other-drive",
            )
        _require_same_images(request, source, drive)
        folders[scene], labels[scene] = drive.root, drive.manifest.label_map
    unused = sorted(set(request.drives) - listed.keys() - {drive_of_scene(scene) for scene in listed})
    if unused:
        raise InputError(
            f"there is no scene {unused[0]!r}",
            remedy=f"Scenes of the map are {', '.join(listed)}." if source.is_map else "A scene's drive has no name.",
            code="unknown-scene",
        )
    return DriveFiles(folders=folders, label_maps=labels)


def _require_same_images(request: ExportRequest, source: ExportSource, drive: Drive) -> None:
    """Refuse images that the scene was not made of: drives that begin at time 0 may agree in names and times."""
    if not source.images_sha256:
        return
    files = [source.scene.drive.images[image].file for image in source.registered]
    try:
        contents = sha256_of_files(drive.root, files, threads=request.threads)
    except OSError as error:
        raise InputError(
            f"image {error.filename} of drive {drive.root} cannot be read: {error.strerror}",
            remedy="Give the scene's own drive, with all its images.",
            code="missing-file",
        ) from None
    found = fingerprints_of_images(source.scene, contents)
    for camera, expected in source.images_sha256.items():
        if found.get(camera) != expected:
            raise InputError(
                f"drive {drive.root} has other images of camera {camera} than those that the scene was made of",
                remedy="Give the scene's own drive, with its images as they were.",
                code="other-drive",
            )


def _named_files(source: ExportSource) -> dict[str, dict[str, int]]:
    """Names of the registered images within their drives, with their times, by scene."""
    result: dict[str, dict[str, int]] = {}
    for image in source.registered:
        known = source.scene.drive.images[image]
        scene, file = source.place_of_file(known.file, image)
        result.setdefault(scene, {})[file] = known.timestamp_us
    return result


def _size_bytes(request: ExportRequest, source: ExportSource) -> int:
    """About what the files of all formats take."""
    scene, total = source.scene, 2_000_000
    images = 0
    if request.options.image_size_px is None and source.files is not None:
        images = sum(_bytes(source.image_path(image)) for image in source.registered)
    for known in (EXPORT_FORMATS[name] for name in request.formats):
        total += POINT_BYTES * len(scene.points_m) + IMAGE_BYTES * len(scene.drive.images)
        total += 2 * images if known.needs_images else 0
        total += _bytes(source.folder / ROAD_TIFF_FILE) if known.needs_picture else 0
    return total


def _bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
