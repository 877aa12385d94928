"""Covers an image of any size with the windows of a network that takes images of one size.

Shrinking a whole image into the window would throw away most of its detail, so windows are laid over it at full scale.
They overlap, because what lies at a window's edge is seen with half of its surroundings missing: of every window only
the keypoints nearer to its centre than to its neighbours' are taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.types import Bools, Bytes, Floats32, Ints

MIN_OVERLAP_PX = 48  # about what XFeat's descriptors see around a keypoint
DUPLICATE_PX = 2.0  # two windows put one corner at most so far apart


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A window at (column, row) in the image, and the part of it whose keypoints count.

    The core is given as first and last border in image pixels; cores of all tiles partition the image.
    """

    column: int
    row: int
    core_columns: tuple[float, float]
    core_rows: tuple[float, float]

    def owns(self, xy_px: Floats32) -> Bools:
        """Return which keypoints (n, 2), in image pixels, lie in the core."""
        x, y = xy_px[:, 0], xy_px[:, 1]
        result: Bools = (
            (x >= self.core_columns[0])
            & (x < self.core_columns[1])
            & (y >= self.core_rows[0])
            & (y < self.core_rows[1])
        )
        return result


def lay_tiles(image: tuple[int, int], window: tuple[int, int]) -> list[Tile]:
    """The fewest tiles of `window` (rows, columns) that cover an image (rows, columns) with overlap, evenly spread.

    Where the image is smaller than the window, the one tile reaches beyond it: see `cut`.
    """
    rows, columns = (_spans(size, length) for size, length in zip(image, window, strict=True))
    return [
        Tile(column=column, row=row, core_columns=core_columns, core_rows=core_rows)
        for row, core_rows in rows
        for column, core_columns in columns
    ]


def _spans(size: int, length: int) -> list[tuple[int, tuple[float, float]]]:
    """Start and core of every tile along one axis."""
    if size <= length:
        return [(0, (0.0, float(size)))]
    overlap = min(MIN_OVERLAP_PX, length // 2)
    count = -(-(size - overlap) // (length - overlap))
    starts = np.round(np.linspace(0, size - length, count)).astype(int)
    borders = [0.0, *((starts[:-1] + length + starts[1:]) / 2), float(size)]
    return [(int(start), (borders[i], borders[i + 1])) for i, start in enumerate(starts)]


def cut(image: Bytes, tile: Tile, window: tuple[int, int]) -> Bytes:
    """The pixels (rows, columns, ...) of a tile; beyond the image it is mirrored, which adds no edge at its border."""
    part = image[tile.row : tile.row + window[0], tile.column : tile.column + window[1]]
    below, right = window[0] - part.shape[0], window[1] - part.shape[1]
    if below == right == 0:
        return part
    padded = cv2.copyMakeBorder(part, 0, below, 0, right, cv2.BORDER_REFLECT)
    return np.asarray(padded, dtype=np.uint8)


def duplicates(xy_px: Floats32, scores: Floats32, tile: Ints) -> Bools:
    """Return which keypoints (n,) another tile has found better: near a border both tiles can see one corner."""
    result = np.zeros(len(xy_px), dtype=np.bool_)
    if len(xy_px) < 2:
        return result
    pairs = cKDTree(xy_px).query_pairs(DUPLICATE_PX, output_type="ndarray")
    pairs = pairs[tile[pairs[:, 0]] != tile[pairs[:, 1]]]
    weaker = np.where(scores[pairs[:, 0]] < scores[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    result[weaker] = True
    return result
