"""Usual errors of lens models: what calibrations leave, in pixels, and the parameters that make it up."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.bundle_adjustment.problem import INTRINSICS
from mrasfm_engine.geometry.camera_model import FISHEYE
from mrasfm_engine.types import Floats

LENS_SIGMA_PX = 0.5  # RMS over pixels of what each parameter of a lens model is usually off by
NOTHING_SHOWN = 1e-9


def lens_sigmas(kind: int, params: Floats, pixels: Floats, rays: Floats) -> Floats:
    """Sigmas (INTRINSICS,) at which each parameter of a camera moves pixels by `LENS_SIGMA_PX`, RMS.

    Next to none where there are no pixels: a lens of which no image shows anything takes no part.

    Parameters
    ----------
    pixels, rays
        (n, 2) and (n, 3) viewing rays in camera axes.
    """
    if not len(pixels):
        return np.full(INTRINSICS, NOTHING_SHOWN)
    x, y = ((pixels - params[2:4]) / params[:2]).T
    r2 = x**2 + y**2
    if kind == FISHEYE:
        theta = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
        distortion = [theta**3, theta**5, theta**7, theta**9]
    else:
        distortion = [r2**1.5, r2**2.5, *(np.hypot(2 * x * y, r2 + 2 * z**2) for z in (y, x))]
    moved = np.array([r2**0.5, y, *distortion])
    by_parameter = np.sqrt((moved**2).mean(axis=1)) * params[:2].mean()
    by_parameter = np.insert(by_parameter, 2, [1.0, 1.0])  # the principal point's two, in pixels
    result: Floats = LENS_SIGMA_PX / np.maximum(by_parameter, 1e-6)
    return result
