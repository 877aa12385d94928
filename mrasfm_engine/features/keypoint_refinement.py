"""Puts keypoints of networks that know only whole pixels where the image itself has its detail.

XFeat's detector sees one cell of 8 x 8 pixels at a time: where in a cell something lies moves its keypoint by half a
pixel and more. Extrema of the difference of Gaussians do not know of cells. Measured on KITTI's stereo pairs this takes
0.06 of 0.08 px of bias off disparities, and nearly halves the distance from epipolar lines.
"""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.geometry.parabola import vertex
from mrasfm_engine.types import Bools, Bytes, Floats32, Ints

SIGMA_PX = 1.2  # of the finer one
SIGMA_RATIO = 1.4
RADIUS_PX = 3
MIN_HEIGHT = 0.5  # gray levels; less is rounding


def snap_to_extrema(gray: Bytes, xy_px: Floats32) -> tuple[Floats32, Bools]:
    """The strongest extremum of the difference of Gaussians near every keypoint.

    Parameters
    ----------
    gray
        Image (h, w).
    xy_px
        Keypoints (n, 2); the top left pixel's centre is at (0.5, 0.5).

    Returns
    -------
    xy_px
        Where the extrema are (n, 2), to a fraction of a pixel.
    found
        Which keypoints have one (n,) within `RADIUS_PX`, and are the first in their order to have it.
    """
    heights = _difference_of_gaussians(gray)
    at, is_extremum = _strongest_near(heights, np.floor(xy_px).astype(np.int64))
    refined = (at + np.float32(0.5) + _within_pixel(heights, at)).astype(np.float32)
    places = at[:, 1] * gray.shape[1] + at[:, 0]
    candidates = np.flatnonzero(is_extremum)
    _, first = np.unique(places[candidates], return_index=True)
    found = np.zeros(len(xy_px), dtype=np.bool_)
    found[candidates[first]] = True
    return refined, found


def _difference_of_gaussians(gray: Bytes) -> Floats32:
    """Absolute value: both dark and bright detail is a maximum."""
    image = gray.astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(image, (0, 0), s) for s in (SIGMA_PX, SIGMA_PX * SIGMA_RATIO))
    return np.asarray(np.abs(coarse - fine), dtype=np.float32)


def _strongest_near(heights: Floats32, at: Ints) -> tuple[Ints, Bools]:
    """Pixel (n, 2) of the largest height around each pixel, and whether its neighbours are lower."""
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    rows, columns = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    near = rows**2 + columns**2 <= (RADIUS_PX + 0.5) ** 2
    rows, columns = rows[near], columns[near]
    padded = np.pad(heights, RADIUS_PX, constant_values=-1.0)
    around = padded[at[:, 1, None] + rows + RADIUS_PX, at[:, 0, None] + columns + RADIUS_PX]
    best = around.argmax(axis=1)
    found = at + np.stack([columns[best], rows[best]], axis=1)
    largest = cv2.dilate(heights, np.ones((3, 3), np.uint8))
    x, y = found[:, 0], found[:, 1]
    # On the margin there is no neighbour to fit a parabola through.
    inside = (x > 0) & (y > 0) & (x < heights.shape[1] - 1) & (y < heights.shape[0] - 1)
    return found, inside & (heights[y, x] >= largest[y, x]) & (heights[y, x] > MIN_HEIGHT)


def _within_pixel(heights: Floats32, at: Ints) -> Floats32:
    """Offset (n, 2) of the largest height from the middle of each pixel, along each axis."""
    x = np.clip(at[:, 0], 1, heights.shape[1] - 2)
    y = np.clip(at[:, 1], 1, heights.shape[0] - 2)
    right = vertex(heights[y, x - 1], heights[y, x], heights[y, x + 1])
    down = vertex(heights[y - 1, x], heights[y, x], heights[y + 1, x])
    return np.stack([right, down], axis=1).astype(np.float32)
