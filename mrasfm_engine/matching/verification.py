"""Geometric verification of matches by the essential matrix."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.colmap_cameras import MIN_FORWARD
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Floats

# z of unit rays 60 and 75 degrees off the axis: beyond, an error counts over 4 and 15 times in the plane z = 1.
WIDE, VERY_WIDE = 0.5, 0.26
REFINEMENTS = 3
CONFIDENCE = 0.9999
MIN_RANSAC_MATCHES = 8
MIN_NORMAL = 1e-12  # length of what has no direction


@dataclass(frozen=True, kw_only=True)
class EssentialFit:
    """An essential matrix that matches agree with.

    Attributes
    ----------
    inliers
        Those (n,) that do.
    essential
        (3, 3), for unit rays b' E a = 0; None where there is none.
    """

    inliers: Bools
    essential: Floats | None


def essential_inliers(rays_a: Floats, rays_b: Floats, *, max_error: float) -> Bools:
    """Return which matches (n,) agree with one essential matrix, see `fit_essential`."""
    return fit_essential(rays_a, rays_b, max_error=max_error).inliers


def fit_essential(rays_a: Floats, rays_b: Floats, *, max_error: float) -> EssentialFit:
    """The essential matrix that most matches (n,) agree with, found by RANSAC.

    Views of less than 150 degrees are judged in the plane z = 1. There an error at the rim of a wider view is tens of
    times what it is at its centre: RANSAC works in planes turned towards the matches, and then all rays are judged by
    their angles.

    Parameters
    ----------
    rays_a, rays_b
        Unit viewing rays (n, 3) in camera axes.
    max_error
        Distance from the epipolar line in the plane z = 1 (pixels over focal length), of wide views in radians.
    """
    if len(rays_a) and min(rays_a[:, 2].min(), rays_b[:, 2].min()) < VERY_WIDE:
        return _wide_inliers(rays_a, rays_b, max_error)
    inliers, essential = _plane_inliers(rays_a, rays_b, max_error)
    return EssentialFit(inliers=inliers, essential=essential)


def relative_pose(
    rays_a: Floats, rays_b: Floats, *, max_error: float, confidence: float = CONFIDENCE
) -> tuple[Floats, Floats] | None:
    """Rotation b_from_a (3, 3) and direction (3,) of the translation that most matches agree with, found by RANSAC.

    None where there are too few in the plane z = 1, in which they are judged.
    """
    inliers, essential = _plane_inliers(rays_a, rays_b, max_error, confidence)
    if essential is None or not inliers.any():
        return None
    a, b = (rays[inliers, :2] / rays[inliers, 2:] for rays in (rays_a, rays_b))
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, np.eye(3))
    return np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64).ravel()


def direction_of_motion(pose: tuple[Floats, Floats]) -> Floats:
    """Direction (3,) from camera a to camera b, in the axes of a, of a rotation and translation b_from_a."""
    rotation, translation = pose
    result: Floats = -(rotation.T @ translation)
    return result


def _plane_inliers(
    rays_a: Floats, rays_b: Floats, max_error: float, confidence: float = CONFIDENCE
) -> tuple[Bools, Floats | None]:
    """Inliers (n,) by their distances in the plane z = 1, and the essential matrix if there is one."""
    inliers = np.zeros(len(rays_a), dtype=np.bool_)
    usable = np.flatnonzero((rays_a[:, 2] > MIN_FORWARD) & (rays_b[:, 2] > MIN_FORWARD))
    if len(usable) < MIN_RANSAC_MATCHES:
        return inliers, None
    a, b = rays_a[usable, :2] / rays_a[usable, 2:], rays_b[usable, :2] / rays_b[usable, 2:]
    essential, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_ACCURATE, confidence, max_error)
    if essential is None or essential.shape != (3, 3):
        return inliers, None
    inliers[usable] = mask.ravel() > 0
    return inliers, np.asarray(essential, dtype=np.float64)


def _wide_inliers(rays_a: Floats, rays_b: Floats, max_error: float) -> EssentialFit:
    """The fit of wide views by angles from the epipolar planes."""
    turn_a, turn_b = _towards(rays_a), _towards(rays_b)
    turned_a, turned_b = rays_a @ turn_a.T, rays_b @ turn_b.T
    best = EssentialFit(inliers=np.zeros(len(rays_a), dtype=np.bool_), essential=None)
    central = (turned_a[:, 2] > WIDE) & (turned_b[:, 2] > WIDE)
    everything = np.arange(len(rays_a))
    for rows in (everything,) if central.all() else (np.flatnonzero(central), everything):
        _, essential = _plane_inliers(turned_a[rows], turned_b[rows], max_error)
        if essential is None:
            continue
        inliers = _angles(essential, turned_a, turned_b) < max_error
        for _ in range(REFINEMENTS):
            if inliers.sum() < MIN_RANSAC_MATCHES:
                break
            other = _linear_essential(turned_a[inliers], turned_b[inliers])
            refined = _angles(other, turned_a, turned_b) < max_error
            if refined.sum() <= inliers.sum():
                break
            inliers, essential = refined, other
        if inliers.sum() > best.inliers.sum():
            best = EssentialFit(inliers=inliers, essential=turn_b.T @ essential @ turn_a)
    return best


def _towards(rays: Floats) -> Floats:
    """A rotation (3, 3) that turns the mean of rays (n, 3) to the z axis."""
    mean = rays.mean(axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    axis, cosine = np.cross(mean, [0.0, 0.0, 1.0]), mean[2]
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    result: Floats = se3.exp_so3(axis / sine * np.arctan2(sine, cosine))
    return result


def _angles(essential: Floats, rays_a: Floats, rays_b: Floats) -> Floats:
    """Sampson distances (n,) in radians of rays from an essential matrix."""
    normal_b, normal_a = rays_a @ essential.T, rays_b @ essential
    length = np.sqrt((normal_a**2).sum(1) + (normal_b**2).sum(1))
    result: Floats = np.abs((normal_b * rays_b).sum(1)) / np.maximum(length, 1e-12)
    return result


def _linear_essential(rays_a: Floats, rays_b: Floats) -> Floats:
    """The essential matrix nearest to what solves all equations b' E a = 0 [Hartley and Zisserman, 11.1]."""
    equations = (rays_b[:, :, None] * rays_a[:, None, :]).reshape(len(rays_a), 9)
    _, vectors = np.linalg.eigh(equations.T @ equations)
    u, _, vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    result: Floats = u @ np.diag([1.0, 1.0, 0.0]) @ vt
    return result


def epipolar_errors(b_from_a: Floats, rays_a: Floats, rays_b: Floats) -> Floats:
    """Angles (n,) in radians between rays of b and the epipolar planes of their partners in a under a known pose."""
    essential = se3.skew(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    normals = rays_a @ essential.T
    length = np.linalg.norm(normals, axis=1)
    sine = np.abs((normals * rays_b).sum(1)) / np.maximum(length, 1e-12)
    result: Floats = np.arcsin(np.clip(sine, 0, 1))
    return result


def parallax_rad(rays_a: Floats, rays_b: Floats) -> float:
    """Median angle between matching rays (n, 3) after the rotation that aligns them best: what only motion explains."""
    u, _, vt = np.linalg.svd(rays_b.T @ rays_a)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    cosine = np.clip(((rays_a @ rotation.T) * rays_b).sum(1), -1.0, 1.0)
    return float(np.median(np.arccos(cosine)))


def signed_parallax(b_from_a: Floats, rays_a: Floats, rays_b: Floats) -> Floats:
    """Sines (n,) of the angles between rays about their epipolar planes' normals: negative where they meet behind.

    Of a ray's two planes, with either camera's ray, the one that says less; zero where rays are parallel.
    """
    result = np.empty(len(rays_a))
    _signed_parallax(np.ascontiguousarray(b_from_a), rays_a, rays_b, result)
    return result


@njit(cache=True, nogil=True)
def _signed_parallax(b_from_a: Any, rays_a: Any, rays_b: Any, out: Any) -> None:
    tx, ty, tz = b_from_a[0, 3], b_from_a[1, 3], b_from_a[2, 3]
    for n in range(len(out)):
        ax, ay, az = rays_a[n, 0], rays_a[n, 1], rays_a[n, 2]
        bx, by, bz = rays_b[n, 0], rays_b[n, 1], rays_b[n, 2]
        px = b_from_a[0, 0] * ax + b_from_a[0, 1] * ay + b_from_a[0, 2] * az
        py = b_from_a[1, 0] * ax + b_from_a[1, 1] * ay + b_from_a[1, 2] * az
        pz = b_from_a[2, 0] * ax + b_from_a[2, 1] * ay + b_from_a[2, 2] * az
        # Between both rays, and the normals of their planes.
        wx, wy, wz = by * pz - bz * py, bz * px - bx * pz, bx * py - by * px
        ux, uy, uz = ty * pz - tz * py, tz * px - tx * pz, tx * py - ty * px
        vx, vy, vz = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
        of_a = (wx * ux + wy * uy + wz * uz) / max(math.sqrt(ux * ux + uy * uy + uz * uz), MIN_NORMAL)
        of_b = (wx * vx + wy * vy + wz * vz) / max(math.sqrt(vx * vx + vy * vy + vz * vz), MIN_NORMAL)
        out[n] = min(of_a, of_b)


def in_front_of_both(b_from_a: Floats, rays_a: Floats, rays_b: Floats) -> Bools:
    """Return which pairs of rays (n,) meet in front of both cameras under a known pose, or are parallel to within
    rounding.
    """
    ra = rays_a @ b_from_a[:3, :3].T
    t = b_from_a[:3, 3]
    # Least squares depths of da * ra + t = db * rb, from the 2x2 normal equations.
    c = (ra * rays_b).sum(1)
    pa, pb = ra @ t, rays_b @ t
    det = 1 - c**2
    da, db = (c * pb - pa), (pb - c * pa)
    result: Bools = (det < 1e-9) | ((da > -1e-3 * det) & (db > -1e-3 * det))
    return result
