"""Maxima between samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MIN_BEND = 1e-6  # of samples that bend less, rounding would determine the place


def vertex(before: NDArray[np.floating], at: NDArray[np.floating], after: NDArray[np.floating]) -> NDArray[np.floating]:
    """Positions (...) of the maxima of parabolas through samples at -1, 0 and 1, within -0.5 and 0.5.

    It is 0 where they hardly bend, or bend upwards.
    """
    bend = before - 2 * at + after
    flat = bend > -MIN_BEND
    offset: NDArray[np.floating] = np.clip(0.5 * (before - after) / np.where(flat, -1.0, bend), -0.5, 0.5)
    return np.where(flat, 0.0, offset)
