"""Writes a map's files, checks them, and puts them in place.

A map's folder holds what a scene's does (`model/`, `points.ply`, `poses.tum`, `poses.json`, `frame.json`, `pictures/`,
`report.json`, what other programs read), `calibration/NAME.json` of every drive, `map.json` (scenes, transforms, seams,
verdicts), and in `scenes/` and `seams/` what is needed to add scenes to it and take some out. One with a `report.json`
is complete.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.export import comparisons, coordinate_frame, interchange, picture_files, pose_files, readers
from mrasfm_engine.export.check import Check, ReadBack, common_checks, completing_checks
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.file_contents import sha256, write_content
from mrasfm_engine.export.interchange import Interchange
from mrasfm_engine.export.publishing import COMPLETE_MARK, publishing
from mrasfm_engine.export.report_page import map_page, write_page
from mrasfm_engine.export.scene import check_scene, write_common, write_json
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Ints
from schemas.artifacts import (
    MAP_FILE,
    PICTURES_FOLDER,
    REPORT_PAGE,
    RIG_FOLDER,
    RIGS_FOLDER,
    SCENES_FOLDER,
    SEAMS_FOLDER,
    checkpoint_file,
)

Kept = Mapping[str, tuple[str, Mapping[str, NDArray[Any]], Mapping[str, Any]]]  # by name: key, arrays, documents


CALIBRATION_FOLDER = "calibration"
REPLACED = (PICTURES_FOLDER, CALIBRATION_FOLDER, SCENES_FOLDER, SEAMS_FOLDER, REPORT_PAGE, *interchange.OPTIONAL)


@dataclass(frozen=True, kw_only=True)
class MapContent:
    """Content of a map's folder."""

    scene: Scene  # of all drives together
    scene_of_unit: list[str]
    document: Mapping[str, Any]  # map.json
    calibrations: Mapping[str, Mapping[str, Any]]  # by scene
    pictures: Mapping[str, bytes]
    scenes: Kept
    seams: Kept


def write_map(content: MapContent, out: Path, report: Mapping[str, Any]) -> dict[str, Any]:
    """Write all files of a map into the folder `out`, as `export.scene.write_scene` does; what `report.json` says.

    Raises
    ------
    StorageError
        Where the disk is full or cannot be written.
    MrasfmError
        Where the map contradicts itself, or a file that was written does not read back.
    """
    check_scene(content.scene)
    kept = [
        array for part in (content.scenes, content.seams) for _, arrays, _ in part.values() for array in arrays.values()
    ]
    rows = len(content.scene.observation_point)
    needed = sum(array.nbytes for array in kept) + 460 * len(content.scene.points_m) + 200 * rows + 4_000_000
    needed += 60 * sum(len(f.xy_px) for f in content.scene.features) + picture_files.size_bytes(content.pictures)
    with publishing(out, needed, replaced=REPLACED) as work:
        return _write(content, work, report)


def _write(content: MapContent, work: Path, report: Mapping[str, Any]) -> dict[str, Any]:
    scene, read_back = content.scene, ReadBack(work)
    picture_files.write_pictures(content.pictures, work / PICTURES_FOLDER)
    figures = write_common(scene, work, read_back)
    rigs = {f"{RIGS_FOLDER}/{name}": f"{name}/" for name in content.calibrations}
    others = Interchange(scene=scene, scene_of_unit=content.scene_of_unit, rigs=rigs, map_document=content.document)
    figures["notes"] += others.write(work, read_back)
    digests = {"poses.tum": write_content(work / "poses.tum", _poses_text(scene))}
    digests["poses.json"] = write_json(work / "poses.json", _poses_document(content), in_lines=pose_files.LISTS)
    digests["frame.json"] = write_json(work / "frame.json", _frame_document(scene))
    (work / CALIBRATION_FOLDER).mkdir()
    for name, document in content.calibrations.items():
        file = f"{CALIBRATION_FOLDER}/{name}.json"
        digests[file] = write_json(work / file, document)
    digests[MAP_FILE] = write_json(work / MAP_FILE, content.document)
    for folder, kept in ((SCENES_FOLDER, content.scenes), (SEAMS_FOLDER, content.seams)):
        store = StageStore(work / folder)
        for name, (key, arrays, documents) in kept.items():
            store.save(name, key, arrays, documents)
            digests[f"{folder}/{checkpoint_file(name)}"] = sha256(work / folder / checkpoint_file(name))
    written = {**report, "summary": figures}
    make_page = partial(map_page, content.document, work, written, content.calibrations)
    figures["notes"] += write_page(work, make_page, read_back, content.calibrations)
    digests[COMPLETE_MARK] = write_json(work / COMPLETE_MARK, written)
    read_back.expect(digests)
    read_back.check(_checks(content))
    read_back.require_all()
    return written


def _checks(content: MapContent) -> list[Check]:
    scene = content.scene
    calibrations = [
        Check(
            f"{CALIBRATION_FOLDER}/{name}.json",
            readers.json_object,
            partial(comparisons.calibration, scene, prefix=f"{name}/"),
        )
        for name in content.calibrations
    ]
    kept = [
        Check(f"{folder}/{checkpoint_file(name)}", partial(_is_kept, key), partial(comparisons.content, True))
        for folder, parts in ((SCENES_FOLDER, content.scenes), (SEAMS_FOLDER, content.seams))
        for name, (key, _, _) in parts.items()
    ]
    return [
        *common_checks(scene),
        *completing_checks(content.pictures),
        Check("poses.tum", readers.tum, partial(comparisons.tum, scene, _order(scene))),
        Check(MAP_FILE, readers.json_object, partial(_pictures_exist, content.pictures)),
        *calibrations,
        *kept,
    ]


def _is_kept(key: str, path: Path) -> bool:
    return StageStore(path.parent).has(path.stem, key)


def _pictures_exist(pictures: Mapping[str, bytes], document: Mapping[str, Any]) -> Rows:
    named = {path for seam in document["seams"] for path in seam.get("pictures", {}).values()}
    missing = named - {f"{PICTURES_FOLDER}/{name}" for name in pictures}
    yield Row("what it lacks of the seams' pictures", sorted(missing), [])


def _order(scene: Scene) -> Ints:
    """Registered units in order of time; those of one instant in order of scenes."""
    units = np.flatnonzero(scene.unit_registered)
    return units[np.argsort(scene.drive.timestamps_us[units], kind="stable")]


def _poses_text(scene: Scene) -> str:
    order = _order(scene)
    return format_tum(scene.drive.timestamps_us[order].tolist(), scene.world_from_rig[order])


def _poses_document(content: MapContent) -> dict[str, Any]:
    document = pose_files.poses_document(content.scene)
    for unit, name in zip(document["units"], content.scene_of_unit, strict=True):
        unit["scene"] = name
    for image in document["images"]:
        image["scene"] = content.scene_of_unit[image["unit"]]
    return document


def _frame_document(scene: Scene) -> dict[str, Any]:
    document = coordinate_frame.frame_document(scene)
    files = {name: text for name, text in document["files"].items() if name not in ("calibration.json", RIG_FOLDER)}
    of_drives = {
        "calibration/NAME.json": "rig_from_cam of the drive NAME",
        f"{RIGS_FOLDER}/NAME": coordinate_frame.FILES[RIG_FOLDER],
    }
    return document | {"files": files | of_drives}
