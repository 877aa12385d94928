"""Nearest neighbours of descriptors: needs no model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints32


@njit(cache=True, nogil=True)
def _mutual_ratio(similarity: Any, ratio2: float) -> Any:
    """One pass over a similarity matrix (n, m): mutual best pairs whose distance passes the ratio test."""
    n, m = similarity.shape
    row_best, row_top, row_second = np.zeros(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)
    col_best, col_top = np.full(m, -1, np.int32), np.full(m, -2.0, np.float32)
    for i in range(n):
        top, second, best = np.float32(-2.0), np.float32(-2.0), 0
        for j in range(m):
            v = similarity[i, j]
            if v > second:
                if v > top:
                    second, top, best = top, v, j
                else:
                    second = v
            if v > col_top[j]:
                col_top[j], col_best[j] = v, i
        row_best[i], row_top[i], row_second[i] = best, top, second
    out = np.empty((n, 2), np.int32)
    count = 0
    for i in range(n):
        # For unit vectors the squared distance is 2 - 2 similarity.
        if col_best[row_best[i]] == i and (1.0 - row_top[i]) < ratio2 * (1.0 - row_second[i]):
            out[count, 0], out[count, 1] = i, row_best[i]
            count += 1
    return out[:count]


class NearestNeighbourMatcher:
    """Mutual nearest neighbours with Lowe's ratio test on unit-length descriptors."""

    def __init__(self, config: MatchConfig) -> None:
        self._ratio2 = config.ratio**2

    def prepare(self, features: ImageFeatures, *, width: int = 0, height: int = 0) -> Floats32:
        """Unit-length descriptors (n, D); the image's size does not matter."""
        d = features.descriptors.astype(np.float32)
        result: Floats32 = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6)
        return result

    def match(self, a: Floats32, b: Floats32) -> Ints32:
        """See `Matcher`."""
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int32)
        result: Ints32 = _mutual_ratio(a @ b.T, self._ratio2)
        return result


METHOD = Method[MatchConfig, NearestNeighbourMatcher](build=NearestNeighbourMatcher)
