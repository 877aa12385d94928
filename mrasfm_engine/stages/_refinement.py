"""Every mapped component refined to a scene, which the store keeps."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.export.colmap import approximations
from mrasfm_engine.io.packed_scene import pack_scene, unpack_scene
from mrasfm_engine.io.plain_json import plain
from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.mapping import gaps, mapping_report, miscalibration
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.clock_leap import clock_leap_findings
from mrasfm_engine.mapping.implausible_lengths import length_findings
from mrasfm_engine.mapping.impossible_motion import motion_jump_findings
from mrasfm_engine.mapping.keyframes import register_between_keyframes
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.receiver_findings import (
    jump_findings,
    outlier_findings,
    refusal_findings,
    rough_scale_findings,
    rough_shape_findings,
)
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.scene_builder import build_scene
from mrasfm_engine.mapping.unfinished_refinement import unfinished_findings
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.rectified_cameras import rig_with_models
from mrasfm_engine.scene.scene import ImageFeatures, Scene
from mrasfm_engine.stages._mapping import MappedDrive, numbered
from mrasfm_engine.stages._run import Run
from schemas.artifacts import Stage
from schemas.findings import as_json

RefinedComponent = tuple[Scene, dict[str, Any]]  # a component in a frame of its own, and its report
_DOCUMENT = "document"  # all of a scene that is no array, as JSON in UTF-8


@dataclass(frozen=True, kw_only=True)
class _Refined:
    """A refined component."""

    scene: Scene
    findings: list[dict[str, Any]]
    report: dict[str, Any]  # of the stage
    seconds: float

    def to_arrays(self) -> Arrays:
        """Everything but what came from earlier stages, for `from_arrays`."""
        arrays, scene = pack_scene(self.scene)
        models = [camera.model for camera in self.scene.drive.cameras]
        about = {"models": models, "findings": self.findings, "report": self.report, "seconds": self.seconds}
        document = json.dumps({"scene": scene, **about}, default=plain)
        return {**arrays, _DOCUMENT: np.frombuffer(document.encode(), dtype=np.uint8)}

    @staticmethod
    def from_arrays(arrays: Arrays, run: Run, mapped: MappedDrive) -> _Refined:
        """The component whose `to_arrays` these are."""
        document = json.loads(arrays[_DOCUMENT].tobytes())
        rig = rig_with_models(run.drive.manifest.rig, document.pop("models"))
        scene = unpack_scene(
            arrays,
            document.pop("scene"),
            drive=run.drive.with_rig(rig),
            features=mapped.features,
            pairs=mapped.pairs,
            own_cars=run.own_cars,
        )
        return _Refined(scene=scene, **document)


def refinement(run: Run, mapped: MappedDrive, known: PriorTrajectory) -> tuple[Scene, list[RefinedComponent]]:
    """Georeferencing, the final adjustment with all priors, and how certain the result is, of every component.

    Returns
    -------
    scene
        Of the largest component.
    parts
        The others, whose calibration is that of the largest; those that fall apart are findings.
    """

    def work() -> tuple[Arrays, dict[str, Any]]:
        refined = _refined_components(run, mapped, known)
        arrays = {
            f"{number}.{name}": array for number, one in enumerate(refined) for name, array in one.to_arrays().items()
        }
        return arrays, refined[0].report

    arrays, _ = run.stage(Stage.REFINEMENT, None, work)  # which depends on no setting that mapping does not
    numbers = sorted(int(name.partition(".")[0]) for name in arrays if name.endswith(f".{_DOCUMENT}"))
    whole, *others = (_Refined.from_arrays(numbered(arrays, number), run, mapped) for number in numbers)
    run.report["findings"] += whole.findings + [as_json(finding) for finding in approximations(whole.scene)]
    return whole.scene, [_part(run, other, number, whole.scene) for number, other in enumerate(others, start=1)]


def _refined_components(run: Run, mapped: MappedDrive, known: PriorTrajectory) -> list[_Refined]:
    """All components, the largest first."""
    largest, *others = mapped.mappers()
    result = [_refined(run, largest, mapped, known)]
    for mapper in others:
        try:
            result.append(_refined(run, mapper, mapped, known, calibrated=largest))
        except ReconstructionError as problem:
            result[0].findings.append(as_json(gaps.lost(mapper, problem)))
    return result


def _part(run: Run, refined: _Refined, number: int, whole: Scene) -> RefinedComponent:
    """A component besides the largest, `whole`, with its own images alone; and its report."""
    part, stage = refined.scene, run.report["stages"][-1]
    inside = part.unit_registered[part.image_unit]
    part.features = [f if seen else _without_keypoints(f) for f, seen in zip(whole.features, inside, strict=True)]
    part.pairs = [pair for pair in whole.pairs if inside[[pair.image_a, pair.image_b]].all()]
    part.calibration, part.calibration_observability = whole.calibration, whole.calibration_observability
    report: dict[str, Any] = {
        name: run.report[name] for name in ("engine_version", "drive", "settings", "models") if name in run.report
    }
    its_stage = {name: stage[name] for name in ("stage", "reused")} | {"seconds": refined.seconds, **refined.report}
    return part, {**report, "component": number, "findings": refined.findings, "stages": [its_stage]}


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
    run: Run, mapper: Mapper, mapped: MappedDrive, known: PriorTrajectory, *, calibrated: Mapper | None = None
) -> _Refined:
    """A component's scene, findings, and what the report says of it."""
    started_s = time.perf_counter()
    refined = refine(
        mapper,
        AbsolutePriors.from_trajectory(known),
        calibrated=calibrated,
        progress=run.step(Stage.REFINEMENT),
        cancel=run.cancel,
    )
    between = register_between_keyframes(mapper, max_error_px=run.config.mapping.filter_error_px)
    findings = []
    if refined.placement is not None:
        findings += refined.placement.findings
        findings += refusal_findings(refined.placement) + jump_findings(mapper, refined.placement)
        findings += outlier_findings(refined.placement)
    findings += clock_leap_findings(refined.absolute.clock_leap, int(mapper.drive.timestamps_us[0]))
    findings += rough_scale_findings(mapper, refined.scale_of_rough_poses)
    findings += rough_shape_findings(refined.absolute.rough_fault)
    if refined.intrinsics is not None:
        findings += refined.intrinsics.findings(mapper)
    findings += [
        miscalibration.finding(run.drive.cameras[wrong.camera].name, wrong) for wrong in refined.miscalibrations
    ]
    findings += refined.late_cameras
    if refined.wrong_pair is not None:
        names = [camera.name for camera in run.drive.cameras]
        findings.append(miscalibration.pair_finding(names, refined.wrong_pair))
    findings += mapping_report.idle_camera_findings(mapper)
    findings += mapping_report.contradicting_image_findings(mapper)
    findings += mapping_report.motion_findings(mapper) + motion_jump_findings(mapper)
    findings += mapping_report.scale_findings(mapper, refined) + length_findings(mapper, refined)
    findings += unfinished_findings(mapper, refined)
    report = {
        **mapping_report.describe_refinement(mapper, refined),
        **mapping_report.describe_between(mapper, between),
    }
    return _Refined(
        scene=build_scene(mapper, refined, mapped.features, mapped.pairs, known, notes=run.drive.manifest.notes),
        findings=[as_json(finding) for finding in findings],
        report=report,
        seconds=round(time.perf_counter() - started_s, 3),
    )
