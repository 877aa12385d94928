"""Uncertainty of a triangulated point, from the rays that see it."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.types import Floats, Ints

SMALLEST_INFORMATION = 1e-12  # of a point that nothing observes
REGULAR = 1e-9  # of the largest information: keeps points with parallel rays invertible


def point_covariances(
    points_m: Floats, point: Ints, ray_origin_m: Floats, focal_px: Floats, *, sigma_px: float
) -> Floats:
    """Covariances (p, 3, 3) of points, square metres, for exact poses.

    A ray does not constrain a point along itself; across itself the standard deviation is depth times the angle of the
    image's noise.

    Parameters
    ----------
    points_m
        Points (p, 3).
    point, ray_origin_m, focal_px
        For every observation its point (n,), the camera's centre (n, 3) in the points' frame and its focal length (n,).
    sigma_px
        Standard deviation of an image coordinate.
    """
    ray = points_m[point] - ray_origin_m
    depth = np.linalg.norm(ray, axis=1).clip(1e-6)
    ray /= depth[:, None]
    weight = (focal_px / (depth * sigma_px)) ** 2
    information = np.zeros((len(points_m), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            entry = weight * (float(i == j) - ray[:, i] * ray[:, j])
            information[:, i, j] = information[:, j, i] = np.bincount(point, entry, minlength=len(points_m))
    # In units of each point's largest information, so that near and far points are equally well conditioned.
    scale = np.maximum(np.trace(information, axis1=1, axis2=2), SMALLEST_INFORMATION)
    regular = information / scale[:, None, None] + REGULAR * np.eye(3)
    result: Floats = np.linalg.inv(regular) / scale[:, None, None]
    return result
