"""The scale space of SIFT (Lowe, IJCV 2004, section 3): differences of Gaussians to find keypoints in, and gradients.

It is OpenCV's, pixel by pixel: the first octave is the image at twice its size. Gradients are those of every second
pixel along both axes. Each octave is smoothed by 2 of its pixels and more before anything is read from it, so that the
pixels between say the same, and a quarter of them is what directions and descriptors are made of.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from mrasfm_engine.types import Bytes, Floats32

LEVELS = 3  # of an octave in which there are keypoints; a level above and one below is what they are compared with
SIGMA_PX = 1.6  # smoothing at the beginning of an octave, in its pixels
IMAGE_SIGMA_PX = 0.5  # smoothing that an image is taken to have
SMALLEST_SIDE_PX = 12  # of an octave: keypoints stay off its border


class Gradients(NamedTuple):
    """Gradients of a level at every second of its octave's pixels.

    Attributes
    ----------
    step_px
        Distance of neighbours in pixels of the image.
    magnitude
        (h, w) grey values over two steps.
    direction_rad
        (h, w) from the x axis to the y axis, which points down; 0 to 2 pi.
    """

    step_px: float
    magnitude: Floats32
    direction_rad: Floats32


class Octave(NamedTuple):
    """One octave of the scale space.

    Attributes
    ----------
    step_px
        Side of its pixels in pixels of the image.
    differences
        (LEVELS + 2, h, w) of each level's grey values from those of the level below it.
    gradients
        LEVELS of them: of the levels 1 to LEVELS.
    """

    step_px: float
    differences: Floats32
    gradients: list[Gradients]


def scale_space(gray: Bytes) -> Iterator[Octave]:
    """Octaves of an image (h, w), the finest first; the centres of their top left pixels are that of the image's."""
    height, width = gray.shape
    # `cv2.resize` would put all keypoints 0.25 px too far right and down, which turns cameras by 0.02 deg against one
    # another.
    twice = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    base = cv2.warpAffine(gray.astype(np.float32), twice, (2 * width, 2 * height), borderMode=cv2.BORDER_REPLICATE)
    base = cv2.GaussianBlur(base, (0, 0), math.sqrt(SIGMA_PX**2 - (2.0 * IMAGE_SIGMA_PX) ** 2))
    step_px = 0.5
    while min(base.shape) >= SMALLEST_SIDE_PX:
        differences = np.empty((LEVELS + 2, *base.shape), np.float32)
        below, gradients = base, []
        for level in range(1, LEVELS + 3):
            smooth = cv2.GaussianBlur(below, (0, 0), _added_sigma_px(level))
            cv2.subtract(smooth, below, dst=differences[level - 1])
            if level <= LEVELS:
                halved = np.ascontiguousarray(smooth[::2, ::2])
                gradients.append(_gradients(halved, 2.0 * step_px))
            below = smooth
        yield Octave(step_px, differences, gradients)
        base, step_px = halved, 2.0 * step_px


def _added_sigma_px(level: int) -> float:
    """The smoothing that makes a level of the one below it."""
    return SIGMA_PX * math.sqrt(2.0 ** (2 * level / LEVELS) - 2.0 ** (2 * (level - 1) / LEVELS))


def _gradients(gray: Floats32, step_px: float) -> Gradients:
    along_x, along_y = (cv2.Sobel(gray, cv2.CV_32F, *axis, ksize=1) for axis in ((1, 0), (0, 1)))
    magnitude, direction_rad = cv2.cartToPolar(along_x, along_y)
    return Gradients(step_px, magnitude, direction_rad)
