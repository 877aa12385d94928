"""Writes a map's files, checks them, and puts them in place.

A map's folder holds what a scene's does (`model/`, `points.ply`, `poses.tum`, `poses.json`, `frame.json`, `pictures/`,
`report.json`), `calibration/NAME.json` of every drive, `map.json` (scenes, transforms, seams, verdicts), and in
`scenes/` and `seams/` what is needed to add scenes to it and take some out. One with a `report.json` is complete.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.export import check, check_colmap, colmap, coordinate_frame, picture_files, ply, pose_files
from mrasfm_engine.export.check import checking, require, require_close
from mrasfm_engine.export.publishing import COMPLETE_MARK, publishing
from mrasfm_engine.export.scene import check_scene, summary, write_json
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints
from schemas import Pose
from schemas.artifacts import MAP_FILE, PICTURES_FOLDER, SCENES_FOLDER, SEAMS_FOLDER

Kept = Mapping[str, tuple[str, Mapping[str, NDArray[Any]], Mapping[str, Any]]]  # by name: key, arrays, documents


CALIBRATION_FOLDER = "calibration"
REPLACED = (PICTURES_FOLDER, CALIBRATION_FOLDER, SCENES_FOLDER, SEAMS_FOLDER)


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
    """Write all files of a map into the folder `out`, as `export_scene.write_scene` does; what `report.json` says.

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
    needed = sum(array.nbytes for array in kept) + 400 * len(content.scene.points_m) + 200 * rows + 4_000_000
    needed += 60 * sum(len(f.xy_px) for f in content.scene.features) + picture_files.size_bytes(content.pictures)
    with publishing(out, needed, replaced=REPLACED) as work:
        return _write(content, work, report)


def _write(content: MapContent, work: Path, report: Mapping[str, Any]) -> dict[str, Any]:
    scene = content.scene
    picture_files.write_pictures(content.pictures, work / PICTURES_FOLDER)
    model, text = work / "model", work / "model" / "text"
    text.mkdir(parents=True)
    colmap.write_model(scene, model)
    check_colmap.check_binary_model(scene, model)
    figures = summary(scene)
    if colmap.text_model_fits(scene):
        colmap.write_text_model(model, text)
        check_colmap.check_text_model(scene, text)
    else:
        shutil.rmtree(text)
        figures["notes"].append("model/text is withheld: COLMAP's text format cannot hold image names with spaces")
    ply.write_ply(scene, work / "points.ply")
    check.check_ply(scene, work / "points.ply")
    (work / "poses.tum").write_text(_poses_text(scene), encoding="utf-8")
    write_json(work / "poses.json", _poses_document(content))
    write_json(work / "frame.json", _frame_document(scene))
    (work / CALIBRATION_FOLDER).mkdir()
    for name, document in content.calibrations.items():
        write_json(work / CALIBRATION_FOLDER / f"{name}.json", document)
    write_json(work / MAP_FILE, content.document)
    for folder, kept in ((SCENES_FOLDER, content.scenes), (SEAMS_FOLDER, content.seams)):
        store = StageStore(work / folder)
        for name, (key, arrays, documents) in kept.items():
            store.save(name, key, arrays, documents)
            require(store.has(name, key), work / folder / f"{name}.npz", "it cannot be read")
    written = {**report, "summary": figures}
    write_json(work / COMPLETE_MARK, written)
    _check_documents(content, work)
    return written


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
    files = {name: text for name, text in document["files"].items() if name != "calibration.json"}
    return document | {"files": files | {"calibration/NAME.json": "rig_from_cam of the drive NAME"}}


def _check_documents(content: MapContent, folder: Path) -> None:
    """Re-read the documents and compare them with the map and with one another."""
    scene = content.scene
    frame_path, poses_path, tum_path = folder / "frame.json", folder / "poses.json", folder / "poses.tum"
    with checking(frame_path):
        frame = check.read_json(frame_path)
        check.check_frame(scene, frame, frame_path)
    rig_from_cam: dict[str, Floats] = {}
    for name in content.calibrations:
        path = folder / CALIBRATION_FOLDER / f"{name}.json"
        with checking(path):
            for camera, found in check.read_json(path)["cameras"].items():
                rig_from_cam[f"{name}/{camera}"] = matrix_from_pose(Pose(**found["refined"]["rig_from_cam"]))
    with checking(poses_path):
        check.check_poses(scene, check.read_json(poses_path), frame, rig_from_cam, path=poses_path)
    with checking(tum_path):
        lines = [line.split() for line in tum_path.read_text(encoding="ascii").splitlines() if line[0] != "#"]
        order = _order(scene)
        times_us = [int(line[0].replace(".", "")) for line in lines]
        require(times_us == scene.drive.timestamps_us[order].tolist(), tum_path, "a timestamp is wrong")
        rows = np.array([line[1:] for line in lines], dtype=np.float64).reshape(-1, 7)
        poses = check.matrices(rows[:, 3:], rows[:, :3])
        require_close(poses, scene.world_from_rig[order], path=tum_path, what="a pose", tolerance=1e-6)
    for name in (MAP_FILE, COMPLETE_MARK):
        with checking(folder / name):
            document = json.loads((folder / name).read_text(encoding="utf-8"))
            require(isinstance(document, dict), folder / name, "it is no JSON object")
    for seam in content.document["seams"]:
        for path in seam.get("pictures", {}).values():
            require((folder / path).is_file(), folder / MAP_FILE, f"it names {path}, which is not there")
