"""Turn and focal length by which two lens models of one camera differ.

A principal point that is estimated takes up a turn of the camera, and distortion a part of its focal length: both are
nearly the same in the images. So cameras of drives that estimate lenses compare with those of others, whose lenses are
as given, only by where their pixels look.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points, unproject_pixels
from mrasfm_engine.types import Floats
from schemas import Camera

GRID = (16, 12)  # columns and rows of pixels that are compared
MIN_PIXELS = 12


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Lens model of a camera (see `geometry.camera_model`), and the size of its images."""

    kind: int
    params: Floats
    size_px: Floats  # (2,)

    @staticmethod
    def from_camera(camera: Camera, params: list[float] | None = None) -> Lens:
        """The lens of a camera, or of one with other parameters of its model."""
        kind, packed = pack_camera(camera.model, camera.params if params is None else params)
        return Lens(kind=kind, params=packed, size_px=np.array([camera.width, camera.height], dtype=np.float64))

    @property
    def pixels(self) -> Floats:
        """Pixels (n, 2) all over the image, the same ones in images of another size."""
        across, down = (np.arange(count) + 0.5 for count in GRID)
        shares = np.stack(np.meshgrid(across / GRID[0], down / GRID[1]), axis=-1).reshape(-1, 2)
        result: Floats = shares * self.size_px
        return result


def turn_and_length(lens: Lens, reference: Lens) -> Floats:
    """Rotation vector (rad) and logarithm of a factor on the focal length (4,) with which a reference lens is a lens.

    Pixels then look where those of the lens do, as nearly as they can. The rotation is that of camera axes behind the
    reference lens in those behind the lens.
    """
    if (lens.kind, *lens.params, *lens.size_px) == (reference.kind, *reference.params, *reference.size_px):
        return np.zeros(4)
    rays, pixels = unproject_pixels(lens.kind, lens.params, lens.pixels), reference.pixels
    shown = np.isfinite(project_points(reference.kind, reference.params, rays)).all(axis=1)
    if shown.sum() < MIN_PIXELS:
        return np.zeros(4)
    rays, pixels, centre = rays[shown], pixels[shown], reference.params[2:4]

    def errors_px(step: Floats) -> Floats:
        seen = project_points(reference.kind, reference.params, rays @ se3.exp_so3(step[:3]))
        errors: Floats = np.nan_to_num(centre + np.exp(step[3]) * (seen - centre) - pixels).ravel()
        return errors

    found: Floats = least_squares(errors_px, np.zeros(4)).x
    return found
