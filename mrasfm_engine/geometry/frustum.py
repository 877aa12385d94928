"""Overlap of the fields of view of two cameras."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.geometry.camera_model import project, unproject_pixels
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Floats, Ints

GRID = (5, 3)  # rays sampled across and down an image
DEPTH_FRACTIONS = (0.08, 0.2, 0.45, 1.0)  # of the maximal depth: what is near weighs more


def frustum_samples(kind: int, params: Floats, width: int, height: int, max_depth_m: float) -> Floats:
    """Points (s, 3) in camera axes spread over the camera's viewing frustum."""
    u = (np.arange(GRID[0]) + 0.5) / GRID[0] * width
    v = (np.arange(GRID[1]) + 0.5) / GRID[1] * height
    rays = unproject_pixels(kind, params, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    result: Floats = (rays[None] * (max_depth_m * np.array(DEPTH_FRACTIONS))[:, None, None]).reshape(-1, 3)
    return result


@njit(cache=True, nogil=True)
def _seen_fractions(
    pairs: Any,
    world_from_cam: Any,
    camera: Any,
    kind: Any,
    params: Any,
    size: Any,
    samples: Any,
    max_depth: float,
    out: Any,
) -> None:
    work, pixel = np.empty(6), np.empty(8)
    x, y = np.empty(3), np.empty(3)
    for n in range(len(pairs)):
        a, b = pairs[n, 0], pairs[n, 1]
        ca, cb = camera[a], camera[b]
        ma, mb = world_from_cam[a], world_from_cam[b]
        seen = 0
        for s in range(samples.shape[1]):
            for i in range(3):
                x[i] = ma[i, 3] - mb[i, 3]
                for j in range(3):
                    x[i] += ma[i, j] * samples[ca, s, j]
            for i in range(3):
                y[i] = mb[0, i] * x[0] + mb[1, i] * x[1] + mb[2, i] * x[2]
            if y[0] * y[0] + y[1] * y[1] + y[2] * y[2] > (1.3 * max_depth) ** 2:
                continue
            if not project(kind[cb], params[cb], y[0], y[1], y[2], work, pixel):
                continue
            if 0 <= pixel[0] < size[cb, 0] and 0 <= pixel[1] < size[cb, 1]:
                seen += 1
        out[n] = seen / samples.shape[1]


def view_overlap(
    pairs: Ints,
    *,
    world_from_cam: Floats,
    camera: Ints,
    kind: Ints,
    params: Floats,
    size_px: Ints,
    max_depth_m: float,
) -> Floats:
    """Overlap (n,) of image pairs, 0 to 1: geometric mean of the shares of either frustum that the other camera sees.

    Parameters
    ----------
    pairs
        Indices (n, 2) into the images.
    world_from_cam, camera
        Pose (images, 4, 4) and camera index (images,) of every image.
    kind, params, size_px
        Of every camera: see `geometry.camera_model`; width and height (cameras, 2).
    max_depth_m
        Where frustums end.
    """
    samples = np.stack(
        [
            frustum_samples(int(k), p, int(w), int(h), max_depth_m)
            for k, p, (w, h) in zip(kind, params, size_px, strict=True)
        ]
    )
    return mutual_overlap(
        pairs,
        world_from_cam=world_from_cam,
        camera=camera,
        kind=kind,
        params=params,
        size_px=size_px,
        samples=samples,
        max_depth_m=max_depth_m,
    )


def mutual_overlap(
    pairs: Ints,
    *,
    world_from_cam: Floats,
    camera: Ints,
    kind: Ints,
    params: Floats,
    size_px: Ints,
    samples: Floats,
    max_depth_m: float,
) -> Floats:
    """As `view_overlap`, of any samples of what the cameras see.

    Parameters
    ----------
    samples
        Points (cameras, s, 3) in every camera's axes; the rest as in `view_overlap`.
    """
    seen = np.empty((2, len(pairs)))
    for out, directed in zip(seen, (pairs, pairs[:, ::-1]), strict=True):
        _seen_fractions(
            np.ascontiguousarray(directed), world_from_cam, camera, kind, params, size_px, samples, max_depth_m, out
        )
    result: Floats = np.sqrt(seen[0] * seen[1])
    return result
