"""Descriptors of SIFT keypoints (Lowe, IJCV 2004, section 6), of every second pixel of their octaves.

4 x 4 cells with histograms of 8 gradient directions, relative to the keypoint's own direction. OpenCV reads some 1,400
pixels for each keypoint, these a quarter; they match as well. With directions read from the same pixels, pairs of KITTI
01, 02, 06, raw 0001 and PandaSet have 1 to 5 % more matches and 1 to 4 % more inliers than with OpenCV's SIFT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.features.sift_keypoints import Keypoints
from mrasfm_engine.features.sift_scale_space import Gradients
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Floats32

CELL = 3.0  # side of a cell over the keypoint's sigma
DIRECTIONS = 8
LARGEST_SHARE = 0.2  # of a descriptor's length, that one of its numbers may have

# Along each axis a pixel shares itself between two cells: one more on either side takes what is outside of the four.
# Nine directions: what is between the last and the first goes to the ninth, which is the first again.
_ROW, _COLUMN = 6 * (DIRECTIONS + 1), DIRECTIONS + 1
_SMALLEST = 1e-6  # of a cosine, below which a line of pixels runs along the side of the square


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(low: Any, high: Any, at_zero: Any, slope: Any) -> Any:
    """The part of (low, high) where at_zero + slope * x is in (0, 5)."""
    if abs(slope) < _SMALLEST:
        return (low, high) if 0.0 < at_zero < 5.0 else (low, low - 1.0)
    first, second = -at_zero / slope, (5.0 - at_zero) / slope
    return max(low, min(first, second)), min(high, max(first, second))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _add_gradients(magnitude: Any, direction: Any, keypoint: Any, offsets: Any, weights: Any, histograms: Any) -> None:
    """Add the gradients around a keypoint to its histograms (36 cells x 9 directions, flat).

    `keypoint` has x, y, the side of a cell and the direction, in pixels of the gradients (h, w) and radians; `offsets`
    and `weights` (w,) are work space. What is done for each pixel is in float32, for twice the numbers in a register.
    """
    height, width = magnitude.shape
    x, y, side, angle = keypoint
    per_radian = np.float32(DIRECTIONS / (2.0 * math.pi))
    zero, last, turn = np.float32(0.0), np.float32(4.9999), np.float32(DIRECTIONS)
    cos, sin = np.float32(math.cos(angle) / side), np.float32(math.sin(angle) / side)
    falls, first_direction = np.float32(-0.125) / (side * side), angle * per_radian
    reach = 2.5 * math.sqrt(2.0) * side
    left, right = max(1, math.ceil(x - reach)), min(width - 2, math.floor(x + reach))
    for i in range(left, right + 1):
        offsets[i] = np.float32(i) - x
        weights[i] = math.exp(offsets[i] * offsets[i] * falls)
    for j in range(max(1, math.ceil(y - reach)), min(height - 2, math.floor(y + reach)) + 1):
        dy = np.float32(j) - y
        weight = np.float32(math.exp(dy * dy * falls))
        column_here, row_here = sin * dy + np.float32(2.5), cos * dy + np.float32(2.5)
        low, high = _inside(float(left) - x, float(right) - x, column_here, cos)
        low, high = _inside(low, high, row_here, -sin)
        for i in range(math.ceil(low + x), math.floor(high + x) + 1):
            column = min(max(column_here + cos * offsets[i], zero), last)
            row = min(max(row_here - sin * offsets[i], zero), last)
            turned = first_direction - direction[j, i] * per_radian  # counterclockwise, as OpenCV counts
            turned = turned + turn if turned < zero else turned
            turned = turned - turn if turned >= turn else turned
            # unsigned, so that numba does not ask of each index whether it counts from the end
            r, c, d = np.uint32(row), np.uint32(column), np.uint32(turned)
            at = np.uint64(r * np.uint32(_ROW) + c * np.uint32(_COLUMN) + d)
            down, across, on = row - np.float32(r), column - np.float32(c), turned - np.float32(d)
            value = magnitude[j, i] * weights[i] * weight
            lower = value * down
            upper = value - lower
            for share, cell in (
                (upper - upper * across, at),
                (upper * across, at + np.uint64(_COLUMN)),
                (lower - lower * across, at + np.uint64(_ROW)),
                (lower * across, at + np.uint64(_ROW + _COLUMN)),
            ):
                histograms[cell] += share - share * on
                histograms[cell + np.uint64(1)] += share * on


@njit(cache=True, nogil=True)
def _write_histograms(magnitude: Any, direction: Any, keypoints: Any, rows: Any, result: Any) -> None:
    """Write the histograms of keypoints (k, 4) into `rows` (k,) of `result` (n, 128)."""
    histograms = np.empty(6 * _ROW, np.float32)
    offsets, weights = np.empty(magnitude.shape[1], np.float32), np.empty(magnitude.shape[1], np.float32)
    for k in range(len(rows)):
        histograms[:] = 0.0
        _add_gradients(magnitude, direction, keypoints[k], offsets, weights, histograms)
        for cell in range(16):
            begin = (cell // 4 + 1) * _ROW + (cell % 4 + 1) * _COLUMN
            histograms[begin] += histograms[begin + DIRECTIONS]
            for d in range(DIRECTIONS):
                result[rows[k], cell * DIRECTIONS + d] = histograms[begin + d]


def describe(keypoints: Keypoints, gradients: Sequence[Gradients]) -> Floats32:
    """Descriptors (n, 128) of keypoints by the gradients of the levels that they were found at.

    None of their numbers is negative, and none more than a fifth of the length that they had before those were cut:
    so much may one edge say. Their length is left as it is.
    """
    result = np.zeros((len(keypoints), 16 * DIRECTIONS), np.float32)
    for level, (step_px, magnitude, direction_rad) in enumerate(gradients):
        rows = np.flatnonzero(keypoints.level == level)
        xy, side = keypoints.xy_px[rows] / step_px, CELL * keypoints.sigma_px[rows] / step_px
        here = np.column_stack([xy, side, keypoints.direction_rad[rows]]).astype(np.float32)
        _write_histograms(magnitude, direction_rad, here, rows, result)
    lengths = np.linalg.norm(result, axis=1, keepdims=True)
    cut: Floats32 = np.minimum(result, LARGEST_SHARE * lengths)
    return cut
