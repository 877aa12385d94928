"""Nearest places in the plane, and nearest values on a line."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.types import Floats, Ints


def nearest(
    places_m: Floats, xy_m: Floats, *, count: int = 1, within_m: float = np.inf, threads: int = 1
) -> tuple[Floats, Ints]:
    """Distances and indices (n, count), nearest first, of the places (k, 2), k > 0, around each of xy (n, 2).

    Where there are fewer within the distance, the distance is infinite and the index 0.
    """
    count = min(count, len(places_m))
    found = cKDTree(places_m).query(xy_m, k=count, distance_upper_bound=within_m, workers=threads)
    distance = np.asarray(found[0], dtype=np.float64).reshape(len(xy_m), count)
    index = np.asarray(found[1], dtype=np.int64).reshape(len(xy_m), count)
    return distance, np.where(np.isfinite(distance), index, 0)


def nearest_sorted(values: Ints | Floats, wanted: Ints | Floats) -> Ints:
    """Indices (m,) of the values (n,), ascending and at least one, that are nearest to `wanted` (m,)."""
    after = np.clip(np.searchsorted(values, wanted), 1, max(len(values) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(values) - 1)
    result: Ints = np.where(np.abs(wanted - values[before]) <= np.abs(values[after] - wanted), before, after)
    return result
