"""An export of a scene or map: formats are written, read back, and put in place with a report."""

from __future__ import annotations

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
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.publishing import publishing
from mrasfm_engine.export.readers import sha256
from mrasfm_engine.export.scene import write_json
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.types import Cancel, StageProgress
from schemas import LabelMap
from schemas.artifacts import MAP_FILE, REPORT_FILE, drive_of_scene
from schemas.exports import EXPORT_FORMATS, MAX_IMAGE_SIZE_PX, MIN_IMAGE_SIZE_PX, unknown_formats

VERSION = 1  # of the report
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
    results: dict[str, Any] = {}
    with publishing(request.out, _size_bytes(request, source), replaced=tuple(EXPORT_FORMATS)) as work:
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
    return {"files": list(_files(work.folder)), "notes": list(written.notes)}


def _fault(written: Written, folder: Path) -> str | None:
    """The first file that does not read back, and why."""
    read_back = ReadBack(folder)
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
    out = request.out
    if out.resolve() == request.folder.resolve() or any((out / name).is_file() for name in ("poses.json", MAP_FILE)):
        raise InputError(
            f"{out} holds a scene or a map, whose report an export would replace",
            remedy="Give another folder for the export.",
            code="bad-out-folder",
        )


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
        missing = sorted(files - {image.file for image in drive.images})
        if missing:
            raise InputError(
                f"drive {folder} has no image {missing[0]}",
                remedy=f"Give the drive that scene {scene} was made of." if scene else "Give the scene's own drive.",
                code="other-drive",
            )
        folders[scene], labels[scene] = drive.root, drive.manifest.label_map
    unused = sorted(set(request.drives) - listed.keys() - {drive_of_scene(scene) for scene in listed})
    if unused:
        raise InputError(
            f"there is no scene {unused[0]!r}",
            remedy=f"Scenes of the map are {', '.join(listed)}." if source.is_map else "A scene's drive has no name.",
            code="unknown-scene",
        )
    return DriveFiles(folders=folders, label_maps=labels)


def _named_files(source: ExportSource) -> dict[str, set[str]]:
    """Names of the registered images within their drives, by scene."""
    result: dict[str, set[str]] = {}
    for image in source.registered:
        scene, file = source.place_of_file(source.scene.drive.images[image].file, image)
        result.setdefault(scene, set()).add(file)
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
    return total


def _bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
