"""Stages of a job and the files that scenes and maps consist of: the names that engine, worker and service share."""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any


class Stage(StrEnum):
    """Stages by the names in progress, reports and problems.

    FETCH and PUBLISH are the worker's, which brings the inputs and stores the results; the others are the engine's.
    """

    FETCH = "fetch"
    PREFLIGHT = "preflight"
    CALIBRATION = "calibration"  # the check of its direction, in a job that checks a drive
    FEATURES = "features"
    MATCHES = "matches"
    MAPPING = "mapping"
    REFINEMENT = "refinement"
    SCENES = "scenes"
    ASSOCIATION = "association"
    SEAMS = "seams"
    MULTI_SCENE_ADJUSTMENT = "multi-scene-adjustment"
    MAP_ADJUSTMENT = "map-adjustment"
    PICTURES = "pictures"
    EXPORT = "export"
    PUBLISH = "publish"


# A finished stage is a file of this folder, inside the scene's or map's. A file of that name is complete.
CHECKPOINT_FOLDER = ".stages"
# Seams are too, each by itself.
CHECKPOINTED = frozenset({Stage.FEATURES, Stage.MATCHES, Stage.MAPPING, Stage.REFINEMENT})

REPORT_FILE = "report.json"
IMAGES_SHA256 = "images_sha256"  # in a scene's report: a fingerprint of each camera's registered images
REPORT_PAGE = "report.html"  # the same for people
MAP_FILE = "map.json"
COPC_FILE = "points.copc.laz"
TRAJECTORY_FILE = "trajectory.gpkg"
ROAD_TIFF_FILE = "pictures/road.tif"
VIEW_FILE = "view.json"
RIG_FOLDER = "rig"  # a scene's cameras in other people's formats; of a map: RIGS_FOLDER/SCENE
RIGS_FOLDER = "rigs"
AUTOWARE_FOLDER = "autoware"
PICTURES_FOLDER = "pictures"
OWN_CAR_FOLDER = "own_car"  # CAMERA.png, 255 where a camera shows the vehicle itself
COMPONENTS_FOLDER = "components"  # N/, scenes of the parts of a drive that nothing links to the scene
TEXT_MODEL_FOLDER = "model/text"
SCENES_FOLDER = "scenes"  # of a map: its scenes as an aggregation reads them
SEAMS_FOLDER = "seams"  # of a map: its seams, for the next version
COMPONENT_MARK = "#"  # NAME#N in a map: the component N of NAME; no name that is given to a scene has it
BETWEEN_SCENES = "~"  # no name of a scene has it, and URLs and shells take it as it is


def checkpoint_file(name: str) -> str:
    """Name the file of a finished stage, or of anything else that `StageStore` keeps."""
    return f"{name}.npz"


SUBMAP_STAGES = (Stage.FEATURES, Stage.MATCHES, Stage.MAPPING)  # of one sub-map of a long drive, in their order
# What is done of a long drive before it is cut: names of checkpoints.
PLAN_CHECKPOINTS = ("preflight", "standing", "extraction-size", "own-car", "submaps")


def submap_checkpoint(number: int, stage: str) -> str:
    """Name the checkpoint of a stage of a sub-map, counted from 1."""
    return f"submap-{number}-{stage}"


def submap_number(name: str) -> int | None:
    """Number of the sub-map that a checkpoint, or its file, belongs to; None where it belongs to none."""
    found = re.match(r"submap-(\d+)-", name)
    return None if found is None else int(found[1])


def component_folder(number: int) -> str:
    """Name the folder of a component, counted from 1, inside the scene's."""
    return f"{COMPONENTS_FOLDER}/{number}"


def component_scene(name: str, number: int) -> str:
    """Name a component, counted from 1, as a scene of a map beside the largest one, which has the given name."""
    return f"{name}{COMPONENT_MARK}{number}"


def drive_of_scene(name: str) -> str:
    """Name, in a map, of the largest component of the drive that a scene is a component of."""
    return name.partition(COMPONENT_MARK)[0]


SCALES_CHECKPOINT = "scales"  # of an aggregation: lengths of its scenes without positions


def seam_name(a: str, b: str) -> str:
    """Name the seam of two scenes, as no other two scenes' is named."""
    return f"{a}{BETWEEN_SCENES}{b}"


def seam_checkpoint(a: str, b: str) -> str:
    """Name the checkpoint of a seam."""
    return f"seam-{seam_name(a, b)}"


def scenes_of_seam(file: str) -> tuple[str, str] | None:
    """Names of the scenes whose seam's checkpoint is in a file; None where it is another stage's."""
    found = re.fullmatch(rf"seam-([^{BETWEEN_SCENES}]+){BETWEEN_SCENES}([^{BETWEEN_SCENES}]+)\.npz", file)
    return None if found is None else (found[1], found[2])


def road_not_drawn(report: Mapping[str, Any]) -> str | None:
    """The reason that a scene's report gives for having no picture of its road; None where it gives none."""
    drawn = [stage for stage in report.get("stages", ()) if stage.get("stage") == Stage.PICTURES]
    reasons = (stage.get(picture, {}).get("not_drawn") for stage in drawn for picture in ("road", "birds_eye"))
    return next((str(reason) for reason in reasons if reason), None)


def is_read_by_aggregation(path: str) -> bool:
    """Return whether an aggregation reads this file of a scene."""
    unread = (PICTURES_FOLDER, OWN_CAR_FOLDER, TEXT_MODEL_FOLDER, RIG_FOLDER, AUTOWARE_FOLDER)
    path = re.sub(rf"^{COMPONENTS_FOLDER}/\d+/", "", path)
    return path not in (COPC_FILE, TRAJECTORY_FILE, VIEW_FILE, REPORT_PAGE) and not path.startswith(
        tuple(f"{folder}/" for folder in unread)
    )


def is_read_by_next_version(path: str) -> bool:
    """Return whether an aggregation that goes on from a map's version reads this file of it."""
    return path in (MAP_FILE, REPORT_FILE) or path.startswith((f"{SCENES_FOLDER}/", f"{SEAMS_FOLDER}/"))
