"""An image with structure at all scales."""

from __future__ import annotations

import cv2
import numpy as np


def textured(seed: int = 0, size: tuple[int, int] = (400, 300)) -> np.ndarray:
    """An image (h, w) of `size` (w, h)."""
    rng = np.random.default_rng(seed)
    image = np.zeros(size[::-1])
    for sigma in (1.5, 3.0, 6.0, 12.0, 24.0):
        noise = cv2.GaussianBlur(rng.normal(size=size[::-1]), (0, 0), sigma)
        image += noise / noise.std()
    return np.clip(128 + 40 * image, 0, 255).astype(np.uint8)
