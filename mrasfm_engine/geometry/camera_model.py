"""Projection of the camera models a manifest can name, and its derivatives, as compiled functions.

All six models are one of three kinds with one 8-vector of parameters `[fx, fy, cx, cy, d0, d1, d2, d3]`:

====================================================  ===========  =======================
COLMAP's models                                       kind         d0..d3
====================================================  ===========  =======================
SIMPLE_PINHOLE, PINHOLE                               PERSPECTIVE  0
SIMPLE_RADIAL, RADIAL, OPENCV                         RADIAL       k1, k2, p1, p2
OPENCV_FISHEYE                                        FISHEYE      k1, k2, k3, k4
====================================================  ===========  =======================

With a = x/z, b = y/z a pixel is `(cx + fx * a', cy + fy * b')` where (a', b') is (a, b) distorted. Camera axes are
x right, y down, z forward; the centre of the top left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from mrasfm_engine.types import Floats, Ints
from schemas import Camera

PERSPECTIVE, RADIAL, FISHEYE = 0, 1, 2


def pack_camera(model: str, params: ArrayLike) -> tuple[int, Floats]:
    """Kind and 8-vector of one of COLMAP's models and its parameters in COLMAP's order."""
    p = [float(v) for v in np.asarray(params, dtype=np.float64)]
    if model == "SIMPLE_PINHOLE":
        return PERSPECTIVE, np.array([p[0], p[0], p[1], p[2], 0, 0, 0, 0])
    if model == "PINHOLE":
        return PERSPECTIVE, np.array([*p, 0, 0, 0, 0])
    if model == "SIMPLE_RADIAL":
        return RADIAL, np.array([p[0], p[0], p[1], p[2], p[3], 0, 0, 0])
    if model == "RADIAL":
        return RADIAL, np.array([p[0], p[0], p[1], p[2], p[3], p[4], 0, 0])
    if model == "OPENCV":
        return RADIAL, np.array(p)
    if model == "OPENCV_FISHEYE":
        return FISHEYE, np.array(p)
    raise ValueError(f"unknown camera model {model!r}")


def unpack_camera(model: str, packed: Floats) -> Floats:
    """COLMAP's parameters of an 8-vector: the inverse of `pack_camera`."""
    fx, fy, cx, cy, d0, d1 = packed[:6]
    if model == "SIMPLE_PINHOLE":
        return np.array([fx, cx, cy])
    if model == "PINHOLE":
        return np.array([fx, fy, cx, cy])
    if model == "SIMPLE_RADIAL":
        return np.array([fx, cx, cy, d0])
    if model == "RADIAL":
        return np.array([fx, cx, cy, d0, d1])
    return np.array(packed, dtype=np.float64)


def pack_cameras(cameras: list[Camera]) -> tuple[Ints, Floats]:
    """Kinds (c,) and parameters (c, 8) of the manifest's cameras."""
    packed = [pack_camera(camera.model, camera.params) for camera in cameras]
    return np.array([kind for kind, _ in packed], dtype=np.int64), np.stack([params for _, params in packed])


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def distort(kind: int, k: Any, a: float, b: float, out: Any) -> None:
    """Distorted (a', b') of (a, b) into out[0:2] and d(a', b')/d(a, b), row by row, into out[2:6]."""
    out[0], out[1], out[2], out[3], out[4], out[5] = a, b, 1.0, 0.0, 0.0, 1.0
    if kind == 1:
        k1, k2, p1, p2 = k[4], k[5], k[6], k[7]
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + k2 * r2)
        slope = 2.0 * (k1 + 2.0 * k2 * r2)  # d radial = slope * (a da + b db)
        out[0] = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
        out[1] = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
        out[2] = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        out[3] = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        out[4] = a * b * slope + 2.0 * p2 * b + 2.0 * p1 * a
        out[5] = radial + b * b * slope + 2.0 * p2 * a + 6.0 * p1 * b
    elif kind == 2:
        r2 = a * a + b * b
        r = math.sqrt(r2)
        if r > 1e-8:
            theta = math.atan(r)
            t2 = theta * theta
            poly = 1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))
            dpoly = 1.0 + t2 * (3 * k[4] + t2 * (5 * k[5] + t2 * (7 * k[6] + t2 * 9 * k[7])))
            scale = theta * poly / r
            slope = (dpoly / (1.0 + r2) - scale) / r2  # d scale = slope * (a da + b db)
            out[0], out[1] = a * scale, b * scale
            out[2], out[3] = scale + a * a * slope, a * b * slope
            out[4], out[5] = a * b * slope, scale + b * b * slope


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def project(kind: int, k: Any, x: float, y: float, z: float, work: Any, out: Any) -> None:
    """Pixel of a point in camera axes into out[0:2] and d(pixel)/d(x, y, z), row by row, into out[2:8].

    The caller makes sure that z is positive; `work` is scratch space for 6 floats.
    """
    iz = 1.0 / z
    a, b = x * iz, y * iz
    distort(kind, k, a, b, work)
    fx, fy = k[0], k[1]
    out[0] = k[2] + fx * work[0]
    out[1] = k[3] + fy * work[1]
    out[2] = fx * work[2] * iz
    out[3] = fx * work[3] * iz
    out[4] = -(out[2] * a + out[3] * b)
    out[5] = fy * work[4] * iz
    out[6] = fy * work[5] * iz
    out[7] = -(out[5] * a + out[6] * b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _project_points(kind: int, k: Any, points: Any, pixels: Any) -> None:
    work, out = np.empty(6), np.empty(8)
    for i in range(len(points)):
        if points[i, 2] > 1e-3:
            project(kind, k, points[i, 0], points[i, 1], points[i, 2], work, out)
            pixels[i, 0], pixels[i, 1] = out[0], out[1]
        else:
            pixels[i, 0] = pixels[i, 1] = np.nan


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _unproject_pixels(kind: int, k: Any, pixels: Any, rays: Any) -> None:
    work = np.empty(6)
    for i in range(len(pixels)):
        u, v = (pixels[i, 0] - k[2]) / k[0], (pixels[i, 1] - k[3]) / k[1]
        a, b = u, v
        if kind == 2:
            # The linear start is outside Newton's basin for wide angles: invert the angle's polynomial first.
            rd = math.sqrt(u * u + v * v)
            theta = min(rd, 1.5)
            for _ in range(10):
                t2 = theta * theta
                f = theta * (1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))) - rd
                d = 1.0 + t2 * (3 * k[4] + t2 * (5 * k[5] + t2 * (7 * k[6] + t2 * 9 * k[7])))
                theta = min(max(theta - f / d, 0.0), 1.55)
            if rd > 1e-8:
                a, b = u / rd * math.tan(theta), v / rd * math.tan(theta)
        elif kind == 1:
            for _ in range(20):
                distort(kind, k, a, b, work)
                ea, eb = work[0] - u, work[1] - v
                det = work[2] * work[5] - work[3] * work[4]
                if abs(det) < 1e-6:
                    break
                da = (work[5] * ea - work[3] * eb) / det
                db = (work[2] * eb - work[4] * ea) / det
                a, b = a - da, b - db
                if abs(da) + abs(db) < 1e-12:
                    break
        n = 1.0 / math.sqrt(a * a + b * b + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = a * n, b * n, n


def project_points(kind: int, params: Floats, points_cam_m: ArrayLike) -> Floats:
    """Pixels (n, 2) of points (n, 3) in camera axes; NaN behind the camera."""
    points = np.ascontiguousarray(points_cam_m, dtype=np.float64)
    pixels = np.empty((len(points), 2))
    _project_points(kind, params, points, pixels)
    return pixels


def reprojection_errors_focal(kind: Ints, params: Floats, camera: Ints, points_cam_m: Floats, pixels: Floats) -> Floats:
    """Distances (n,) of pixels (n, 2) from where points (n, 3) are seen, in focal lengths; infinite behind the camera.

    Parameters
    ----------
    kind, params
        Of all cameras (c,) and (c, 8).
    camera
        Which of them (n,) sees each point, given in that camera's axes.
    """
    errors = np.full(len(camera), np.inf)
    for c in np.unique(camera):
        rows = np.flatnonzero(camera == c)
        seen = project_points(int(kind[c]), params[c], points_cam_m[rows])
        errors[rows] = np.linalg.norm(seen - pixels[rows], axis=1) / params[c, :2].mean()
    return np.where(np.isfinite(errors), errors, np.inf)


def unproject_pixels(kind: int, params: Floats, pixels: ArrayLike) -> Floats:
    """Unit viewing rays (n, 3) in camera axes of pixels (n, 2)."""
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    rays = np.empty((len(pixels), 3))
    _unproject_pixels(kind, params, pixels, rays)
    return rays
