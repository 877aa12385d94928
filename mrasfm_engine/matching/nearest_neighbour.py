"""Nearest neighbours of descriptors: needs no model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.matching.integer_products import RightSide, missing
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints32

ROWS = 256  # of a product that exist at one time
# Products of bytes are so fast that it counts where they are kept: written once and read twice, in a quarter of a
# core's 2 MB they take 13 % to 30 % less time than by ROWS, with 1500 to 4096 descriptors. Calls with fewer rows than
# these cost more.
CACHED_PRODUCTS, FEWEST_ROWS = 1 << 17, 32
LANES = 128  # columns that are taken at once, in vector registers; a column belongs to lane column % LANES
SCALAR_LANES = 8  # from here on a loop of one by one is as fast

# Loops of these kernels have neither branches nor indices of what is best, and write to other arrays than they read:
# only so do compilers keep them in vector registers. In place, a maximum becomes a store under a condition.


@njit(cache=True, nogil=True, fastmath=True)
def _scale(products: Any, missing: Any, factor: Any, factors: Any, out: Any) -> None:
    """Cosines (m,) of products, of what all of them are short of, and of the inverse lengths of both sides.

    All are floats before they are added: few processors convert integers of 64 bits, which a sum of two of 32 bits is
    here. The floats are exact up to 2^24, beyond any sum of 512 bytes times bytes.
    """
    for j in range(len(factors)):
        out[j] = (np.float32(products[j]) + missing) * (factor * factors[j])


@njit(cache=True, nogil=True, fastmath=True)
def _larger(a: Any, b: Any, out: Any) -> None:
    """The larger ones (m,) of two rows."""
    for j in range(len(out)):
        out[j] = max(a[j], b[j])


@njit(cache=True, nogil=True, fastmath=True)
def _take_lanes(values: Any, top: Any, second: Any, new_top: Any, new_second: Any) -> None:
    """The two largest ones of lanes and values (k,)."""
    for k in range(len(values)):
        v, t = values[k], top[k]
        new_second[k] = max(second[k], min(t, v))
        new_top[k] = max(t, v)


@njit(cache=True, nogil=True, fastmath=True)
def _fold_lanes(top: Any, second: Any, new_top: Any, new_second: Any) -> None:
    """The two largest ones (k,) of the first and second halves of lanes (2 k,)."""
    half = len(new_top)
    for k in range(half):
        t, u = top[k], top[half + k]
        new_second[k] = max(max(second[k], second[half + k]), min(t, u))
        new_top[k] = max(t, u)


@uncounted()
def _two_largest(row: Any, top: Any, second: Any, new_top: Any, new_second: Any) -> tuple[float, float]:
    """The largest value of a row (whole LANES), and the largest of the others; the rest is work space (LANES,)."""
    top[:] = -2.0
    second[:] = -2.0
    for start in range(0, len(row), LANES):
        _take_lanes(row[start : start + LANES], top, second, new_top, new_second)
        top, new_top, second, new_second = new_top, top, new_second, second
    lanes = LANES
    while lanes > SCALAR_LANES:
        half = lanes // 2
        _fold_lanes(top[:lanes], second[:lanes], new_top[:half], new_second[:half])
        top, new_top, second, new_second = new_top, top, new_second, second
        lanes = half
    largest: Any = np.float32(-2.0)
    next_largest = largest
    for k in range(lanes):
        next_largest = max(next_largest, max(second[k], min(largest, top[k])))
        largest = max(largest, top[k])
    return largest, next_largest


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
    """
    m = products.shape[1]
    row = np.full((m + LANES - 1) // LANES * LANES, np.float32(-2.0))
    top, second = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    new_top, new_second = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    columns, new_columns = col_top.copy(), np.empty_like(col_top)
    _take_each(
        products, missing, factors_a, factors_b, ratio2, col_top, row_top, row_best,
        row, top, second, new_top, new_second, columns, new_columns,
    )  # fmt: skip


@uncounted()
def _take_each(
    products: Any, missing: Any, factors_a: Any, factors_b: Any, ratio2: float, col_top: Any, row_top: Any,
    row_best: Any, row: Any, top: Any, second: Any, new_top: Any, new_second: Any, columns: Any, new_columns: Any,
) -> None:  # fmt: skip
    n, m = products.shape
    for i in range(n):
        _scale(products[i], missing[i], factors_a[i], factors_b, row)
        _larger(columns, row, new_columns)
        columns, new_columns = new_columns, columns
        largest, next_largest = _two_largest(row, top, second, new_top, new_second)
        row_best[i] = -1
        # For unit vectors the squared distance is 2 - 2 similarity.
        if (1.0 - largest) < ratio2 * (1.0 - next_largest):
            for j in range(m):
                if row[j] == largest:
                    row_top[i], row_best[i] = largest, j
                    break
    for j in range(m):
        col_top[j] = columns[j]


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
    columns: NDArray[Any] | RightSide  # (D, n)
    missing: Floats32  # (n,) what products of bytes with a row are short of
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
            return Prepared(rows, RightSide(rows), missing(rows), inverse)
        # Floats that BLAS transposes on the way need no second copy.
        return Prepared(rows, rows.T, np.zeros(len(rows), np.float32), inverse)

    def match(self, a: Prepared, b: Prepared) -> Ints32:
        """See `Matcher`."""
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int32)
        col_top = np.full(len(b), -2.0, np.float32)
        row_top, row_best = np.empty(len(a), np.float32), np.empty(len(a), np.int32)
        step = _rows_at_a_time(a.rows.dtype, len(b))
        for start in range(0, len(a), step):
            rows = slice(start, start + step)
            _take_rows(
                b.columns.product(a.rows[rows]) if isinstance(b.columns, RightSide) else a.rows[rows] @ b.columns,
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


def _rows_at_a_time(element: np.dtype[Any], columns: int) -> int:
    """Rows of a product that exist at one time."""
    if element != np.uint8 or FEWEST_ROWS * columns > CACHED_PRODUCTS:
        return ROWS
    return CACHED_PRODUCTS // columns


METHOD = Method[MatchConfig, NearestNeighbourMatcher](build=NearestNeighbourMatcher)
