"""`calibration.json`: the calibration as given, as refined, and how well the drive observed it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from mrasfm_engine.scene.scene import CalibrationObservability, CameraCalibration, Scene
from mrasfm_engine.types import Floats
from schemas import CAMERA_MODELS, Camera, Pose

OBSERVED, ONLY_PRIOR, HELD = "observed", "only the prior", "held"


def calibration_document(scene: Scene, component: int = 0) -> dict[str, Any]:
    """The calibration by camera: `given`, `refined`, `difference` about and along the rig's axes, sigma, verdict.

    `refined` = `exp(rotation_vector)` times the given rotation, and the given translation plus `translation_m`.
    A direction that is not `observed` holds the prior: its refined value is no finding. Unknown sigmas are absent.
    `repeatability` is the sigma without errors that all images share, as those of lenses: other drives with the same
    intrinsics err by the same. Cameras that were held have none, and those whose intrinsics might vary.
    Where time offsets varied, `refined` has `time_offset_us`: images were taken so much later than their timestamps
    say, each camera's against the mean of all unless positions tell that too. Where intrinsics were asked for,
    `observed` and `verdict` have `focal`: of a focal length that the drive does not observe the given value is held.
    `common` are the motions of all cameras together, of which no direction says anything: `observed` of a camera is
    always among the others. `component` is the scene's number where it is one of a drive's smaller components: they
    take the calibration of the largest, whose observations it rests on.
    """
    cameras = zip(scene.drive.cameras, scene.calibration, strict=True)
    observability = scene.calibration_observability
    return {
        "version": 1,
        **({} if scene.drive.manifest.vehicle is None else {"vehicle": scene.drive.manifest.vehicle}),
        **({"component": component, "from_component": 0} if component else {}),
        **(
            {}
            if observability is None
            else {"adjusted": observability.adjusted, "why": observability.reason, "common": _common(observability)}
        ),
        "axes": "rotation_vector_deg, translation_m, sigmas and observed are about and along the rig's x, y, z",
        "cameras": {camera.name: _camera(camera, refined) for camera, refined in cameras},
    }


def _common(observability: CalibrationObservability) -> dict[str, Any]:
    """Motions of all cameras together: no image observes them, and only positions determine the scale."""
    scale: dict[str, Any] = {"observed": observability.scale_observed}
    if np.isfinite(observability.sigma_scale):
        scale["sigma_relative"] = observability.sigma_scale
    return {
        "rotation": {"observed": [False] * 3, "verdict": [HELD] * 3},
        "translation": {"observed": [False] * 3, "verdict": [HELD] * 3},
        "scale": scale | {"verdict": observability.scale_rests_on},
    }


def document_in_map(document: Mapping[str, Any], found: Mapping[str, tuple[Floats, Floats]]) -> dict[str, Any]:
    """A scene's `calibration.json` after its cameras were adjusted in a map: `refined` and `difference` are the map's.

    They are given by name: poses (4, 4) and COLMAP's parameters.

    `since_scene` is by how much that is another pose than the scene found, and absent where nothing moved; everything
    else is as the scene found it.
    """
    return {**document, "cameras": {k: _camera_in_map(c, *found[k]) for k, c in document["cameras"].items()}}


def _camera_in_map(camera: Mapping[str, Any], rig_from_cam: Floats, params: Floats) -> dict[str, Any]:
    given, found = (matrix_from_pose(Pose(**camera[key]["rig_from_cam"])) for key in ("given", "refined"))
    before = np.array(camera["refined"]["params"])
    if np.array_equal(found, rig_from_cam) and np.array_equal(before, params):
        return dict(camera)
    focal = _focal_places(camera["model"])
    off_px = (float(np.mean((params - np.array(p))[focal])) for p in (camera["given"]["params"], before))
    since_given, since_scene = ({**_difference(p, rig_from_cam), "focal_px": next(off_px)} for p in (given, found))
    refined = {"rig_from_cam": pose_from_matrix(rig_from_cam).model_dump(), "params": params.tolist()}
    return {
        **camera,
        "refined": {**camera["refined"], **refined},
        "difference": {**camera["difference"], **since_given},
        "since_scene": since_scene,
    }


def _focal_places(model: str) -> list[int]:
    return [k for k, name in enumerate(CAMERA_MODELS[model]) if name in ("f", "fx", "fy")]


def _difference(given: Floats, refined: Floats) -> dict[str, Any]:
    rotation = np.degrees(se3.log_so3(refined[:3, :3] @ given[:3, :3].T))
    return {
        "rotation_vector_deg": rotation.tolist(),
        "rotation_deg": float(np.linalg.norm(rotation)),
        "translation_m": (refined[:3, 3] - given[:3, 3]).tolist(),
    }


def verdict_in_words(refined: CameraCalibration) -> list[str]:
    """Source of the value of each of a camera's six directions, in words."""
    return [OBSERVED if observed else ONLY_PRIOR for observed in refined.observed]


def _known(values: Mapping[str, Floats]) -> dict[str, Any]:
    return {name: value.tolist() for name, value in values.items() if np.isfinite(value).all()}


def _camera(camera: Camera, refined: CameraCalibration) -> dict[str, Any]:
    given = matrix_from_pose(camera.rig_from_cam)
    names = CAMERA_MODELS[camera.model]
    focal = _focal_places(camera.model)
    words = verdict_in_words(refined)
    sigma = {
        "rotation_deg": refined.sigma_rotation_deg,
        "translation_m": refined.sigma_translation_m,
        "focal_px": np.array(refined.sigma_focal_px),
    }
    repeatability = {
        "rotation_deg": refined.repeatability_rotation_deg,
        "translation_m": refined.repeatability_translation_m,
    }
    asked: dict[str, dict[str, Any]] = {"refined": {}, "observed": {}, "verdict": {}}
    if refined.focal_observed is not None:
        asked["observed"]["focal"] = refined.focal_observed
        asked["verdict"]["focal"] = OBSERVED if refined.focal_observed else HELD
    if refined.time_offset_s is not None:
        asked["refined"] = {"time_offset_us": 1e6 * refined.time_offset_s}
        asked["observed"]["time_offset"] = refined.time_offset_observed
        asked["verdict"]["time_offset"] = OBSERVED if refined.time_offset_observed else ONLY_PRIOR
        sigma["time_offset_us"] = np.array(1e6 * refined.sigma_time_offset_s)
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "param_names": list(names),
        "given": {"rig_from_cam": camera.rig_from_cam.model_dump(), "params": list(camera.params)},
        "refined": {
            "rig_from_cam": pose_from_matrix(refined.rig_from_cam).model_dump(),
            "params": refined.params.tolist(),
            **asked["refined"],
        },
        "difference": _difference(given, refined.rig_from_cam)
        | {
            "focal_px": float(np.mean([refined.params[k] - camera.params[k] for k in focal])),
        },
        "sigma": _known(sigma),
        "repeatability": _known(repeatability),
        "observed": {"rotation": refined.observed[:3].tolist(), "translation": refined.observed[3:].tolist()}
        | asked["observed"],
        "verdict": {"rotation": words[:3], "translation": words[3:]} | asked["verdict"],
        "wrong": refined.is_wrong,
    }
