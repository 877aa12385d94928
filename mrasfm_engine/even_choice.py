"""Even choices of some of many items, the same at every run: a module of its own, as every room samples with them."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.types import Floats, Ints


def even_choice(count: int, most: int) -> Ints:
    """Rising indices (n,) of `most` of `count` items, or of all if these are fewer, evenly from the first to the last.

    Places between two items are rounded down.
    """
    return _even_places(count, most).astype(np.int64)


def nearest_even_choice(count: int, most: int) -> Ints:
    """Rising indices (n,) as of `even_choice`, rounded to the nearest: the same from either end, but for halves."""
    return _even_places(count, most).round().astype(np.int64)


def _even_places(count: int, most: int) -> Floats:
    return np.linspace(0, count - 1, min(count, most))
