"""Projection of the camera models a manifest can name, and its derivatives, as compiled functions.

All models are one of five kinds with one vector of `PARAMETERS` numbers, of which the first eight can be adjusted:

==============================  ===============  ==============  =====================
models                          kind             d0..d3          rest after the limit
==============================  ===============  ==============  =====================
SIMPLE_PINHOLE, PINHOLE         PERSPECTIVE      0
SIMPLE_RADIAL, RADIAL, OPENCV   RADIAL           k1, k2, p1, p2
OPENCV_FISHEYE                  FISHEYE          k1, k2, k3, k4
FULL_OPENCV                     RATIONAL         k1, k2, p1, p2  k3, k4, k5, k6
MEI                             OMNIDIRECTIONAL  k1, k2, p1, p2  xi
==============================  ===============  ==============  =====================

The vector is `[fx, fy, cx, cy, d0, d1, d2, d3, limit, ...]`. A pixel is `(cx + fx * a', cy + fy * b')` where (a', b')
is (a, b) distorted: a = x/z, b = y/z, of a fisheye the angle from the axis in the direction of (x, y), and of an
omnidirectional camera a = (1 + xi) x / (z + xi d), b = (1 + xi) y / (z + xi d) with the point's distance d. MEI's own
parameters [Mei and Rives, ICRA 2007] lack the factor 1 + xi, which makes fx and fy pixels per radian at the axis, as
of all other kinds. All models but MEI are COLMAP's. Camera axes are x right, y down, z forward; the centre of the top
left pixel is at (0.5, 0.5).

`limit` is the cosine of the largest angle from the axis that the camera can show. Beyond it the distortion polynomial
folds back, and what lies far outside the view would be projected into the image. No point beyond it is seen.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Floats, Ints
from schemas import Camera

PERSPECTIVE, RADIAL, FISHEYE, RATIONAL, OMNIDIRECTIONAL = range(5)
ADJUSTED, LIMIT, REST = 8, 8, 9  # number of the parameters that can be adjusted; places of the limit and of the others
PARAMETERS = 13
# Rays of a plane's coordinates end before 90 degrees, and those of a sphere's before the point behind the camera.
WIDEST_RAD = {
    PERSPECTIVE: math.radians(89.5),
    RADIAL: math.radians(89.5),
    RATIONAL: math.radians(89.5),
    FISHEYE: math.radians(179.0),
    OMNIDIRECTIONAL: math.radians(179.0),
}
ANGLES, DIRECTIONS = 1024, 8  # that are tried for the limit


def pack_camera(model: str, params: ArrayLike) -> tuple[int, Floats]:
    """Kind and vector (PARAMETERS,) of a model of the manifest and its parameters in COLMAP's order."""
    p = [float(v) for v in np.asarray(params, dtype=np.float64)]
    if model == "SIMPLE_PINHOLE":
        return packed(PERSPECTIVE, [p[0], *p])
    if model == "PINHOLE":
        return packed(PERSPECTIVE, p)
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return packed(RADIAL, [p[0], *p])
    if model == "OPENCV":
        return packed(RADIAL, p)
    if model == "OPENCV_FISHEYE":
        return packed(FISHEYE, p)
    if model == "FULL_OPENCV":
        return packed(RATIONAL, p[:8], p[8:])
    if model == "MEI":
        return packed(OMNIDIRECTIONAL, np.array(p[:8]) / _mei_scales(p[8]), p[8:])
    raise ValueError(f"unknown camera model {model!r}")


def packed(kind: int, adjusted: ArrayLike, rest: ArrayLike = ()) -> tuple[int, Floats]:
    """Kind and vector (PARAMETERS,) of parameters that can be adjusted (up to 8,) and those that cannot, with the
    limit."""
    result = np.zeros(PARAMETERS)
    adjusted, rest = np.asarray(adjusted, dtype=np.float64), np.asarray(rest, dtype=np.float64)
    result[: len(adjusted)], result[REST : REST + len(rest)] = adjusted, rest
    return kind, with_limit(kind, result)


def with_limit(kind: int, params: Floats) -> Floats:
    """The vector (PARAMETERS,) with the limit that its other parameters have."""
    result = np.array(params, dtype=np.float64)
    result[LIMIT] = -1.0
    result[LIMIT] = _cosine_of_limit(kind, result.tobytes())
    return result


@lru_cache(maxsize=256)
def _cosine_of_limit(kind: int, params: bytes) -> float:
    """Cosine of the largest angle of a vector without limit: it takes a millisecond, and a drive has few cameras."""
    return math.cos(_largest_angle(kind, np.frombuffer(params).copy(), WIDEST_RAD[kind]))


def unpack_camera(model: str, params: Floats) -> Floats:
    """COLMAP's parameters of a vector (PARAMETERS,): the inverse of `pack_camera`."""
    fx, fy, cx, cy, d0, d1 = params[:6]
    if model == "SIMPLE_PINHOLE":
        return np.array([fx, cx, cy])
    if model == "PINHOLE":
        return np.array([fx, fy, cx, cy])
    if model == "SIMPLE_RADIAL":
        return np.array([fx, cx, cy, d0])
    if model == "RADIAL":
        return np.array([fx, cx, cy, d0, d1])
    if model == "MEI":
        return np.array([*(params[:ADJUSTED] * _mei_scales(params[REST])), params[REST]])
    return np.concatenate([params[:ADJUSTED], params[REST : REST + (4 if model == "FULL_OPENCV" else 0)]])


def _mei_scales(xi: float) -> Floats:
    """Factors (8,) from the vector's parameters to MEI's."""
    s = 1.0 + xi
    return np.array([s, s, 1.0, 1.0, s**2, s**4, s, s])


def pack_cameras(cameras: list[Camera]) -> tuple[Ints, Floats]:
    """Kinds (c,) and parameters (c, PARAMETERS) of the manifest's cameras."""
    both = [pack_camera(camera.model, camera.params) for camera in cameras]
    return np.array([kind for kind, _ in both], dtype=np.int64), np.stack([params for _, params in both])


def manifest_scales(kind: int, params: Floats) -> Floats:
    """Factors (8,) from a vector's parameters that can be adjusted to those of the manifest."""
    return _mei_scales(float(params[REST])) if kind == OMNIDIRECTIONAL else np.ones(ADJUSTED)


def largest_angle_rad(params: Floats) -> float:
    """Largest angle from the axis that a camera with a vector (PARAMETERS,) can show."""
    return math.acos(float(params[LIMIT]))


@uncounted(forceinline=True)
def distort(kind: int, k: Any, a: float, b: float, out: Any) -> None:
    """Distorted (a', b') of (a, b) into out[0:2] and d(a', b')/d(a, b), row by row, into out[2:6]; of no fisheye."""
    out[0], out[1], out[2], out[3], out[4], out[5] = a, b, 1.0, 0.0, 0.0, 1.0
    if kind != 0:
        k1, k2, p1, p2 = k[4], k[5], k[6], k[7]
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + k2 * r2)
        slope = 2.0 * (k1 + 2.0 * k2 * r2)  # d radial = slope * (a da + b db)
        if kind == 3:
            k3, k4, k5, k6 = k[9], k[10], k[11], k[12]
            radial += k3 * r2 * r2 * r2
            slope += 6.0 * k3 * r2 * r2
            below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial /= below
            slope = (slope - radial * 2.0 * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / below
        out[0] = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
        out[1] = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
        out[2] = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        out[3] = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        out[4] = a * b * slope + 2.0 * p2 * b + 2.0 * p1 * a
        out[5] = radial + b * b * slope + 2.0 * p2 * a + 6.0 * p1 * b


@uncounted(forceinline=True)
def inverse_depth(kind: int, k: Any, z: float, d2: float) -> float:
    """Factor from x and y to (a, b) of a point at a squared distance d2; of no fisheye."""
    if kind == 4:
        return float((1.0 + k[9]) / (z + k[9] * math.sqrt(d2)))
    return 1.0 / z


@uncounted(forceinline=True)
def project(kind: int, k: Any, x: float, y: float, z: float, work: Any, out: Any) -> bool:
    """Pixel of a point in camera axes into out[0:2] and d(pixel)/d(x, y, z), row by row, into out[2:8].

    False where the camera does not show the point, in or beside the image: behind the camera, or beyond the limit.
    `work` is scratch space for 6 floats.
    """
    d2 = x * x + y * y + z * z
    if not z > k[8] * math.sqrt(d2):
        return False
    fx, fy = k[0], k[1]
    if kind == 2:
        r2 = x * x + y * y
        along = z / d2
        if r2 > 1e-14 * d2:
            r = math.sqrt(r2)
            theta = math.atan2(r, z)
            t2 = theta * theta
            poly = 1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))
            dpoly = 1.0 + t2 * (3 * k[4] + t2 * (5 * k[5] + t2 * (7 * k[6] + t2 * 9 * k[7])))
            scale = theta * poly / r
            slope = (dpoly * along - scale) / r2  # d scale = slope * (x dx + y dy) - dpoly / d2 dz
            sink = -dpoly / d2
        else:
            scale, slope, sink = along, 0.0, -1.0 / d2
        out[0] = k[2] + fx * x * scale
        out[1] = k[3] + fy * y * scale
        out[2] = fx * (scale + x * x * slope)
        out[3] = fx * x * y * slope
        out[4] = fx * x * sink
        out[5] = fy * x * y * slope
        out[6] = fy * (scale + y * y * slope)
        out[7] = fy * y * sink
        return True
    iz = inverse_depth(kind, k, z, d2)
    a, b = x * iz, y * iz
    distort(kind, k, a, b, work)
    out[0] = k[2] + fx * work[0]
    out[1] = k[3] + fy * work[1]
    out[2] = fx * work[2] * iz
    out[3] = fx * work[3] * iz
    out[4] = -(out[2] * a + out[3] * b)
    out[5] = fy * work[4] * iz
    out[6] = fy * work[5] * iz
    out[7] = -(out[5] * a + out[6] * b)
    if kind == 4:
        # Of z + xi d the derivatives are xi x / d, xi y / d, 1 + xi z / d.
        share = k[9] / math.sqrt(d2)
        du, dv = out[4] / (1.0 + k[9]), out[7] / (1.0 + k[9])
        out[4], out[7] = du, dv
        out[2] += du * share * x
        out[3] += du * share * y
        out[4] += du * share * z
        out[5] += dv * share * x
        out[6] += dv * share * y
        out[7] += dv * share * z
    return True


@njit(cache=True, nogil=True)
def _largest_angle(kind: int, k: Any, widest: float) -> float:
    """Largest angle from the axis, up to the widest, within which pixels move outwards with it in all directions."""
    return _outwards_to(kind, k, widest, np.empty(6), np.empty(8))  # type: ignore[no-any-return]


@uncounted()
def _outwards_to(kind: int, k: Any, widest: float, work: Any, out: Any) -> float:
    for i in range(1, ANGLES + 1):
        theta = widest * i / ANGLES
        z, r = math.cos(theta), math.sin(theta)
        for j in range(DIRECTIONS):
            c, s = math.cos(2.0 * math.pi * j / DIRECTIONS), math.sin(2.0 * math.pi * j / DIRECTIONS)
            if not project(kind, k, r * c, r * s, z, work, out):
                return widest * (i - 1) / ANGLES
            # A turn by the angle moves the point by (z c, z s, -r), one around the axis by (-s, c, 0).
            u, v = (
                (out[2] * z * c + out[3] * z * s - out[4] * r) / k[0],
                (out[5] * z * c + out[6] * z * s - out[7] * r) / k[1],
            )
            across_u, across_v = (-out[2] * s + out[3] * c) / k[0], (-out[5] * s + out[6] * c) / k[1]
            du, dv = (out[0] - k[2]) / k[0], (out[1] - k[3]) / k[1]
            outwards = du * c + dv * s > 0.0 and du * u + dv * v > 0.0
            if not (outwards and u * across_v - v * across_u > 0.0):
                return widest * (i - 1) / ANGLES
    return widest


@njit(cache=True, nogil=True)
def _project_points(kind: int, k: Any, points: Any, pixels: Any) -> None:
    _project_each(kind, k, points, np.empty(6), np.empty(8), pixels)


@uncounted()
def _project_each(kind: int, k: Any, points: Any, work: Any, out: Any, pixels: Any) -> None:
    for i in range(len(points)):
        if project(kind, k, points[i, 0], points[i, 1], points[i, 2], work, out):
            pixels[i, 0], pixels[i, 1] = out[0], out[1]
        else:
            pixels[i, 0] = pixels[i, 1] = np.nan


@njit(cache=True, nogil=True)
def _unproject_pixels(kind: int, k: Any, pixels: Any, rays: Any) -> None:
    _unproject_each(kind, k, pixels, np.empty(6), np.empty(8), rays)


@uncounted()
def _unproject_each(kind: int, k: Any, pixels: Any, work: Any, out: Any, rays: Any) -> None:
    """Newton's steps along the direction of the pixel from the axis, between bounds, and then, where lenses are not
    centred, in both coordinates."""
    widest = math.acos(k[8])
    for i in range(len(pixels)):
        u, v = (pixels[i, 0] - k[2]) / k[0], (pixels[i, 1] - k[3]) / k[1]
        wanted = math.sqrt(u * u + v * v)
        if kind == 0:
            n = 1.0 / math.sqrt(1.0 + wanted * wanted)
            rays[i, 0], rays[i, 1], rays[i, 2] = u * n, v * n, n
            continue
        c, s = (u / wanted, v / wanted) if wanted > 1e-12 else (1.0, 0.0)
        low, high, converged = 0.0, widest, False
        theta = min(math.atan(wanted), 0.5 * widest)
        for _ in range(60):
            z, r = math.cos(theta), math.sin(theta)
            if not project(kind, k, r * c, r * s, z, work, out):
                high = theta
                theta = 0.5 * (low + high)
                continue
            reached = (out[0] - k[2]) / k[0] * c + (out[1] - k[3]) / k[1] * s
            slope = ((out[2] * c + out[3] * s) * z - out[4] * r) / k[0] * c + (
                (out[5] * c + out[6] * s) * z - out[7] * r
            ) / k[1] * s
            if reached > wanted:
                high = theta
            else:
                low = theta
            step = (reached - wanted) / slope if slope > 0.0 else 4.0
            converged = abs(reached - wanted) < 1e-9 * (1.0 + wanted)
            if abs(step) < 1e-14 or high - low < 1e-15:
                break
            theta = theta - step if low < theta - step < high else 0.5 * (low + high)
        x, y, z = math.sin(theta) * c, math.sin(theta) * s, math.cos(theta)
        if converged and kind != 2 and (k[6] != 0.0 or k[7] != 0.0):  # else it is beyond the limit, and stays there
            kept_x, kept_y, kept_z = x, y, z
            for _ in range(10):
                if not project(kind, k, x, y, z, work, out):
                    x, y, z = kept_x, kept_y, kept_z
                    break
                kept_x, kept_y, kept_z = x, y, z
                eu, ev = pixels[i, 0] - out[0], pixels[i, 1] - out[1]
                # Steps of two angles: away from the axis, and around it.
                r = math.sqrt(x * x + y * y)
                c, s = (x / r, y / r) if r > 1e-12 else (1.0, 0.0)
                a0, a1 = out[2] * z * c + out[3] * z * s - out[4] * r, -out[2] * s + out[3] * c
                b0, b1 = out[5] * z * c + out[6] * z * s - out[7] * r, -out[5] * s + out[6] * c
                det = a0 * b1 - a1 * b0
                if not abs(det) > 1e-9 * k[0] * k[1]:
                    break
                away, around = (b1 * eu - a1 * ev) / det, (a0 * ev - b0 * eu) / det
                if abs(away) + abs(around) > 0.2:
                    break
                x, y, z = x + z * c * away - s * around, y + z * s * away + c * around, z - r * away
                n = 1.0 / math.sqrt(x * x + y * y + z * z)
                x, y, z = x * n, y * n, z * n
                if abs(away) + abs(around) < 1e-13:
                    break
        rays[i, 0], rays[i, 1], rays[i, 2] = x, y, z


def project_points(kind: int, params: Floats, points_cam_m: ArrayLike) -> Floats:
    """Pixels (n, 2) of points (n, 3) in camera axes; NaN where the camera does not show them."""
    points = np.ascontiguousarray(points_cam_m, dtype=np.float64)
    pixels = np.empty((len(points), 2))
    _project_points(kind, _checked(params), points, pixels)
    return pixels


def _checked(params: Floats) -> Floats:
    if len(params) != PARAMETERS:
        raise ValueError(f"{len(params)} parameters instead of {PARAMETERS}: see `packed`")
    return params


def reprojection_errors_focal(kind: Ints, params: Floats, camera: Ints, points_cam_m: Floats, pixels: Floats) -> Floats:
    """Distances (n,) of pixels (n, 2) from where points (n, 3) are seen, in focal lengths; infinite if they are not.

    Parameters
    ----------
    kind, params
        Of all cameras (c,) and (c, PARAMETERS).
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
    """Unit viewing rays (n, 3) in camera axes of pixels (n, 2); pixels beyond the limit have rays at the limit."""
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    rays = np.empty((len(pixels), 3))
    _unproject_pixels(kind, _checked(params), pixels, rays)
    return rays
