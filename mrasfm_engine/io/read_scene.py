"""Reader of a written scene, for evaluation and pictures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.trajectory_file import Trajectory, read_tum
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.types import Floats
from schemas import Pose

REMEDY = "Give the folder that `mrasfm reconstruct --out` wrote."


@dataclass(frozen=True, kw_only=True)
class ScenePoses:
    """The poses of a written scene and how many of the drive's images they cover."""

    trajectory: Trajectory  # registered units
    total_units: int
    registered_images: int
    total_images: int
    world_from_cam: dict[str, Floats]  # registered images' poses (4, 4) by file


def read_poses(folder: Path) -> ScenePoses:
    """Read `poses.tum` and `poses.json` of a scene.

    Raises
    ------
    InputError
        Where the folder is not a scene, or its files are malformed or contradict each other.
    """
    if not (folder / "poses.tum").is_file():
        raise InputError(f"{folder} is not a scene: it has no poses.tum", remedy=REMEDY)
    trajectory = read_tum(folder / "poses.tum")
    path = folder / "poses.json"
    document = read_json(path)
    try:
        units, images = document["units"], document["images"]
        registered = [image for image in images if image["registered"]]
        poses = {image["file"]: matrix_from_pose(Pose(**image["world_from_cam"])) for image in registered}
        times_us = sorted(unit["timestamp_us"] for unit in units if unit["registered"])
    except (KeyError, TypeError, ValidationError) as error:
        raise InputError(f"{path} is not a scene's poses: {error}", remedy=REMEDY) from error
    if times_us != trajectory.timestamps_us.tolist():
        raise InputError(f"{folder}: poses.tum and poses.json hold different units", remedy="Write the scene again.")
    return ScenePoses(
        trajectory=trajectory,
        total_units=len(units),
        registered_images=len(registered),
        total_images=len(images),
        world_from_cam=poses,
    )


def read_calibration(path: Path) -> dict[str, Floats]:
    """`rig_from_cam` (4, 4) by camera name.

    Reads a scene's `calibration.json` (the refined poses) and a simulated drive's `truth_calibration.json`, which holds
    a pose a camera.

    Raises
    ------
    InputError
        Where the file is neither.
    """
    document = read_json(path)
    try:
        if "cameras" in document and "version" in document:
            document = {name: camera["refined"]["rig_from_cam"] for name, camera in document["cameras"].items()}
        return {name: matrix_from_pose(Pose(**pose)) for name, pose in document.items()}
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        raise InputError(f"{path} is not a calibration: {error}", remedy="Give a calibration.json.") from error


def read_json(path: Path, *, remedy: str = REMEDY) -> dict[str, Any]:
    """The JSON object in a file that was written with a scene or map.

    Raises
    ------
    InputError
        Where there is none.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}", remedy=remedy) from error
    if not isinstance(document, dict):
        raise InputError(f"{path} holds no JSON object", remedy=remedy)
    return document
