"""Geometric verification of matches by the essential matrix."""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, Floats

MIN_FORWARD = 0.15  # z of a unit ray below which a pinhole's plane coordinates explode (81 degrees off axis)
CONFIDENCE = 0.9999
MIN_RANSAC_MATCHES = 8


def essential_inliers(rays_a: Floats, rays_b: Floats, *, max_error: float) -> Bools:
    """Return which matches (n,) agree with one essential matrix found by RANSAC.

    Parameters
    ----------
    rays_a, rays_b
        Unit viewing rays (n, 3) in camera axes.
    max_error
        Distance from the epipolar line in the plane z = 1 (pixels over focal length).
    """
    inliers = np.zeros(len(rays_a), dtype=np.bool_)
    usable = np.flatnonzero((rays_a[:, 2] > MIN_FORWARD) & (rays_b[:, 2] > MIN_FORWARD))
    if len(usable) < MIN_RANSAC_MATCHES:
        return inliers
    a, b = rays_a[usable, :2] / rays_a[usable, 2:], rays_b[usable, :2] / rays_b[usable, 2:]
    essential, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_ACCURATE, CONFIDENCE, max_error)
    if essential is not None and essential.shape == (3, 3):
        inliers[usable] = mask.ravel() > 0
    return inliers


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
    ra, t = rays_a @ b_from_a[:3, :3].T, b_from_a[:3, 3]
    between = np.cross(rays_b, ra)
    by_ray = []
    for rays in (ra, rays_b):
        normal = np.cross(t, rays)
        by_ray.append((between * normal).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12))
    result: Floats = np.minimum(*by_ray)
    return result


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
