"""The vehicle's own bonnet and boot lid before its front and back cameras: curved, painted, and mirroring.

Both are ellipsoids that are fixed in the rig frame, so that rays meet them in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mrasfm_engine.synthetic.cameras import project
from mrasfm_engine.synthetic.light import Light
from mrasfm_engine.synthetic.render import Lens, View
from mrasfm_engine.types import Bools, Floats, Floats32

UNLABELLED = 19  # Cityscapes has no train id for the vehicle that carries the cameras

# A grazing ray is mirrored like this share of it by clear varnish (refractive index 1.5) seen from above.
_REFLECTANCE = 0.04
_SHININESS = 400.0  # of Phong's highlight: a sun that is 4 degrees across in the paint
_PAINTS = np.array([[0.55, 0.57, 0.6], [0.32, 0.05, 0.05], [0.07, 0.09, 0.2], [0.03, 0.03, 0.03]])  # of the light


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """An ellipsoid in the rig frame."""

    centre_m: tuple[float, float, float]
    half_axes_m: tuple[float, float, float]


_PANELS = {
    "front": _Panel(centre_m=(2.6, 0.0, 0.6), half_axes_m=(1.8, 1.2, 0.6)),
    "back": _Panel(centre_m=(-0.9, 0.0, 0.55), half_axes_m=(1.0, 1.1, 0.62)),
}


@dataclass(frozen=True, kw_only=True)
class OwnCar:
    """One camera's view of its vehicle: the same pixels in every image."""

    mask: Bools  # (h, w)
    depth_m: Floats32  # (h, w) along the camera's z axis; of pixels of the mask
    normal_cam: Floats  # (h, w, 3)
    mirrored_cam: Floats  # (h, w, 3) directions that the paint mirrors
    reflectance: Floats  # (h, w)
    paint: Floats  # (3,) share of the light that it scatters

    def drawn_over(self, view: View, lens: Lens, light: Light, world_from_cam: Floats) -> View:
        """The view with the panel in front.

        The paint mirrors what the camera itself sees in the mirrored direction, as if it were far away; of directions
        out of view, what is at the border of the image.
        """
        sun_cam = world_from_cam[:3, :3].T @ light.to_sun
        diffuse = np.maximum(self.normal_cam @ sun_cam, 0.0)[..., None] * light.sun + 0.6 * light.sky
        highlight = np.maximum(self.mirrored_cam @ sun_cam, 0.0)[..., None] ** _SHININESS * light.sun
        mirrored = _seen_along(self.mirrored_cam, view, lens) ** 2
        share = self.reflectance[..., None]
        paint = np.sqrt((1 - share) * self.paint * diffuse + share * mirrored + highlight)
        return replace(
            view,
            intensity=np.where(self.mask[..., None], paint, view.intensity).astype(np.float32),
            labels=np.where(self.mask, np.uint8(UNLABELLED), view.labels),
            depth_m=np.where(self.mask, self.depth_m, view.depth_m),
            is_moving=view.is_moving & ~self.mask,
        )


def own_car_before(lens: Lens, rng: np.random.Generator) -> OwnCar | None:
    """The bonnet before the front camera or the boot lid before the back camera; None before all others.

    Parameters
    ----------
    rng
        Draws the paint and how high the panel reaches, within 3 cm.
    """
    panel = _PANELS.get(lens.camera.name)
    if panel is None:
        return None
    centre = np.array(panel.centre_m) + np.array([0.0, 0.0, rng.uniform(-0.03, 0.03)])
    half = np.array(panel.half_axes_m)
    rig_from_cam = lens.camera.rig_from_cam
    rays = np.concatenate([lens.pixels, np.ones((*lens.pixels.shape[:2], 1))], -1) @ rig_from_cam[:3, :3].T
    # The ray's first point on the unit sphere that the ellipsoid is in scaled axes.
    start, step = (rig_from_cam[:3, 3] - centre) / half, rays / half
    a, b, c = (step**2).sum(-1), step @ start, start @ start - 1.0
    inside = b**2 - a * c
    depth = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
    mask = (inside > 0) & (depth > 0)
    normal = (start + depth[..., None] * step) / half
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    facing = np.clip(-(rays * normal).sum(-1), 0.0, 1.0)
    mirrored = rays + 2 * facing[..., None] * normal
    return OwnCar(
        mask=mask,
        depth_m=depth.astype(np.float32),
        normal_cam=normal @ rig_from_cam[:3, :3],
        mirrored_cam=mirrored @ rig_from_cam[:3, :3],
        reflectance=_REFLECTANCE + (1 - _REFLECTANCE) * (1 - facing) ** 5,  # Schlick's approximation of Fresnel's law
        paint=_PAINTS[rng.integers(len(_PAINTS))],
    )


def _seen_along(directions_cam: Floats, view: View, lens: Lens) -> Floats32:
    """Square-root intensities (h, w, 3) that a view shows in directions (h, w, 3)."""
    # What the paint mirrors from beside or behind the camera is taken from the border of the image on that side.
    ahead = directions_cam.copy()
    ahead[..., 2] = np.maximum(ahead[..., 2], 0.2)
    xy = project(lens.camera.model, lens.camera.params, ahead).astype(np.float32) - np.float32(0.5)
    return np.asarray(
        cv2.remap(view.intensity, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )
