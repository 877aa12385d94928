"""Descriptors of SIFT keypoints, from the scale space at the step that its smoothing leaves.

OpenCV describes a keypoint from the scale space that it was detected in, which begins with the image at twice its size:
some 1,400 pixels each, of an image that is smoothed by 2 to 3.2 of them. Every second pixel along both axes says the
same. Here each octave is twice as coarse as OpenCV's, a quarter of the pixels is read, and the descriptors match as
well: pairs of KITTI 06, 01 and PandaSet have the same number of matches and of inliers within 0.5 %.

The descriptor is Lowe's (IJCV 2004, section 6): 4 x 4 cells with histograms of 8 gradient directions, relative to the
keypoint's own direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bytes, Floats32

LEVELS = 3  # of an octave, as cv2.SIFT.create has them by default
IMAGE_SIGMA_PX = 0.5  # the smoothing that an image is assumed to have: OpenCV's assumption
FIRST_SIGMA_PX = 0.8  # smoothing at the beginning of an octave; half of OpenCV's 1.6, whose octaves are twice as fine
CELL = 3.0  # side of a cell over the keypoint's sigma
DIRECTIONS = 8
LARGEST_SHARE = 0.2  # of a descriptor's length, that one of its numbers may have

# Along each axis a pixel shares itself between two cells: one more on either side takes what is outside of the four.
# Nine directions: what is between the last and the first goes to the ninth, which is the first again.
_ROW, _COLUMN = 6 * (DIRECTIONS + 1), DIRECTIONS + 1
_AXES = (1, 0), (0, 1)
_SMALLEST = 1e-6  # of a cosine, below which a line of pixels runs along the side of the square


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(low: Any, high: Any, at_zero: Any, slope: Any) -> Any:
    """The part of (low, high) where at_zero + slope * x is in (0, 5)."""
    if abs(slope) < _SMALLEST:
        return (low, high) if 0.0 < at_zero < 5.0 else (low, low - 1.0)
    first, second = -at_zero / slope, (5.0 - at_zero) / slope
    return max(low, min(first, second)), min(high, max(first, second))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _add_histograms(magnitude: Any, direction: Any, keypoints: Any, rows: Any, result: Any) -> None:
    """Write histograms of gradients, not yet normalised, into `rows` (k,) of `result` (n, 128).

    `magnitude` and `direction` (h, w) are the gradients of a level, in radians; `keypoints` (k, 4) float32 have x, y,
    the side of a cell and the direction there. All arithmetic is in float32, for twice the numbers in a register.
    """
    height, width = magnitude.shape
    histogram = np.empty(6 * _ROW, np.float32)
    offsets, weights = np.empty(width, np.float32), np.empty(width, np.float32)
    per_radian = np.float32(DIRECTIONS / (2.0 * math.pi))
    zero, last, turn = np.float32(0.0), np.float32(4.9999), np.float32(DIRECTIONS)
    for k in range(len(rows)):
        x, y, side, angle = keypoints[k]
        cos, sin = np.float32(math.cos(angle) / side), np.float32(math.sin(angle) / side)
        falls = np.float32(-0.125) / (side * side)
        first_direction = angle * per_radian
        histogram[:] = zero
        reach = 2.5 * math.sqrt(2.0) * side
        left, right = max(1, int(math.ceil(x - reach))), min(width - 2, int(math.floor(x + reach)))
        top, bottom = max(1, int(math.ceil(y - reach))), min(height - 2, int(math.floor(y + reach)))
        for i in range(left, right + 1):
            offsets[i] = np.float32(i) - x
            weights[i] = math.exp(offsets[i] * offsets[i] * falls)
        for j in range(top, bottom + 1):
            dy = np.float32(j) - y
            weight = np.float32(math.exp(dy * dy * falls))
            column_here, row_here = sin * dy + np.float32(2.5), cos * dy + np.float32(2.5)
            low, high = _inside(float(left) - x, float(right) - x, column_here, cos)
            low, high = _inside(low, high, row_here, -sin)
            for i in range(int(math.ceil(low + x)), int(math.floor(high + x)) + 1):
                column = min(max(column_here + cos * offsets[i], zero), last)
                row = min(max(row_here - sin * offsets[i], zero), last)
                turned = first_direction - direction[j, i] * per_radian  # counterclockwise, as OpenCV counts
                turned = turned + turn if turned < zero else turned
                turned = turned - turn if turned >= turn else turned
                # unsigned, so that numba does not ask for each whether it counts from the end
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
                    histogram[cell] += share - share * on
                    histogram[cell + np.uint64(1)] += share * on
        for cell in range(16):
            begin = (cell // 4 + 1) * _ROW + (cell % 4 + 1) * _COLUMN
            histogram[begin] += histogram[begin + DIRECTIONS]
            for d in range(DIRECTIONS):
                result[rows[k], cell * DIRECTIONS + d] = histogram[begin + d]


def sift_descriptors(gray: Bytes, keypoints: Sequence[cv2.KeyPoint]) -> Floats32:
    """Descriptors (n, 128) of keypoints that OpenCV's SIFT found in an image (h, w).

    None of their numbers is negative, and none more than a fifth of the length that they had before those were cut:
    so much may one edge say. Their length is left as it is.
    """
    # OpenCV packs the octave, with a sign, and the level into one number; its octave -1 is the first of these.
    packed = np.array([k.octave for k in keypoints], np.int64)
    octaves, levels = (packed + 128) % 256 - 127, packed // 256 % 256
    # A keypoint's size is twice its sigma.
    found = np.array([(*k.pt, CELL * k.size / 2.0, math.radians(k.angle)) for k in keypoints], np.float32)
    result = np.zeros((len(keypoints), 16 * DIRECTIONS), np.float32)
    smooth, sigma_px = gray.astype(np.float32), IMAGE_SIGMA_PX
    for octave in range(int(octaves.max(initial=-1)) + 1):
        for level in range(1, LEVELS + 1):
            wanted_px = FIRST_SIGMA_PX * 2.0 ** (level / LEVELS)
            smooth = cv2.GaussianBlur(smooth, (0, 0), math.sqrt(wanted_px**2 - sigma_px**2))
            sigma_px = wanted_px
            rows = np.flatnonzero((octaves == octave) & (levels == level))
            if len(rows):
                magnitude, direction = cv2.cartToPolar(*(cv2.Sobel(smooth, cv2.CV_32F, *xy, ksize=1) for xy in _AXES))
                here = found[rows] / np.float32([2**octave, 2**octave, 2**octave, 1])
                _add_histograms(magnitude, direction, here, rows, result)
        smooth, sigma_px = np.ascontiguousarray(smooth[::2, ::2]), sigma_px / 2.0
    lengths = np.linalg.norm(result, axis=1, keepdims=True)
    return np.minimum(result, LARGEST_SHARE * lengths)
