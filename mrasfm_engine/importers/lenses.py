"""Camera models of recordings by the names and the order of coefficients that OpenCV, ROS and Kalibr have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.recording import PIXEL_CENTER_PX

# Coefficients: k1, k2, p1, p2, k3; then k4 to k6, and the thin prism and the tilt of OpenCV, which no camera here has.
RADIAL_MODELS = ("plumb_bob", "rational_polynomial", "", "none")
FISHEYE_MODELS = ("equidistant", "fisheye")
_PINHOLE_COEFFICIENTS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A camera model with its parameters, in a manifest's convention."""

    model: str
    params: list[float]


def lens_from_distortion(params: Sequence[float], model: str, coefficients: Sequence[float], *, where: str) -> Lens:
    """The camera model of a distortion by its name in ROS or Kalibr.

    Parameters
    ----------
    params
        fx, fy, cx, cy in a manifest's convention.

    Raises
    ------
    InputError
        If the model is not known, or has terms that no model of a manifest has.
    """
    d = [float(value) for value in coefficients]
    if not np.isfinite(d).all():
        raise InputError(f"{where}: a coefficient of distortion is not finite", remedy="Calibrate the camera.")
    if model in FISHEYE_MODELS:
        if len(d) != 4:
            raise _unknown_distortion(where, model, f"has {len(d)} coefficients instead of 4")
        return Lens(model="OPENCV_FISHEYE", params=[*params, *d])
    if model not in RADIAL_MODELS:
        raise _unknown_distortion(where, model, "is not known")
    if len(d) not in _PINHOLE_COEFFICIENTS:
        raise _unknown_distortion(where, model, f"has {len(d)} coefficients")
    if any(d[8:]):
        raise _unknown_distortion(where, model, "has terms of a thin prism or a tilted sensor")
    if not any(d):
        return Lens(model="PINHOLE", params=[*params])
    if not any(d[4:]):
        return Lens(model="OPENCV", params=[*params, *d[:4]])
    return Lens(model="FULL_OPENCV", params=[*params, *d[:8], *[0.0] * (8 - len(d[:8]))])


def _unknown_distortion(where: str, model: str, what: str) -> InputError:
    return InputError(
        f"{where}: distortion model {model!r} {what}",
        remedy="Known are plumb_bob, rational_polynomial and equidistant: calibrate with one of them and give it with "
        "--calibration, or record rectified images.",
        code="unknown-distortion",
    )


def kalibr_params(intrinsics: Sequence[float]) -> list[float]:
    """Parameters fx, fy, cx, cy in a manifest's convention from Kalibr's, which counts from pixel centres."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return [fx, fy, cx + PIXEL_CENTER_PX, cy + PIXEL_CENTER_PX]
