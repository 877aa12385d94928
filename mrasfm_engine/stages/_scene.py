"""Numbers of a scene's components, and pictures of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import CancelledError
from mrasfm_engine.export.picture_files import PictureFiles
from mrasfm_engine.freed_memory import return_freed_memory
from mrasfm_engine.io.stage_store import fingerprints_of_images
from mrasfm_engine.mapping.components import LinkedBy
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.unit_components import connected_units
from mrasfm_engine.stages._refinement import RefinedComponent
from mrasfm_engine.stages._run import Run
from mrasfm_engine.visualization.pictures import draw_pictures
from schemas.artifacts import IMAGES_SHA256, Stage


def numbered_components(
    run: Run, whole: Scene, others: Sequence[RefinedComponent]
) -> tuple[Scene, list[RefinedComponent]]:
    """The scenes with the number of every unit's component.

    Those in frames of their own have the numbers of their folders; those that positions or rough poses alone put into
    the largest one's frame have the next ones.
    """
    mapped = next(stage for stage in run.report["stages"] if stage["stage"] == Stage.MAPPING)["components"]
    if any(link["by"] != LinkedBy.IMAGES for link in mapped[0]["links"]):
        whole = replace(whole, unit_component=connected_units(whole, next_number=len(others) + 1))
    numbered = [
        (replace(other, unit_component=np.where(other.unit_registered, report["component"], 0)), report)
        for other, report in others
    ]
    return whole, numbered


def record_images(run: Run, whole: Scene, others: Sequence[RefinedComponent]) -> None:
    """Put what the scenes' images are into their reports, so that an export can tell the drive from another one."""
    for scene, report in [(whole, run.report), *others]:
        report[IMAGES_SHA256] = fingerprints_of_images(scene, run.contents)


def pictures(run: Run, result: Scene, scratch: Path) -> PictureFiles:
    """The pictures of a scene as files by name, large ones in the folder `scratch`; see `draw_pictures`."""
    if not run.config.output.pictures:
        return {}

    def step(done: int, total: int) -> None:
        if run.cancel():
            raise CancelledError
        run.progress(Stage.PICTURES, done, total)

    started = time.perf_counter()
    run.begin(Stage.PICTURES)
    files, report = draw_pictures(result, scratch=scratch, seed=run.config.seed, progress=step)
    return_freed_memory()
    seconds = round(time.perf_counter() - started, 3)
    run.report["stages"].append({"stage": Stage.PICTURES, "seconds": seconds, "reused": False, **report})
    run.progress(Stage.PICTURES, 1, 1)
    return files
