"""COLMAP's camera models as the renderer needs them: from pixels to rays and back.

Ideal coordinates are (x / z, y / z) in the camera. The centre of the top left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.errors import InputError
from mrasfm_engine.types import Floats


def _distort_opencv(xy: Floats, k: Floats) -> Floats:
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2 * r2
    return np.stack(
        [
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * radial + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y),
        ],
        -1,
    )


def _theta_distorted(theta: Floats, k: Floats) -> Floats:
    t2 = theta * theta
    result: Floats = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    return result


def project(model: str, params: ArrayLike, points_cam: ArrayLike) -> Floats:
    """Pixels (..., 2) of points (..., 3) in the camera's frame; nan for points behind it.

    Sources: COLMAP's src/colmap/sensor/models.h, of which PINHOLE, OPENCV and OPENCV_FISHEYE are known here.
    """
    p, points = np.asarray(params, dtype=np.float64), np.asarray(points_cam, dtype=np.float64)
    z = points[..., 2:]
    ideal = points[..., :2] / np.where(z > 0, z, np.nan)
    if model == "OPENCV":
        ideal = _distort_opencv(ideal, p[4:])
    elif model == "OPENCV_FISHEYE":
        r = np.linalg.norm(ideal, axis=-1, keepdims=True)
        scale = _theta_distorted(np.arctan(r), p[4:]) / np.where(r > 1e-12, r, 1.0)
        ideal = ideal * np.where(r > 1e-12, scale, 1.0)
    elif model != "PINHOLE":
        raise InputError(f"camera model {model!r} cannot be rendered", remedy="Use PINHOLE, OPENCV or OPENCV_FISHEYE.")
    result: Floats = ideal * p[:2] + p[2:4]
    return result


def unproject(model: str, params: ArrayLike, xy_px: ArrayLike) -> Floats:
    """Ideal coordinates (..., 2) of pixels (..., 2), to the last digits: Newton's method inverts the distortion."""
    p = np.asarray(params, dtype=np.float64)
    distorted: Floats = (np.asarray(xy_px, dtype=np.float64) - p[2:4]) / p[:2]
    if model == "PINHOLE":
        return distorted
    if model == "OPENCV_FISHEYE":
        target = np.linalg.norm(distorted, axis=-1)
        theta = target.copy()
        k = p[4:]
        for _ in range(12):
            t2 = theta * theta
            slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
            theta -= (_theta_distorted(theta, k) - target) / slope
        scale = np.tan(theta) / np.where(target > 1e-12, target, 1.0)
        fisheye: Floats = distorted * np.where(target > 1e-12, scale, 1.0)[..., None]
        return fisheye
    ideal = distorted.copy()
    step = 1e-6
    dx, dy = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(8):
        error = _distort_opencv(ideal, p[4:]) - distorted
        jx = (_distort_opencv(ideal + dx, p[4:]) - _distort_opencv(ideal - dx, p[4:])) / (2 * step)
        jy = (_distort_opencv(ideal + dy, p[4:]) - _distort_opencv(ideal - dy, p[4:])) / (2 * step)
        det = jx[..., 0] * jy[..., 1] - jx[..., 1] * jy[..., 0]
        ideal[..., 0] -= (error[..., 0] * jy[..., 1] - error[..., 1] * jy[..., 0]) / det
        ideal[..., 1] -= (error[..., 1] * jx[..., 0] - error[..., 0] * jx[..., 1]) / det
    return ideal


def ideal_map(model: str, params: ArrayLike, *, width: int, height: int, samples: int = 1) -> Floats:
    """Ideal coordinates (height * samples, width * samples, 2) of a grid of sample centres in every pixel."""
    x = (np.arange(width * samples) + 0.5) / samples
    y = (np.arange(height * samples) + 0.5) / samples
    return unproject(model, params, np.stack(np.meshgrid(x, y), -1))
