"""Cameras as COLMAP has them: for its solvers, and the nearest of its models for a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mrasfm_engine.geometry.camera_model import (
    FISHEYE,
    OMNIDIRECTIONAL,
    largest_angle_rad,
    pack_camera,
    project_points,
    unpack_camera,
    unproject_pixels,
)
from mrasfm_engine.types import Bools, Floats, Ints
from schemas import Camera

# z of a unit ray (81 degrees off axis) below which coordinates in the plane z = 1, in which COLMAP's solvers work,
# explode.
MIN_FORWARD = 0.15
GRID = 33  # pixels across and down an image that a model is fitted to
MIN_SHOWN = 0.02  # of them, that have a ray: fewer determine no model
ITERATIONS = 20


def is_colmaps(model: str) -> bool:
    """True for models of the manifest that COLMAP has too."""
    return model in pycolmap.CameraModelId.__members__


@dataclass(frozen=True, kw_only=True)
class SolverCameras:
    """The cameras of a rig for COLMAP's solvers, which see no farther than their plane z = 1 reaches.

    A camera of a model that COLMAP does not have is an equidistant fisheye of the same focal length, and its pixels are
    those of the same rays: COLMAP's thresholds in pixels keep their meaning.
    """

    cameras: list[pycolmap.Camera]
    kind: Ints  # (c,)
    params: Floats  # (c, PARAMETERS)

    @staticmethod
    def from_cameras(given: Sequence[Camera], kind: Ints, params: Floats) -> SolverCameras:
        """The cameras with intrinsics (c, PARAMETERS)."""
        cameras = []
        for camera, own in zip(given, params, strict=True):
            model, values = camera.model, unpack_camera(camera.model, own)
            if not is_colmaps(model):
                model, values = "OPENCV_FISHEYE", _equidistant(own)
            cameras.append(pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=values))
        return SolverCameras(cameras=cameras, kind=kind, params=params)

    def pixels(self, camera: Ints, xy_px: Floats) -> tuple[Floats, Bools]:
        """Pixels (n, 2) of these cameras for those (n, 2) of the real ones, and which of them the solvers can use."""
        result, usable = xy_px, np.ones(len(xy_px), dtype=np.bool_)
        for c in np.unique(camera).tolist():
            if self.kind[c] not in (FISHEYE, OMNIDIRECTIONAL):
                continue
            rows = np.flatnonzero(camera == c)
            rays = unproject_pixels(int(self.kind[c]), self.params[c], xy_px[rows])
            usable[rows] = rays[:, 2] > MIN_FORWARD
            if self.kind[c] == OMNIDIRECTIONAL:
                result = result.copy() if result is xy_px else result
                result[rows] = project_points(*pack_camera("OPENCV_FISHEYE", _equidistant(self.params[c])), rays)
        return result, usable


@dataclass(frozen=True, kw_only=True)
class NearestModel:
    """A model of COLMAP's with its parameters, and the most that it is off within the image."""

    model: str
    params: Floats
    error_px: float


def nearest_model(camera: Camera, params: Floats) -> NearestModel:
    """COLMAP's model that is nearest to a camera's with parameters as `unpack_camera` gives them.

    It is the camera's own where COLMAP has it, else the fisheye that fits the image best.
    """
    if is_colmaps(camera.model):
        return NearestModel(model=camera.model, params=np.asarray(params, dtype=np.float64), error_px=0.0)
    kind, own = pack_camera(camera.model, params)
    u, v = np.meshgrid(*(np.linspace(0.0, side, GRID) for side in (camera.width, camera.height)))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = unproject_pixels(kind, own, pixels)
    # Corners of an image circle show nothing: their rays are those of the limit, and come back elsewhere.
    shown = rays[:, 2] > np.cos(largest_angle_rad(own)) + 1e-6
    fitted = _equidistant(own)
    if shown.mean() < MIN_SHOWN:
        return NearestModel(model="OPENCV_FISHEYE", params=fitted, error_px=float("inf"))
    pixels, rays = pixels[shown], rays[shown]
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    for _ in range(ITERATIONS):
        step, *_ = np.linalg.lstsq(_derivatives(fitted, rays, theta), (pixels - _fisheye(fitted, rays, theta)).ravel())
        fitted = fitted + step
    off = np.linalg.norm(_fisheye(fitted, rays, theta) - pixels, axis=1)
    return NearestModel(model="OPENCV_FISHEYE", params=fitted, error_px=float(off.max()))


def _equidistant(params: Floats) -> Floats:
    """Parameters (8,) of the fisheye without distortion that has a camera's focal lengths and principal point."""
    return np.array([*params[:4], 0.0, 0.0, 0.0, 0.0])


def _directions(rays: Floats) -> Floats:
    result: Floats = rays[:, :2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)[:, None]
    return result


def _fisheye(params: Floats, rays: Floats, theta: Floats) -> Floats:
    """Pixels (n, 2) of rays with angles (n,) from the axis."""
    result: Floats = params[2:4] + params[:2] * _directions(rays) * _reach(params, theta)[:, None]
    return result


def _reach(params: Floats, theta: Floats) -> Floats:
    result: Floats = theta * (1.0 + sum(params[4 + i] * theta ** (2 * i + 2) for i in range(4)))
    return result


def _derivatives(params: Floats, rays: Floats, theta: Floats) -> Floats:
    """Derivatives (2 n, 8) of `_fisheye` in its parameters."""
    direction, reach = _directions(rays), _reach(params, theta)
    result = np.zeros((len(rays), 2, 8))
    for k in range(2):
        result[:, k, k] = direction[:, k] * reach
        result[:, k, 2 + k] = 1.0
        for i in range(4):
            result[:, k, 4 + i] = params[k] * direction[:, k] * theta ** (2 * i + 3)
    return result.reshape(-1, 8)
