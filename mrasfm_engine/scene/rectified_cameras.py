"""Pinhole cameras in whose images some distortion is left.

A rectified image is as free of distortion as the calibration was right that it was rectified with [Cvišić, Marković,
Petrović: Recalibrating the KITTI dataset camera setup for improved odometry accuracy, ECMR 2021]. Where intrinsics vary
and distortion may not, it bends scenes of drives that turn, and passes for focal lengths that are off by per cents.
"""

from __future__ import annotations

from schemas.drive import CAMERA_MODELS, Camera, Rig

_MODELS = {"SIMPLE_PINHOLE": "OPENCV", "PINHOLE": "OPENCV"}


def model_with_distortion(model: str) -> str:
    """The model that a camera has whose distortion varies: its own if that has terms for it."""
    return _MODELS.get(model, model)


def rig_with_models(rig: Rig, models: list[str]) -> Rig:
    """The rig whose cameras have models (c,) by `model_with_distortion`, without distortion so far, or their own."""
    cameras = [_with_model(camera, model) for camera, model in zip(rig.cameras, models, strict=True)]
    return rig.model_copy(update={"cameras": cameras})


def _with_model(camera: Camera, model: str) -> Camera:
    if model == camera.model:
        return camera
    *focal_px, cx, cy = camera.params
    params = [focal_px[0], focal_px[-1], cx, cy]
    params += [0.0] * (len(CAMERA_MODELS[model]) - len(params))
    return camera.model_copy(update={"model": model, "params": params})
