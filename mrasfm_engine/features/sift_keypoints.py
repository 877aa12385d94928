"""SIFT keypoints (Lowe, IJCV 2004, sections 3 to 5): extrema of the scale space, and the directions they have.

They are OpenCV's: 998 in 1,000 of them lie within 0.003 px of one that `cv2.SIFT` finds. With their descriptors they
take half of its time. The other half are gradients of four times as many pixels, descriptors of keypoints that are not
chosen, and an object of Python for each keypoint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.features.sift_scale_space import LEVELS, SIGMA_PX, Gradients, scale_space
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bytes, Floats, Ints

GREY_VALUES = 255.0  # contrast is given as a share of them
BORDER_PX = 5  # of an octave, without keypoints
MOST_STEPS = 5  # of the search for the extremum between the pixels
EDGE_RATIO = 10.0  # of the curvatures along and across, above which a keypoint may slide along an edge

DIRECTIONS = 36  # of a histogram of gradients around a keypoint
PEAK = 0.8  # of the highest one, that another direction needs
WINDOW = 1.5  # sigma of the weights of the gradients over the keypoint's sigma
REACH = 3.0  # of them, in sigmas of the weights


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of an image; one with several directions is listed once for each.

    Attributes
    ----------
    xy_px
        (n, 2), where the centre of the top left pixel is at (0, 0).
    sigma_px
        (n,) smoothing of the level that each was found at, or between two of them.
    contrast
        (n,) as a share of the range of grey values.
    level
        (n,) which of the image's gradients they are of.
    direction_rad
        (n,) as those of the gradients.
    """

    xy_px: Floats
    sigma_px: Floats
    contrast: Floats
    level: Ints
    direction_rad: Floats

    def __len__(self) -> int:
        return len(self.xy_px)

    def chosen(self, rows: Any) -> Keypoints:
        """Keypoints that an index or a mask chooses."""
        return Keypoints(*(column[rows] for column in self._columns()))

    @staticmethod
    def joined(parts: Sequence[Keypoints]) -> Keypoints:
        """Keypoints of all parts, in their order."""
        nothing = Keypoints(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0))
        return Keypoints(*map(np.concatenate, zip(*(part._columns() for part in (nothing, *parts)), strict=True)))

    def _columns(self) -> tuple[Floats, Floats, Floats, Ints, Floats]:
        return self.xy_px, self.sigma_px, self.contrast, self.level, self.direction_rad


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _greatest(a: Any, b: Any, c: Any, out: Any) -> None:
    """The greatest (w,) of three rows."""
    for i in range(len(out)):
        out[i] = max(max(a[i], b[i]), c[i])


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _smallest(a: Any, b: Any, c: Any, out: Any) -> None:
    """The smallest (w,) of three rows."""
    for i in range(len(out)):
        out[i] = min(min(a[i], b[i]), c[i])


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _mark(values: Any, threshold: Any, high: Any, low: Any, is_extremum: Any) -> None:
    """Mark values (w,) beyond a threshold that none of the three of `high` or `low` around them exceeds."""
    for i in range(1, len(values) - 1):
        value = values[i]
        highest = max(max(high[i - 1], high[i]), high[i + 1])
        lowest = min(min(low[i - 1], low[i]), low[i + 1])
        is_extremum[i] = ((value > threshold) & (value >= highest)) | ((value < -threshold) & (value <= lowest))


@njit(cache=True, nogil=True)
def _marked(is_extremum: Any, out: Any) -> Any:
    """Write the columns that are marked and off the border into `out` (w,); their number."""
    count = 0
    for column in range(BORDER_PX, len(is_extremum) - BORDER_PX):
        if is_extremum[column]:
            out[count] = column
            count += 1
    return count


@njit(cache=True, nogil=True)
def _extrema(differences: Any, threshold: Any) -> Any:
    """Level, row and column (k, 3) of values beyond a threshold that none of their 26 neighbours exceeds."""
    levels, height, width = differences.shape
    # Loops over whole rows, which the compiler keeps in vector registers: over three levels, and then over three rows.
    high, low = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    highest, lowest = np.empty(width, np.float32), np.empty(width, np.float32)
    is_extremum, columns = np.zeros(width, np.bool_), np.empty(width, np.int32)
    result, count = np.empty((1024, 3), np.int32), 0
    for level in range(1, levels - 1):
        for row in range(BORDER_PX - 1, height - BORDER_PX + 1):
            below, here, above = differences[level - 1, row], differences[level, row], differences[level + 1, row]
            _greatest(below, here, above, high[row % 3])
            _smallest(below, here, above, low[row % 3])
            if row <= BORDER_PX:
                continue
            _greatest(high[0], high[1], high[2], highest)
            _smallest(low[0], low[1], low[2], lowest)
            _mark(differences[level, row - 1], threshold, highest, lowest, is_extremum)
            added = _marked(is_extremum, columns)
            if count + added > len(result):
                result = np.concatenate((result, np.empty((len(result) + added, 3), np.int32)))
            for k in range(added):
                result[count + k, 0], result[count + k, 1], result[count + k, 2] = level, row - 1, columns[k]
            count += added
    return result[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _newton_step(here: Any) -> Any:
    """Level, row and column from the middle of values (3, 3, 3) to the extremum of a parabola, and its value.

    Also whether it lies on a corner, and not on an edge. A flat place leads to infinity, or to what is not a number.
    """
    value = float(here[1, 1, 1])
    gx = (here[1, 1, 2] - here[1, 1, 0]) / 2.0
    gy = (here[1, 2, 1] - here[1, 0, 1]) / 2.0
    gs = (here[2, 1, 1] - here[0, 1, 1]) / 2.0
    xx = here[1, 1, 2] + here[1, 1, 0] - 2.0 * value
    yy = here[1, 2, 1] + here[1, 0, 1] - 2.0 * value
    ss = here[2, 1, 1] + here[0, 1, 1] - 2.0 * value
    xy = (here[1, 2, 2] - here[1, 2, 0] - here[1, 0, 2] + here[1, 0, 0]) / 4.0
    xs = (here[2, 1, 2] - here[2, 1, 0] - here[0, 1, 2] + here[0, 1, 0]) / 4.0
    ys = (here[2, 2, 1] - here[2, 0, 1] - here[0, 2, 1] + here[0, 0, 1]) / 4.0
    # by the cofactors of the symmetric matrix of second derivatives
    c_xx, c_xy, c_xs = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    c_yy, c_ys, c_ss = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
    determinant = xx * c_xx + xy * c_xy + xs * c_xs
    dx = -(c_xx * gx + c_xy * gy + c_xs * gs) / determinant
    dy = -(c_xy * gx + c_yy * gy + c_ys * gs) / determinant
    ds = -(c_xs * gx + c_ys * gy + c_ss * gs) / determinant
    # of the curvatures along and across: their ratio r has (r + 1)^2 / r = trace^2 / determinant
    is_corner = c_ss > 0.0 and (xx + yy) ** 2 * EDGE_RATIO < (EDGE_RATIO + 1.0) ** 2 * c_ss
    return (ds, dy, dx), value + 0.5 * (gx * dx + gy * dy + gs * ds), is_corner


@njit(cache=True, nogil=True)
def _between_pixels(differences: Any, extrema: Any, least: float) -> Any:
    """Level, row and column (k, 3) of extrema, what is to be added to each (k, 3), and their absolute values (k,).

    Those of less than `least` are left out, and those on edges.
    """
    levels, height, width = differences.shape
    places, offsets, values = np.empty((len(extrema), 3), np.int64), np.empty((len(extrema), 3)), np.empty(len(extrema))
    count = 0
    for k in range(len(extrema)):
        level, row, column = extrema[k]
        for _ in range(MOST_STEPS):
            if not (
                1 <= level < levels - 1
                and BORDER_PX <= row < height - BORDER_PX
                and BORDER_PX <= column < width - BORDER_PX
            ):
                break
            (ds, dy, dx), value, is_corner = _newton_step(
                differences[level - 1 : level + 2, row - 1 : row + 2, column - 1 : column + 2]
            )
            largest = max(abs(dx), abs(dy), abs(ds))
            if largest < 0.5 and is_corner and abs(value) >= least:
                places[count, 0], places[count, 1], places[count, 2] = level, row, column
                offsets[count, 0], offsets[count, 1], offsets[count, 2] = ds, dy, dx
                values[count] = abs(value)
                count += 1
            if not 0.5 <= largest < width + height:
                break
            level, row, column = level + round(ds), row + round(dy), column + round(dx)
    return places[:count], offsets[:count], values[:count]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _add_gradients(magnitude: Any, direction: Any, place: Any, weights: Any, histogram: Any) -> None:
    """Add the gradients around a place (x, y, sigma) to a histogram (DIRECTIONS + 2,), whose ends are one direction.

    `weights` (w,) is work space.
    """
    height, width = magnitude.shape
    x, y, sigma = place
    falls, reach = -0.5 / (WINDOW * sigma) ** 2, REACH * WINDOW * sigma
    left, right = max(1, math.ceil(x - reach)), min(width - 2, math.floor(x + reach))
    for i in range(left, right + 1):
        weights[i] = math.exp(falls * (i - x) ** 2)
    for j in range(max(1, math.ceil(y - reach)), min(height - 2, math.floor(y + reach)) + 1):
        weight = math.exp(falls * (j - y) ** 2)
        for i in range(left, right + 1):
            at = direction[j, i] * (DIRECTIONS / (2.0 * math.pi))
            whole = np.uint64(at)
            value = magnitude[j, i] * weights[i] * weight
            histogram[whole + np.uint64(1)] += value * (at - whole)
            histogram[whole] += value - value * (at - whole)


@njit(cache=True, nogil=True, error_model="numpy")
def _directions(magnitude: Any, direction: Any, places: Any) -> Any:
    """Row of each of the directions (m,), and the directions (m,), of places (k, 3): x, y, sigma in these pixels."""
    most = DIRECTIONS // 2  # of peaks of a histogram
    rows, result = np.empty(most * len(places), np.int64), np.empty(most * len(places))
    weights, added, histogram = np.empty(magnitude.shape[1]), np.empty(DIRECTIONS + 2), np.empty(DIRECTIONS)
    count = 0
    for k in range(len(places)):
        added[:] = 0.0
        _add_gradients(magnitude, direction, places[k], weights, added)
        added[0] += added[DIRECTIONS]
        added[1] += added[DIRECTIONS + 1]
        raw, highest = added[:DIRECTIONS], 0.0
        for d in range(DIRECTIONS):
            neighbours, next_ones = raw[d - 1] + raw[(d + 1) % DIRECTIONS], raw[d - 2] + raw[(d + 2) % DIRECTIONS]
            histogram[d] = (6.0 * raw[d] + 4.0 * neighbours + next_ones) / 16.0
            highest = max(highest, histogram[d])
        for d in range(DIRECTIONS):
            before, here, after = histogram[d - 1], histogram[d], histogram[(d + 1) % DIRECTIONS]
            if here > before and here > after and here >= PEAK * highest:
                top = d + 0.5 * (before - after) / (before - 2.0 * here + after)
                rows[count], result[count] = k, (top % DIRECTIONS) * 2.0 * math.pi / DIRECTIONS
                count += 1
    return rows[:count], result[:count]


def find_keypoints(gray: Bytes, *, least_contrast: float) -> tuple[Keypoints, list[Gradients]]:
    """Keypoints of an image (h, w), and the gradients of the levels that they were found at.

    Parameters
    ----------
    least_contrast
        Of a keypoint, as a share of the range of grey values, times the number of levels of an octave: OpenCV's
        `contrastThreshold`.
    """
    found: list[Keypoints] = []
    gradients: list[Gradients] = []
    least = least_contrast * GREY_VALUES / LEVELS
    for octave in scale_space(gray):
        extrema = _extrema(octave.differences, np.float32(0.5 * least))
        places, offsets, values = _between_pixels(octave.differences, extrema, least)
        # Extrema beside each other may lead to the same one.
        _, once = np.unique(np.ravel_multi_index(tuple(places.T), octave.differences.shape), return_index=True)
        for level, here in enumerate(octave.gradients, start=1):
            rows = once[places[once, 0] == level]
            scale, y, x = (places[rows] + offsets[rows]).T
            xy, sigma = np.column_stack([x, y]) * octave.step_px, SIGMA_PX * octave.step_px * 2.0 ** (scale / LEVELS)
            in_steps = np.column_stack([xy, sigma]) / here.step_px
            having, direction_rad = _directions(here.magnitude, here.direction_rad, in_steps)
            of_level = np.full(len(having), len(gradients), np.int64)
            contrast = values[rows[having]] / GREY_VALUES
            found.append(Keypoints(xy[having], sigma[having], contrast, of_level, direction_rad))
            gradients.append(here)
    return Keypoints.joined(found), gradients
