"""Exposure of images and cameras relative to one another, from what they show of the same points and ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import mapped
from mrasfm_engine.scene.scene import Scene, observed_colors
from mrasfm_engine.types import Floats
from mrasfm_engine.visualization.mosaic import Mosaic
from mrasfm_engine.visualization.views import REFINED

ROUNDS = 6
COLOURS_AT_ONCE = 2
SHRINKAGE = 20.0  # observations that the guess "as bright as all others" counts for
MAX_GAIN = 4.0
MAX_CAMERA_GAIN = 1.4
EVERY_CELL = 3  # of the mosaic, in rows and columns, is compared
MIN_CELLS = 200
LOG_COLOR = np.log(np.maximum(np.arange(256.0), 2.0))
DARK, SATURATED = 8, 247  # colours beyond carry no information on the exposure


def exposure_gains(scene: Scene) -> Floats:
    """Factors (images, 3) on red, green and blue that make all images of the scene equally bright; 1 where unknown.

    The logarithm of an observation's colour is that of its point plus that of its image's exposure: alternately the
    mean over every point and the median over every image.
    """
    image = scene.observation_image
    gains = np.ones((len(scene.drive.images), 3))
    if not len(image):
        return gains
    order = np.argsort(image, kind="stable")
    colors = observed_colors(scene.features, image, scene.observation_keypoint)[order]
    point = scene.observation_point[order]
    images, start = np.unique(image[order], return_index=True)
    bounds = np.append(start, len(image))
    count = np.maximum(np.bincount(point), 1)
    colours = 1 if (colors == colors[:, :1]).all() else 3

    def gains_of(k: int) -> Floats:
        exposure = _exposures(LOG_COLOR[colors[:, k]], point, count, bounds)
        result: Floats = np.clip(np.exp(-exposure), 1 / MAX_GAIN, MAX_GAIN)
        return result

    # Not all colours at once: logarithms and their means take most of the memory.
    gains[images] = np.stack(list(mapped(COLOURS_AT_ONCE, gains_of, range(colours))), axis=1)
    return gains


@njit(cache=True, nogil=True)
def _exposures(log_color: Any, point: Any, count: Any, bounds: Any) -> Any:
    """Exposures (i,) of images whose observations (n,), of points with so many (p,), lie between bounds (i + 1,)."""
    images = len(bounds) - 1
    exposure, mean = np.zeros(images), np.zeros(len(count))
    for _ in range(ROUNDS):
        mean[:] = 0.0
        for i in range(images):
            for n in range(bounds[i], bounds[i + 1]):
                mean[point[n]] += log_color[n] - exposure[i]
        mean /= count
        for i in range(images):
            lo, hi = bounds[i], bounds[i + 1]
            exposure[i] = np.median(log_color[lo:hi] - mean[point[lo:hi]]) * (hi - lo) / (hi - lo + SHRINKAGE)
        exposure -= exposure.mean()
    return exposure


def camera_gains(mosaic: Mosaic) -> Floats:
    """Factors (cameras,) that make the cameras equally bright where two of them show the same ground.

    Cameras have few points in common, and much ground. One factor for all colours: what is saturated stays white.
    """
    owner = mosaic.owner[:, ::EVERY_CELL, ::EVERY_CELL]
    color = mosaic.color[REFINED][:, ::EVERY_CELL, ::EVERY_CELL]
    count = int(owner.max(initial=0))
    clear = (owner > 0).all(axis=0) & ((color > DARK) & (color < SATURATED)).all(axis=(0, 3))
    a, b = owner[0][clear].astype(np.int64) - 1, owner[1][clear].astype(np.int64) - 1
    ratio = np.log(color[0][clear] / color[1][clear].astype(np.float64))
    h, g = 1e-3 * np.eye(count), np.zeros(count)
    pair = a * count + b
    for key in np.unique(pair):
        rows = pair == key
        if rows.sum() < MIN_CELLS:
            continue
        i, j = int(key) // count, int(key) % count
        row = np.zeros(count)
        row[i], row[j] = 1.0, -1.0
        h += np.outer(row, row)
        g += row * np.median(ratio[rows])
    gains: Floats = np.clip(np.exp(-np.linalg.solve(h, g)), 1 / MAX_CAMERA_GAIN, MAX_CAMERA_GAIN)
    return gains
