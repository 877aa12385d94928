"""What roads have beside slopes: heights over a level plane at places x along and y across the way, in metres."""

from __future__ import annotations

from functools import partial

import numpy as np

MIDDLE_M = 30.0  # where along the way the bump is


def bump(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A speed bump of 10 cm over 4 m of the way."""
    away = np.abs(x - MIDDLE_M)
    return np.where(away < 2.0, 0.05 * (1 + np.cos(np.pi * away / 2.0)), 0.0) + 0 * y


def bay(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A parking bay, 12 m long, behind a kerb of 12 cm."""
    return np.where((np.abs(x - MIDDLE_M + 4.0) < 6.0) & (y > 2.5), 0.12, 0.0)


def crown(x: np.ndarray, y: np.ndarray, *, share: float) -> np.ndarray:
    """A road that falls to both sides."""
    return -share * np.abs(y) + 0 * x


SHAPES = {
    "speed bump of 10 cm": bump,
    "parking bay 12 cm up": bay,
    "crown of 2.5 %": partial(crown, share=0.025),
    "crown of 3.5 %": partial(crown, share=0.035),
}
