"""Scenes of the mapped components, and their pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.errors import CancelledError, ReconstructionError
from mrasfm_engine.export.colmap import approximations
from mrasfm_engine.export.picture_files import PictureFiles
from mrasfm_engine.freed_memory import return_freed_memory
from mrasfm_engine.mapping import gaps, mapping_report, miscalibration
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import LinkedBy
from mrasfm_engine.mapping.keyframes import register_between_keyframes
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.scene_builder import build_scene
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches, Scene
from mrasfm_engine.scene.unit_components import connected_units
from mrasfm_engine.stages._run import Run
from mrasfm_engine.visualization.pictures import draw_pictures
from schemas.artifacts import Stage
from schemas.findings import as_json


def scene(
    run: Run, mapper: Mapper, found: Sequence[ImageFeatures], pairs: Sequence[PairMatches], known: PriorTrajectory
) -> Scene:
    """Georeferencing, the final adjustment with all priors, and how certain the result is."""
    run.begin(Stage.REFINEMENT)
    result, findings, report = _refined(run, mapper, found, pairs, known)
    return_freed_memory()
    run.report["findings"] += findings + [as_json(finding) for finding in approximations(result)]
    run.report["stages"].append(report)
    run.progress(Stage.REFINEMENT, 1, 1)
    return result


def components(
    run: Run,
    largest: Mapper,
    whole: Scene,
    others: Sequence[Mapper],
    known: PriorTrajectory,
) -> list[tuple[Scene, dict[str, Any]]]:
    """Scenes of the components besides the largest, each with its report; those that fall apart are findings.

    Their calibration is that of the largest, `whole`.
    """
    result: list[tuple[Scene, dict[str, Any]]] = []
    for mapper in others:
        inside = mapper.registered[mapper.image_unit]
        try:
            one, findings, stage = _refined(run, mapper, whole.features, whole.pairs, known, calibrated=largest)
        except ReconstructionError as problem:
            run.report["findings"].append(as_json(gaps.lost(mapper, problem)))
            continue
        header: dict[str, Any] = {
            name: run.report[name] for name in ("engine_version", "drive", "settings", "models") if name in run.report
        }
        one.features = [f if seen else _without_keypoints(f) for f, seen in zip(whole.features, inside, strict=True)]
        one.calibration, one.calibration_observability = whole.calibration, whole.calibration_observability
        one.pairs = [pair for pair in whole.pairs if inside[[pair.image_a, pair.image_b]].all()]
        result.append((one, {**header, "component": len(result) + 1, "findings": findings, "stages": [stage]}))
    return result


def numbered_components(
    run: Run, whole: Scene, others: Sequence[tuple[Scene, dict[str, Any]]]
) -> tuple[Scene, list[tuple[Scene, dict[str, Any]]]]:
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


def _without_keypoints(features: ImageFeatures) -> ImageFeatures:
    """Features of an image that takes no part in a component."""
    scores = None if features.scores is None else features.scores[:0]
    return ImageFeatures(
        xy_px=features.xy_px[:0],
        descriptors=features.descriptors[:0],
        colors=features.colors[:0],
        scores=scores,
        left_out=features.left_out,
    )


def _refined(
    run: Run,
    mapper: Mapper,
    found: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    known: PriorTrajectory,
    *,
    calibrated: Mapper | None = None,
) -> tuple[Scene, list[dict[str, str]], dict[str, Any]]:
    """A component's scene, findings, and what the report says of the stage."""
    started = time.perf_counter()
    refinement = refine(
        mapper,
        AbsolutePriors.from_trajectory(known),
        calibrated=calibrated,
        progress=run.step(Stage.REFINEMENT),
        cancel=run.cancel,
    )
    between = register_between_keyframes(mapper, max_error_px=run.config.mapping.filter_error_px)
    findings = [] if refinement.placement is None else list(refinement.placement.findings)
    if refinement.intrinsics is not None:
        findings += refinement.intrinsics.findings(mapper)
    findings += [
        miscalibration.finding(run.drive.cameras[wrong.camera].name, wrong) for wrong in refinement.miscalibrations
    ]
    findings += refinement.late_cameras
    if refinement.wrong_pair is not None:
        names = [camera.name for camera in run.drive.cameras]
        findings.append(miscalibration.pair_finding(names, refinement.wrong_pair))
    findings += mapping_report.motion_findings(mapper)
    findings += mapping_report.scale_findings(refinement)
    report = {
        "stage": Stage.REFINEMENT,
        "seconds": round(time.perf_counter() - started, 3),
        "reused": False,
        **mapping_report.describe_refinement(mapper, refinement),
        **mapping_report.describe_between(mapper, between),
    }
    result = build_scene(mapper, refinement, found, pairs, known, notes=run.drive.manifest.notes)
    result.own_cars = run.own_cars
    return result, [as_json(finding) for finding in findings], report


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
