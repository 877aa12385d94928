"""Nearest neighbours of descriptors: needs no model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.matching.integer_products import product_of_bytes
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints32

LANES = 64  # columns that are taken at once, in vector registers; a column belongs to lane column % LANES


@njit(cache=True, nogil=True, fastmath=True)
def _take_lanes(values: Any, top: Any, second: Any) -> None:
    """Take values (k,) into the two largest ones of their lanes."""
    for k in range(len(values)):
        v, t = values[k], top[k]
        second[k] = max(second[k], min(t, v))
        top[k] = max(t, v)


@njit(cache=True, nogil=True, fastmath=True)
def _take_columns(row: Any, col_top: Any) -> None:
    """Take a row (m,) into the largest values of the columns."""
    for j in range(len(row)):
        col_top[j] = max(col_top[j], row[j])


@njit(cache=True, nogil=True, fastmath=True)
def _scale(products: Any, factor: Any, factors: Any, out: Any) -> None:
    """Cosines (m,) of products and the inverse lengths of both sides."""
    for j in range(len(out)):
        out[j] = np.float32(products[j]) * (factor * factors[j])


@njit(cache=True, nogil=True)
def _mutual_ratio(products: Any, factors_a: Any, factors_b: Any, ratio2: float) -> Any:
    """One pass over products (n, m) of descriptors with inverse lengths (n,) and (m,): mutual best pairs whose distance
    passes the ratio test.

    The loops over a row have neither branches nor indices of what is best: that runs in vector registers, and the best
    column is found in its lane afterwards. Of rows that are equally near to a column the first that passes is taken.
    """
    n, m = products.shape
    col_top, is_taken = np.full(m, -2.0, np.float32), np.zeros(m, np.bool_)
    row_top, row_best = np.empty(n, np.float32), np.full(n, -1, np.int32)
    top, second, row = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(m, np.float32)
    for i in range(n):
        _scale(products[i], factors_a[i], factors_b, row)
        top[:] = -2.0
        second[:] = -2.0
        for start in range(0, m, LANES):
            stop = min(start + LANES, m)
            _take_lanes(row[start:stop], top[: stop - start], second[: stop - start])
        _take_columns(row, col_top)
        largest, next_largest, lane = np.float32(-2.0), np.float32(-2.0), 0
        for k in range(LANES):
            next_largest = max(next_largest, max(second[k], min(largest, top[k])))
            if top[k] > largest:
                largest, lane = top[k], k
        # For unit vectors the squared distance is 2 - 2 similarity.
        if (1.0 - largest) < ratio2 * (1.0 - next_largest):
            for j in range(lane, m, LANES):
                if row[j] == largest:
                    row_top[i], row_best[i] = largest, j
                    break
    out = np.empty((n, 2), np.int32)
    count = 0
    for i in range(n):
        j = row_best[i]
        if j >= 0 and row_top[i] == col_top[j] and not is_taken[j]:
            is_taken[j] = True
            out[count, 0], out[count, 1] = i, j
            count += 1
    return out[:count]


@dataclass(frozen=True)
class Prepared:
    """Descriptors of an image as the matcher needs them."""

    rows: NDArray[Any]  # (n, D) bytes or floats
    columns: NDArray[Any]  # (D, n)
    inverse_lengths: Floats32  # (n,)

    def __len__(self) -> int:
        return len(self.rows)


class NearestNeighbourMatcher:
    """Mutual nearest neighbours with Lowe's ratio test on the angles between descriptors."""

    def __init__(self, config: MatchConfig) -> None:
        self._ratio2 = config.ratio**2

    def prepare(self, features: ImageFeatures, *, width: int = 0, height: int = 0) -> Prepared:
        """The descriptors and their lengths; the image's size does not matter."""
        rows: NDArray[Any] = np.ascontiguousarray(features.descriptors)
        lengths = np.linalg.norm(rows.astype(np.float32), axis=1)
        # Floats that BLAS transposes on the way need no second copy.
        columns = np.ascontiguousarray(rows.T) if rows.dtype == np.uint8 else rows.T
        return Prepared(rows, columns, (1.0 / np.maximum(lengths, 1e-6)).astype(np.float32))

    def match(self, a: Prepared, b: Prepared) -> Ints32:
        """See `Matcher`."""
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int32)
        are_bytes = a.rows.dtype == np.uint8 and b.rows.dtype == np.uint8
        products = product_of_bytes(a.rows, b.columns) if are_bytes else a.rows @ b.columns
        result: Ints32 = _mutual_ratio(products, a.inverse_lengths, b.inverse_lengths, self._ratio2)
        return result


METHOD = Method[MatchConfig, NearestNeighbourMatcher](build=NearestNeighbourMatcher)
