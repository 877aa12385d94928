"""Nearest places, and nearest values on a line."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.types import Floats, Ints

FEW = 200  # places, among which looking at every one is faster than a search tree


def nearest(
    places_m: Floats, positions_m: Floats, *, count: int = 1, within_m: float = np.inf, threads: int = 1
) -> tuple[Floats, Ints]:
    """Distances and indices (n, count), nearest first, of the places (k, d), k > 0, around each of positions (n, d).

    Where there are fewer within the distance, the distance is infinite and the index 0.

    Raises
    ------
    ValueError
        Where a coordinate is not finite.
    """
    count = min(count, len(places_m))
    if count == 1 and len(places_m) <= FEW and places_m.shape[1] == positions_m.shape[1]:
        return _nearest_of_few(places_m, positions_m, float(within_m), threads)
    found = cKDTree(places_m).query(positions_m, k=count, distance_upper_bound=within_m, workers=threads)
    distance = np.asarray(found[0], dtype=np.float64).reshape(len(positions_m), count)
    index = np.asarray(found[1], dtype=np.int64).reshape(len(positions_m), count)
    return distance, np.where(np.isfinite(distance), index, 0)


def _nearest_of_few(places_m: Floats, positions_m: Floats, within_m: float, threads: int) -> tuple[Floats, Ints]:
    places, positions = (np.ascontiguousarray(a, dtype=np.float64) for a in (places_m.T, positions_m))
    if not (np.isfinite(places).all() and np.isfinite(positions).all()):
        raise ValueError("a coordinate is not finite")
    distance, index = np.empty((len(positions), 1)), np.empty((len(positions), 1), dtype=np.int64)
    in_ranges(
        threads,
        len(positions),
        lambda lo, hi: _find_nearest(places, positions[lo:hi], within_m, distance[lo:hi], index[lo:hi]),
    )
    return distance, index


@njit(cache=True, nogil=True)
def _find_nearest(places: Any, positions: Any, within: float, distance: Any, index: Any) -> None:
    """Find the nearest of places (d, k) to each of positions (n, d), if any is nearer than `within`."""
    d2 = np.empty(places.shape[1])
    for n in range(len(positions)):
        d2[:] = 0.0
        for axis in range(places.shape[0]):
            at = positions[n, axis]
            for k in range(places.shape[1]):
                d2[k] += (places[axis, k] - at) ** 2
        best = np.argmin(d2)
        away = math.sqrt(d2[best])
        is_near = away < within
        distance[n, 0], index[n, 0] = away if is_near else np.inf, best if is_near else 0


def nearest_sorted(values: Ints | Floats, wanted: Ints | Floats) -> Ints:
    """Indices (m,) of the values (n,), ascending and at least one, that are nearest to `wanted` (m,)."""
    after = np.clip(np.searchsorted(values, wanted), 1, max(len(values) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(values) - 1)
    result: Ints = np.where(np.abs(wanted - values[before]) <= np.abs(values[after] - wanted), before, after)
    return result
