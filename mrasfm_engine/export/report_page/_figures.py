"""Figures that a scene's arrays hold and no document has: residuals over the image, and against the receiver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.geometry import geodesy
from mrasfm_engine.geometry.camera_model import pack_camera, project_points
from mrasfm_engine.io.heights import ellipsoidal_heights
from mrasfm_engine.scene.receiver_as_found import gnss_as_found
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats

CELLS = (6, 10)  # of the picture of a camera's residuals, down and across
MOST_SAMPLES = 600  # that a chart shows
AGREES = 0.02  # relative: of the mean of all residuals here and in the scene


@dataclass(frozen=True, kw_only=True)
class CameraResiduals:
    """Residuals of one camera's observations."""

    name: str
    width: int
    height: int
    observations: int
    rms_px: float
    median_px: float
    grid_px: Floats  # (rows, columns) mean length; NaN where nothing was observed


def camera_residuals(scene: Scene) -> list[CameraResiduals] | None:
    """Residuals by camera; None where images have no single pose, as with a rolling shutter."""
    camera_of = np.array([image.camera for image in scene.drive.images], dtype=np.int64)[scene.observation_image]
    length_px, pixels = np.full(len(camera_of), np.nan), np.zeros((len(camera_of), 2))
    order = np.argsort(scene.observation_image, kind="stable")
    bounds = np.searchsorted(scene.observation_image[order], np.arange(len(scene.drive.images) + 1))
    poses = scene.world_from_cam
    for image in np.flatnonzero(scene.image_registered).tolist():
        rows = order[bounds[image] : bounds[image + 1]]
        pose, camera = poses[image], scene.drive.images[image].camera
        points = (scene.points_m[scene.observation_point[rows]] - pose[:3, 3]) @ pose[:3, :3]
        packed = pack_camera(scene.drive.cameras[camera].model, scene.calibration[camera].params)
        pixels[rows] = scene.features[image].xy_px[scene.observation_keypoint[rows]]
        length_px[rows] = np.linalg.norm(project_points(*packed, points) - pixels[rows], axis=1)
    known = np.isfinite(length_px)
    stated_px = float(scene.point_error_px[scene.observation_point].mean()) if len(camera_of) else 0.0
    if not known.any() or abs(float(length_px[known].mean()) - stated_px) > AGREES * stated_px + 1e-3:
        return None
    return [
        _of_camera(scene, number, length_px[mine], pixels[mine])
        for number in range(len(scene.drive.cameras))
        if (mine := known & (camera_of == number)).any()
    ]


def _of_camera(scene: Scene, number: int, length_px: Floats, pixels: Floats) -> CameraResiduals:
    camera = scene.drive.cameras[number]
    cells = np.array(CELLS)
    row_column = (pixels[:, ::-1] / (camera.height, camera.width) * cells).astype(np.int64).clip(0, cells - 1)
    cell = row_column[:, 0] * CELLS[1] + row_column[:, 1]
    count = np.bincount(cell, minlength=cells.prod())
    with np.errstate(invalid="ignore", divide="ignore"):
        grid = (np.bincount(cell, length_px, minlength=cells.prod()) / count).reshape(CELLS)
    return CameraResiduals(
        name=camera.name,
        width=camera.width,
        height=camera.height,
        observations=len(length_px),
        rms_px=float(np.sqrt(np.mean(length_px**2))),
        median_px=float(np.median(length_px)),
        grid_px=grid,
    )


def gnss_residuals(scene: Scene, found: Mapping[str, Any]) -> tuple[Floats, Floats] | None:
    """Seconds since the first unit (n,), and the receiver's positions less those of the antenna (n, 3), east-north-up.

    With the clock and the antenna as `found`, by the refinement's report. None without a place on the earth or without
    samples between registered units.
    """
    gnss, place = scene.drive.manifest.gnss, scene.georeference
    units = np.flatnonzero(scene.unit_registered)
    if gnss is None or place is None or len(units) < 2:
        return None
    units = units[np.argsort(scene.drive.timestamps_us[units], kind="stable")]
    times_us = scene.drive.timestamps_us[units]
    gnss = gnss_as_found(gnss, found)
    samples = [s for s in gnss.samples if times_us[0] <= s.timestamp_us <= times_us[-1]]
    if not samples:
        return None
    poses = scene.world_from_rig[units]
    antenna = poses[:, :3, :3] @ np.array(gnss.antenna_in_rig_m) + poses[:, :3, 3]
    at_us = np.array([s.timestamp_us for s in samples], dtype=np.float64)
    heights = dict(zip([s.timestamp_us for s in gnss.samples], ellipsoidal_heights(gnss), strict=True))
    geodetic = np.array([(s.latitude_deg, s.longitude_deg, heights[s.timestamp_us]) for s in samples])
    measured = geodesy.local_from_geodetic(geodetic, place.ecef_from_local)
    expected = np.column_stack([np.interp(at_us, times_us, antenna[:, axis]) for axis in range(3)])
    kept = np.unique(np.linspace(0, len(samples) - 1, MOST_SAMPLES).astype(np.int64))
    return (at_us[kept] - times_us[0]) / 1e6, (measured - expected)[kept]
