"""Reader of a written map, for evaluation and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.read_scene import read_json
from mrasfm_engine.io.trajectory_file import Trajectory
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.types import Floats
from schemas import Pose
from schemas.artifacts import MAP_FILE

REMEDY = "Give the folder that `mrasfm aggregate --out` wrote."


@dataclass(frozen=True, kw_only=True)
class MapSeam:
    """An accepted seam."""

    a: str
    b: str
    coarse_a_from_b: Floats  # (4, 4) by positions


@dataclass(frozen=True, kw_only=True)
class MapPoses:
    """The poses of a written map by scene."""

    trajectories: dict[str, Trajectory]  # registered units
    map_from_scene: dict[str, Floats]  # (4, 4) as scenes were put together
    seams: list[MapSeam]
    unconnected: list[str]
    total_units: int
    registered_images: int
    total_images: int


def is_map(folder: Path) -> bool:
    """Return whether a folder holds a map, not a scene."""
    return (folder / MAP_FILE).is_file()


def read_map(folder: Path) -> MapPoses:
    """Read `map.json` and `poses.json` of a map.

    Raises
    ------
    InputError
        Where its files are missing, malformed or contradict each other.
    """
    document, poses = (read_json(folder / name, remedy=REMEDY) for name in (MAP_FILE, "poses.json"))
    try:
        names = [scene["name"] for scene in document["scenes"]]
        units = [unit for unit in poses["units"] if unit["registered"]]
        return MapPoses(
            trajectories={name: _trajectory([u for u in units if u["scene"] == name]) for name in names},
            map_from_scene={scene["name"]: _transform(scene["map_from_scene"]) for scene in document["scenes"]},
            seams=[
                MapSeam(a=seam["a"], b=seam["b"], coarse_a_from_b=_transform(seam["coarse_a_from_b"]))
                for seam in document["seams"]
                if seam["accepted"]
            ],
            unconnected=list(document["unconnected"]),
            total_units=len(poses["units"]),
            registered_images=sum(image["registered"] for image in poses["images"]),
            total_images=len(poses["images"]),
        )
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        raise InputError(f"{folder} is not a map: {error}", remedy=REMEDY) from error


def _transform(rows: Any) -> Floats:
    result = np.array(rows, dtype=np.float64)
    if result.shape != (4, 4) or not np.isfinite(result).all():
        raise ValueError(f"a transform in {MAP_FILE} is not one of four rows of four numbers")
    return result


def _trajectory(units: list[dict[str, Any]]) -> Trajectory:
    poses = [matrix_from_pose(Pose(**unit["world_from_rig"])) for unit in units]
    return Trajectory(
        timestamps_us=np.array([unit["timestamp_us"] for unit in units], dtype=np.int64),
        world_from_rig=np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
    )
