"""Averages of poses that single wrong ones don't move."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

# Rotations from which the mean may start. All against all would take 7 GB of a drive of 10,000 units.
MOST_STARTS = 64


def robust_mean_rotation(rotations: Floats, *, iterations: int = 20, epsilon_rad: float = 1e-4) -> Floats:
    """L1 mean (3, 3) of rotations (n, 3, 3) by iteratively reweighted least squares.

    Source: Hartley, Aftab and Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011. The start is
    the rotation, of up to `MOST_STARTS` evenly chosen ones, with the smallest sum of angles to all, so that fewer than
    half can be arbitrarily wrong.
    """
    starts = rotations[even_choice(len(rotations), MOST_STARTS)]
    pairwise = np.swapaxes(starts, 1, 2)[:, None] @ rotations[None]
    mean: Floats = starts[np.linalg.norm(se3.log_so3(pairwise), axis=-1).sum(1).argmin()]
    for _ in range(iterations):
        steps = se3.log_so3(rotations @ mean.T)
        weights = 1.0 / np.maximum(np.linalg.norm(steps, axis=1), epsilon_rad)
        step = (weights[:, None] * steps).sum(0) / weights.sum()
        mean = se3.exp_so3(step) @ mean
        if np.linalg.norm(step) < 1e-9:
            break
    return mean


def geometric_median(points: Floats, *, iterations: int = 50, epsilon: float = 1e-4) -> Floats:
    """Point (d,) with the smallest sum of distances to points (n, d), by Weiszfeld's algorithm."""
    mean: Floats = np.median(points, axis=0)
    for _ in range(iterations):
        weights = 1.0 / np.maximum(np.linalg.norm(points - mean, axis=1), epsilon)
        moved = (weights[:, None] * points).sum(0) / weights.sum()
        if np.linalg.norm(moved - mean) < 1e-9:
            break
        mean = moved
    return mean
