"""Sensor model: light becomes eight bits."""

from __future__ import annotations

import math
from typing import Any

from mrasfm_engine.jit import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def expose(image: Any, vignetting: Any, gain: float, shot: float, read: float, seed: int, out: Any) -> None:
    """Turn square-root intensities into 8 bits as a sensor does: exposure, lens fall-off, shot and read noise.

    `shot` and `read` are the standard deviations of white's shot noise and of the read noise, in parts of white.
    In square-root intensities y the linear noise sqrt(shot^2 y^2 + read^2) becomes itself over 2 y.
    """
    state = (seed * 2862933555777941757 + 3037000493) & 0x7FFFFFFFFFFFFFFF
    state |= 1
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            factor = gain * vignetting[row, col]
            for channel in range(3):
                y = image[row, col, channel] * factor
                if shot > 0 or read > 0:
                    state ^= (state << 13) & 0x7FFFFFFFFFFFFFFF
                    state ^= state >> 7
                    state ^= (state << 17) & 0x7FFFFFFFFFFFFFFF
                    # The sum of three uniform numbers is normal enough; its variance is 3 / 12.
                    total = (state & 0xFFFFF) + ((state >> 20) & 0xFFFFF) + ((state >> 40) & 0xFFFFF)
                    normal = (total / 1048576.0 - 1.5) * 2.0
                    dark = max(y, 0.06)
                    y += normal * math.sqrt(shot * shot * dark * dark + read * read) / (2.0 * dark)
                value = y * 255.0 + 0.5
                out[row, col, channel] = int(min(max(value, 0.0), 255.0))
