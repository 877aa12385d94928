"""Visibility pyramids: how well the points that a unit sees cover its images, so which unit is registered next.

Many points in one corner fix a pose worse than a few all over the image. Each image is divided into 2 x 2, 4 x 4, ...
64 x 64 cells; every cell that has a point counts as many as its level has cells, and a unit's score is the sum over its
cameras [Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016, 4.2].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Floats, Ints

LEVELS = 6


def finest_cells(xy_px: Floats, camera: Ints, image_size_px: Floats) -> Ints:
    """Cells (n,) of keypoints (n, 2) in the finest level of the cameras (n,) whose images have sizes (c, 2)."""
    cells = 1 << LEVELS
    xy = np.clip(xy_px / image_size_px[camera] * cells, 0, cells - 1).astype(np.int64)
    result: Ints = xy[:, 1] * cells + xy[:, 0]
    return result


def visibility_score(rows: Ints, cell: Ints, camera: Ints, track: Ints, triangulated: Bools, cameras: int) -> int:
    """Score of a unit whose keypoints are `rows`.

    Parameters
    ----------
    cell, camera, track
        Of all keypoints (n,): see `finest_cells`; the rows must have a track.
    triangulated
        (tracks,) which of them have a point.
    cameras
        Number of the rig's cameras.
    """
    return int(_score(rows, cell, camera, track, triangulated, np.zeros((cameras, 2 * 4**LEVELS), np.bool_)))


@njit(cache=True, nogil=True)
def _score(rows: Any, cell: Any, camera: Any, track: Any, triangulated: Any, taken: Any) -> int:
    """`taken` (cameras, cells of all levels) is False everywhere; level l begins at 4^l."""
    score = 0
    for row in rows:
        if not triangulated[track[row]]:
            continue
        x, y = cell[row] % (1 << LEVELS), cell[row] // (1 << LEVELS)
        for level in range(LEVELS, 0, -1):
            at = (1 << 2 * level) + (y << level) + x
            if taken[camera[row], at]:
                break  # and so are the coarser cells around it
            taken[camera[row], at] = True
            score += 1 << 2 * level
            x >>= 1
            y >>= 1
    return score
