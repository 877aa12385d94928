"""Lens models that do not fit their image: without rays for parts of it, of another size, with an axis at its edge."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry.camera_model import largest_angle_rad, pack_camera, project_points, unproject_pixels
from mrasfm_engine.types import Floats
from schemas import Camera, DriveManifest
from schemas.drive import CAMERA_MODELS
from schemas.findings import Finding, error, warning

GRID = 65  # pixels across and down an image that are looked at
COMES_BACK_PX = 0.01
USELESS_SHARE = 0.9  # of an image without rays: what is left is the calibration of another camera, or none
EDGE = 0.1  # of the image's side: no sensor is mounted so far beside its lens, and images are seldom cut so far
OTHER_SIZE = 1.2  # times the image's size, along both axes: no lens stands so far off the middle of its sensor
SAME_FACTOR = 1.1  # of both axes: a cut changes them differently, but for one that leaves a corner
FULL_CIRCLE_RAD = np.radians(90.0)  # lenses that reach farther show an image circle: its corners are dark


def lens_findings(manifest: DriveManifest) -> list[Finding]:
    """Find the cameras whose lens model does not fit their image."""
    return [*_folding(manifest), *_off_center(manifest)]


def _folding(manifest: DriveManifest) -> list[Finding]:
    """Find the cameras whose distortion folds back inside the image: no ray leads to the pixels beyond."""
    found = []
    for camera in manifest.rig.cameras:
        share, angle_rad = share_without_ray(camera)
        if share > 0.0 and angle_rad < FULL_CIRCLE_RAD:
            found.append(
                (error if share > USELESS_SHARE else warning)(
                    "lens-folds",
                    f"rig.cameras: the distortion of camera {camera.name} folds back {np.degrees(angle_rad):.0f} deg "
                    f"off its axis, and its image reaches farther: {share:.0%} of the pixels have no ray, and what is "
                    "seen there takes no part",
                    "Check the order and signs of params; calibrate with views that reach the image's corners, or "
                    "with a model for wide lenses.",
                )
            )
    return found


def _off_center(manifest: DriveManifest) -> list[Finding]:
    """Find the cameras whose principal point is that of an image of another size, or near an edge of the image."""
    found = []
    for camera in manifest.rig.cameras:
        values = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
        at = np.array([values["cx"] / camera.width, values["cy"] / camera.height])
        factor = _factor_of_size(at)
        if factor is not None:
            found.append(
                warning(
                    "principal-point",
                    f"rig.cameras: the principal point of camera {camera.name} is ({values['cx']:g}, "
                    f"{values['cy']:g}), as in an image {factor:.2g} times the size of its image of "
                    f"{camera.width}x{camera.height} pixels",
                    "Give params in pixels of the images as they are: those of a reduced image are reduced with it. "
                    "Only images that are cut out of larger ones keep the focal lengths.",
                )
            )
        elif (np.abs(at - 0.5) > 0.5 - EDGE).any():
            found.append(
                warning(
                    "principal-point",
                    f"rig.cameras: the principal point of camera {camera.name} is ({values['cx']:g}, "
                    f"{values['cy']:g}), at the edge of its image of {camera.width}x{camera.height} pixels",
                    "Check the order and the size of params: cx and cy are about half of width and height, except in "
                    "images that are cut out of larger ones.",
                )
            )
    return found


def _factor_of_size(at: Floats) -> float | None:
    """Factor on the image's size that puts a principal point (2,), in widths and heights, into the middle.

    None where it is there already, or the two axes disagree.
    """
    if (at <= 0.0).any():
        return None
    logs = np.log(2.0 * at)
    other = np.ptp(logs) < np.log(SAME_FACTOR) and np.abs(logs).min() > np.log(OTHER_SIZE)
    return float(np.exp(logs.mean())) if other else None


def share_without_ray(camera: Camera) -> tuple[float, float]:
    """Share of a camera's pixels to which no ray leads, and the largest angle in rad that its model can show."""
    kind, params = pack_camera(camera.model, camera.params)
    u, v = np.meshgrid(*(np.linspace(0.5, side - 0.5, GRID) for side in (camera.width, camera.height)))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    # Rays at the very limit project to nowhere by rounding alone.
    back = project_points(kind, params, unproject_pixels(kind, params, pixels))
    comes_back = np.linalg.norm(back - pixels, axis=1) < COMES_BACK_PX
    return float(1.0 - comes_back.mean()), largest_angle_rad(params)
