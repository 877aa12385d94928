"""Nearest neighbours of descriptors: needs no model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.matching.integer_products import missing, product_of_bytes, right_side
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints32

ROWS = 256  # of a product that exist at one time: as many as a core's cache holds
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
def _scale(products: Any, missing: Any, factor: Any, factors: Any, out: Any) -> None:
    """Cosines (m,) of products, of what all of them are short of, and of the inverse lengths of both sides."""
    for j in range(len(out)):
        out[j] = np.float32(products[j] + missing) * (factor * factors[j])


@njit(cache=True, nogil=True)
def _take_rows(
    products: Any,
    missing: Any,
    factors_a: Any,
    factors_b: Any,
    ratio2: float,
    col_top: Any,
    row_top: Any,
    row_best: Any,
) -> None:
    """Take products (n, m) of descriptors into the columns' largest cosines (m,), and find each row's best column (n,).

    Rows whose best column does not pass the ratio test of distances have none (-1). `missing` (n,) is added to the
    products, (n,) and (m,) are inverse lengths.

    The loops over a row have neither branches nor indices of what is best: that runs in vector registers, and the best
    column is found in its lane afterwards.
    """
    n, m = products.shape
    top, second, row = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(m, np.float32)
    for i in range(n):
        _scale(products[i], missing[i], factors_a[i], factors_b, row)
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
        row_best[i] = -1
        # For unit vectors the squared distance is 2 - 2 similarity.
        if (1.0 - largest) < ratio2 * (1.0 - next_largest):
            for j in range(lane, m, LANES):
                if row[j] == largest:
                    row_top[i], row_best[i] = largest, j
                    break


@njit(cache=True, nogil=True)
def _mutual(col_top: Any, row_top: Any, row_best: Any) -> Any:
    """Pairs (k, 2) of rows (n,) and their best columns (m,) that are best for both.

    Of rows that are equally near to a column the first is taken.
    """
    is_taken = np.zeros(len(col_top), np.bool_)
    out = np.empty((len(row_best), 2), np.int32)
    count = 0
    for i in range(len(row_best)):
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
    columns: NDArray[Any]  # (D, n), of bytes as `integer_products.right_side` makes them
    missing: Ints32 | Floats32  # (n,) what products of bytes with a row are short of
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
        inverse = (1.0 / np.maximum(lengths, 1e-6)).astype(np.float32)
        if rows.dtype == np.uint8:
            return Prepared(rows, right_side(rows), missing(rows), inverse)
        # Floats that BLAS transposes on the way need no second copy.
        return Prepared(rows, rows.T, np.zeros(len(rows), np.float32), inverse)

    def match(self, a: Prepared, b: Prepared) -> Ints32:
        """See `Matcher`."""
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int32)
        col_top = np.full(len(b), -2.0, np.float32)
        row_top, row_best = np.empty(len(a), np.float32), np.empty(len(a), np.int32)
        for start in range(0, len(a), ROWS):
            rows = slice(start, start + ROWS)
            products = (
                product_of_bytes(a.rows[rows], b.columns) if a.rows.dtype == np.uint8 else a.rows[rows] @ b.columns
            )
            _take_rows(
                products,
                a.missing[rows],
                a.inverse_lengths[rows],
                b.inverse_lengths,
                self._ratio2,
                col_top,
                row_top[rows],
                row_best[rows],
            )
        result: Ints32 = _mutual(col_top, row_top, row_best)
        return result


METHOD = Method[MatchConfig, NearestNeighbourMatcher](build=NearestNeighbourMatcher)
