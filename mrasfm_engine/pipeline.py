"""The reconstruction: a recorded drive becomes a scene on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine import stages
from mrasfm_engine.compilation import watched_compilation
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError, StorageError
from mrasfm_engine.export.earlier_scene import require_same_drive
from mrasfm_engine.export.picture_files import PictureFiles
from mrasfm_engine.export.publishing import only_run, require_free, scratch_folder
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.io.read_map import is_map
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.submaps import Span, Submap
from mrasfm_engine.types import BringFile, StageProgress
from schemas.artifacts import Stage


def reconstruct(
    drive_folder: Path,
    out: Path,
    config: EngineConfig,
    *,
    progress: StageProgress = lambda stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
    is_new: bool = False,
    content_sha256: Mapping[str, str] | None = None,
    bring: BringFile | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Reconstruct a drive and write the scene into the folder `out`.

    Finished stages are kept in `out/.stages` and not repeated for the same input and settings.

    Parameters
    ----------
    drive_folder
        Holds `drive.json` and the images.
    progress
        Called as progress(stage, done, total): with 0 of 0 when a stage begins and 1 of 1 when it ends, whatever it
        counts between. A stage that is taken from an earlier run only ends.
    cancel
        Asked now and then; where it answers True the run ends with CancelledError.
    is_new
        Whether the folder is a user's, and no drive that was accepted before: see `read_drive`.
    content_sha256
        SHA-256 of the drive's files by name, where the caller knows them: finished stages are found again by the
        contents of their input. Else the files are read for it.
    bring
        For a drive that is larger than the disk: called with the name of an image or mask, in any thread, each time
        before it is read. Without it `drive_folder` holds all of them.
    force
        Whether the scene may replace that of another drive in `out`.

    Returns
    -------
    dict
        What `report.json` says.

    Raises
    ------
    InputError, ReconstructionError, StorageError, CancelledError
        See `errors`.
    """
    if is_map(out):
        raise InputError(
            f"{out} holds a map, which the scene would overwrite",
            remedy="Give the scene a folder of its own with --out.",
            code="not-a-scene",
        )
    require_free(out, result="scene")
    drive = read_drive(drive_folder, is_new=is_new, bring=bring)
    run = stages.Run(drive, config, stages.store_of(out), progress, cancel, content_sha256)
    run.report["drive"] = drive.manifest.name
    run.report["settings"] = config.model_dump(mode="json")
    with only_run(out), watched_compilation() as compiled:
        if not force:
            require_same_drive(out, drive, lambda: run.contents)
        prior, spans = _begun(run)
        # No name for what was mapped: it is most of what stands in memory, and only the refinement needs it.
        scene, components = stages.refinement(run, stages.mapped(run, spans, prior), prior)
        whole, parts = stages.numbered_components(run, *stages.all_units(run, scene, components))
        stages.record_images(run, whole, parts)
        with scratch_folder(out) as scratch:

            def draw() -> PictureFiles:
                pictures = stages.pictures(run, scene, scratch)
                if cancel():
                    raise CancelledError
                run.report["compilation"] = {"functions": compiled.functions, "seconds": round(compiled.seconds, 3)}
                run.begin(Stage.EXPORT)
                return pictures

            write_scene(whole, out, run.report, draw, parts)
    run.progress(Stage.EXPORT, 1, 1)
    return run.report


def plan_submaps(
    drive_folder: Path,
    out: Path,
    config: EngineConfig,
    *,
    workers: int,
    progress: StageProgress = lambda stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
    content_sha256: Mapping[str, str] | None = None,
    bring: BringFile | None = None,
) -> list[Submap]:
    """Check a drive and cut it into sub-maps, which any processes may do by `reconstruct_submap` before `reconstruct`.

    What all of them need to know stays in `out/.stages`, see `PLAN_CHECKPOINTS`.

    Parameters
    ----------
    workers
        Number of processes that a long drive is cut for, at least.

    Returns
    -------
    list of Submap
        None where the drive is one piece.

    Raises
    ------
    InputError, ReconstructionError, StorageError, CancelledError
        As `reconstruct`, whose other parameters these are.
    """
    drive = read_drive(drive_folder, bring=bring)
    run = stages.Run(drive, config, stages.store_of(out), progress, cancel, content_sha256)
    if stages.count_of_submaps(run, workers) == 1:
        return []  # all of this is left to `reconstruct`
    _, spans = _begun(run, workers)
    unit_of = np.arange(len(drive.manifest.frames)) if run.standing is None else np.flatnonzero(run.standing.included)
    return [
        Submap(
            number=span.number,
            first_unit=int(unit_of[span.first]),
            last_unit=int(unit_of[span.last]),
            is_finished=stages.SubmapRun(run, span).is_finished,
        )
        for span in spans
    ]


def reconstruct_submap(
    drive_folder: Path,
    out: Path,
    config: EngineConfig,
    number: int,
    *,
    progress: StageProgress = lambda stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
    content_sha256: Mapping[str, str] | None = None,
    bring: BringFile | None = None,
) -> dict[str, Any]:
    """Extract, match and map one of the sub-maps that `plan_submaps` made; its finished stages stay in `out/.stages`.

    Of the drive's files its own are enough, if the SHA-256 of all are given.

    Returns
    -------
    dict
        What `report.json` will say of it.

    Raises
    ------
    InputError, StorageError, CancelledError
        As `reconstruct`, whose other parameters these are. A sub-map in which nothing can be mapped is no error: its
        units may be those of a tunnel.
    """
    drive = read_drive(drive_folder, bring=bring)
    run = stages.Run(drive, config, stages.store_of(out), progress, cancel, content_sha256, is_planned=True)
    with watched_compilation():
        stages.load_models(run)
        stages.leave_out_standing(run, stages.prior(run))
        span = next((span for span in stages.cut_drive(run) if span.number == number), None)
        if span is None:
            raise StorageError(
                f"the plan of the drive has no sub-map {number}", remedy="Ask for the reconstruction again."
            )
        stages.own_cars(run)
        stages.extraction_sizes(run)
        submap = stages.SubmapRun(run, span)
        submap.do(Stage.MAPPING)
    return submap.report


def _begun(run: stages.Run, workers: int = 1) -> tuple[PriorTrajectory, list[Span]]:
    """Everything before the long work: the prior trajectory of the units that are mapped, and the cut of the drive."""
    stages.load_models(run)
    findings = stages.preflight(run)
    prior = stages.leave_out_standing(run, stages.prior(run))
    was_cut = stages.is_cut(run)
    spans = stages.cut_drive(run, workers)
    if spans:
        stages.keep_preflight(run, findings)
    stages.own_cars(run)
    stages.extraction_sizes(run)
    if not was_cut:  # else the probe came before
        stages.probe(run)
    return prior, spans
