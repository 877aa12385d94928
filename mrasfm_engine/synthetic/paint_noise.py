"""Random structure that textures are made of; every pattern here is periodic, so that textures tile without seams."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.types import Bools, Bytes, Floats32


def fractal(size: int, rng: np.random.Generator, *, coarsest: int = 4, octave_gain: float = 0.6) -> Floats32:
    """Noise (size, size) of standard deviation 1 with octaves from `size / coarsest` pixels down to single pixels."""
    cells = coarsest
    total = rng.standard_normal((cells, cells), dtype=np.float32)
    amplitude = 1.0
    while cells < size:
        # From octave to octave everything so far is enlarged, with a border from the other side.
        pad = np.pad(total, 2, mode="wrap")
        wide = np.asarray(cv2.resize(pad, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.float32)
        cells *= 2
        amplitude *= octave_gain
        total = wide[4 : 4 + cells, 4 : 4 + cells] + np.float32(amplitude) * rng.standard_normal(
            (cells, cells), dtype=np.float32
        )
    result: Floats32 = (total - total.mean()) / total.std()
    return result


def spots(
    size: int, rng: np.random.Generator, *, count: int, radius_px: tuple[float, float], strength: float
) -> Floats32:
    """A map (size, size) around 0 of discs and polygons, bright and dark, that corner detectors like."""
    canvas = np.zeros((size, size), np.float32)
    x, y = rng.integers(0, size, (2, count))
    radius = np.exp(rng.uniform(np.log(radius_px[0]), np.log(radius_px[1]), count))
    value = rng.normal(0, strength, count)
    for i in range(count):
        r = float(radius[i])
        corners = int(rng.integers(3, 8))
        angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
        outline = np.stack([np.cos(angle), np.sin(angle)], -1) * r * rng.uniform(0.6, 1.2, (corners, 1))
        # Spots across the border continue at the other side.
        for ox in (-size, 0, size) if x[i] < r * 1.2 or x[i] > size - r * 1.2 else (0,):
            for oy in (-size, 0, size) if y[i] < r * 1.2 or y[i] > size - r * 1.2 else (0,):
                points = np.round((outline + np.array([x[i] + ox, y[i] + oy])) * 16).astype(np.int32)
                cv2.fillPoly(canvas, [points], float(value[i]), cv2.LINE_8, 4)
    return canvas


def cracks(size: int, rng: np.random.Generator, *, count: int, length_px: float, strength: float) -> Floats32:
    """A map (size, size) of dark, thin, branching lines; 0 elsewhere. Lines end at the border."""
    canvas = np.zeros((size, size), np.float32)
    for _ in range(count):
        steps = int(rng.integers(8, 24))
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, steps))
        step = length_px / steps
        walk = rng.uniform(0, size, 2) + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1) * step, 0)
        points = np.round(walk * 16).astype(np.int32)
        cv2.polylines(canvas, [points], False, -strength, int(rng.integers(1, 3)), cv2.LINE_AA, 4)
    return canvas


def colourise(value: Floats32, colour: ArrayLike) -> Floats32:
    """A colour image (..., 3) that is `colour` times `1 + value`."""
    return (1.0 + value)[..., None] * np.asarray(colour, np.float32)


def to_bytes(image: Floats32) -> Bytes:
    """Clip and round to 8 bits."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def with_alpha(image: Bytes, alpha: Bools | Bytes) -> Bytes:
    """The image (h, w, 3) with a fourth channel: opaque where `alpha` is."""
    mask = np.asarray(alpha).astype(bool).astype(np.uint8) * 255
    return np.concatenate([image, mask[..., None]], 2)
