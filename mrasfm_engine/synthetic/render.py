"""Renderer: image, semantic mask and depth of a scene from a camera pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.atlas import Atlas
from mrasfm_engine.synthetic.cameras import ideal_map
from mrasfm_engine.synthetic.light import Light, ShadowMap
from mrasfm_engine.synthetic.mesh import Label, Mesh
from mrasfm_engine.synthetic.rasteriser import prepare_perspective, rasterise_linear, rasterise_mapped
from mrasfm_engine.synthetic.rigs import TrueCamera
from mrasfm_engine.synthetic.sensor import expose
from mrasfm_engine.synthetic.shading import shade
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32

_SAMPLES = 2  # a side of each pixel's sample grid
_MOVES = 0x80  # beside a label: what has it drives


@dataclass(frozen=True, kw_only=True)
class View:
    """A rendered image; `intensity` is in square-root intensities before exposure."""

    intensity: Floats32  # (h, w, 3) red, green, blue; 1 is white
    labels: Bytes  # (h, w) Cityscapes train ids
    is_moving: Bools  # (h, w) what is seen drives
    depth_m: Floats32  # (h, w) along the camera's z axis at pixel centres, inf for sky


class Lens:
    """A camera with the ray of every pixel worked out."""

    def rows(self, first: int, stop: int) -> Lens:
        """The same lens before a sensor of some rows only."""
        fx, fy, cx, cy, *distortion = self.camera.params
        return Lens(replace(self.camera, height=stop - first, params=(fx, fy, cx, cy - first, *distortion)))

    def __init__(self, camera: TrueCamera) -> None:
        self.camera = camera
        w, h, model, params = camera.width, camera.height, camera.model, camera.params
        self.pixels = ideal_map(model, params, width=w, height=h)
        self.samples: Floats | None = None
        # Where ideal coordinates are linear in the pixel: x0, dx, y0, dy of the sample grid.
        fx, fy, cx, cy = params[:4]
        dx, dy = 1 / (fx * _SAMPLES), 1 / (fy * _SAMPLES)
        self.linear = np.array([0.5 * dx - cx / fx, dx, 0.5 * dy - cy / fy, dy])
        if model == "PINHOLE":
            span = [self.linear[0], self.linear[2]]
            end = [span[0] + dx * (w * _SAMPLES - 1), span[1] + dy * (h * _SAMPLES - 1)]
            self.window = np.array([*span, *end])
        else:
            self.samples = ideal_map(model, params, width=w, height=h, samples=_SAMPLES)
            self.window = np.array([*self.samples.min((0, 1)), *self.samples.max((0, 1))])
            self._columns = _inverse_table(self.samples[..., 0], axis=1)
            self._rows = _inverse_table(self.samples[..., 1], axis=0)
        r = np.hypot(*(np.indices((h, w)) + 0.5 - np.array([cy, cx])[:, None, None])) / (0.5 * np.hypot(w, h))
        self.vignetting = (1 / (1 + 0.16 * r**2) ** 2).astype(np.float32)

    def sample_bounds(self, bounds: Floats) -> NDArray[np.int32]:
        """Boxes (n, 4) of the sample grid, first column, first row, last column, last row, of ideal boxes (n, 4)."""
        width, height = self.camera.width * _SAMPLES, self.camera.height * _SAMPLES
        if self.samples is None:
            x0, dx, y0, dy = self.linear
            low = np.ceil((bounds[:, :2] - [x0, y0]) / [dx, dy] - 1e-9)
            high = np.floor((bounds[:, 2:] - [x0, y0]) / [dx, dy] + 1e-9)
        else:
            low = np.stack([self._columns[0](bounds[:, 0]), self._rows[0](bounds[:, 1])], -1)
            high = np.stack([self._columns[1](bounds[:, 2]), self._rows[1](bounds[:, 3])], -1)
        limits = [width - 1, height - 1]
        return np.concatenate([np.clip(low, 0, limits), np.clip(high, -1, limits)], 1).astype(np.int32)


class _Table:
    """A monotonic lookup from ideal coordinates to columns or rows."""

    def __init__(self, keys: Floats) -> None:
        self._keys = keys

    def __call__(self, values: Floats) -> Floats:
        return np.interp(values, self._keys, np.arange(len(self._keys)))


class _First(_Table):
    def __call__(self, values: Floats) -> Floats:
        return np.floor(super().__call__(values)) - 1


class _Last(_Table):
    def __call__(self, values: Floats) -> Floats:
        return np.ceil(super().__call__(values)) + 1


def _inverse_table(ideal: Floats, axis: int) -> tuple[_First, _Last]:
    """First and last column (or row) that can hold an ideal coordinate, whatever the other coordinate is."""
    highest = np.maximum.accumulate(ideal.max(1 - axis))
    lowest = np.minimum.accumulate(ideal.min(1 - axis)[::-1])[::-1]
    return _First(highest), _Last(lowest)


def render(
    mesh: Mesh,
    atlas: Atlas,
    lens: Lens,
    world_from_cam: Floats,
    *,
    light: Light,
    shadows: ShadowMap,
    shadow_strength: float,
    moving_boxes: Floats,
    sky_texture: int,
) -> View:
    """Draw one image.

    Parameters
    ----------
    mesh, atlas
        Everything there is, where it is at the image's instant, and its textures.
    lens
        The camera.
    world_from_cam
        Its pose (4, 4): x right, y down, z forward.
    light, shadows, shadow_strength
        Illumination, shadows of what stands still, and how dark shadows are (0..1).
    moving_boxes
        Casters (k, 8) that move, as `objects.shadow_boxes` gives them.
    sky_texture
        Clouds, an index into the atlas.
    """
    w, h = lens.camera.width, lens.camera.height
    count = len(mesh)
    plane, bounds, nearest = np.empty((count, 4, 3)), np.empty((count, 4)), np.empty(count)
    cam_from_world = se3.inverse(world_from_cam)
    prepare_perspective(
        mesh.origin, mesh.u, mesh.v, mesh.is_triangle, cam_from_world, lens.window, plane, bounds, nearest
    )
    seen = np.flatnonzero(bounds[:, 0] <= bounds[:, 2])
    # Near things first: what they hide is not drawn.
    order = seen[np.argsort(nearest[seen], kind="stable")]
    pixel_bounds = np.zeros((count, 4), np.int32)
    pixel_bounds[seen] = lens.sample_bounds(bounds[seen])
    depth = np.zeros((h * _SAMPLES, w * _SAMPLES), np.float32)
    index = np.full((h * _SAMPLES, w * _SAMPLES), -1, np.int32)
    textures = (atlas.texels, atlas.offset, atlas.log2_width, atlas.log2_height)
    looks = (mesh.is_triangle, mesh.has_alpha, _alpha_levels(mesh, atlas, lens, nearest), mesh.texture, mesh.texture_uv)
    if lens.samples is None:
        rasterise_linear(order, plane, pixel_bounds, *looks, *textures, lens.linear, depth, index)
    else:
        rasterise_mapped(order, plane, pixel_bounds, *looks, *textures, lens.samples, depth, index)
    view = View(
        intensity=np.empty((h, w, 3), np.float32),
        labels=np.empty((h, w), np.uint8),
        is_moving=np.zeros((h, w), np.bool_),
        depth_m=np.empty((h, w), np.float32),
    )
    shade(
        index,
        lens.pixels,
        plane,
        world_from_cam,
        mesh.texture,
        mesh.texture_uv,
        mesh.detail,
        mesh.detail_uv,
        mesh.tint,
        mesh.normal,
        np.where(mesh.is_moving, mesh.label | _MOVES, mesh.label).astype(np.uint8),
        mesh.is_moving,
        *textures,
        atlas.levels,
        light.packed(shadow_strength),
        shadows.sun_from_world,
        shadows.depth,
        shadows.frame,
        moving_boxes,
        sky_texture,
        view.intensity,
        view.labels,
        view.depth_m,
    )
    view.is_moving[:] = (view.labels & _MOVES) > 0
    view.labels[:] &= _MOVES - 1
    view.depth_m[view.labels == Label.SKY] = np.inf
    return view


def _alpha_levels(mesh: Mesh, atlas: Atlas, lens: Lens, nearest: Floats) -> NDArray[np.int32]:
    """The mip level at which each primitive's holes are looked up: samples and texels of about the same size."""
    texels = (1 << atlas.log2_width[mesh.texture]) * np.abs(mesh.texture_uv[:, 2]).clip(1e-6)
    focal = lens.camera.params[0] * _SAMPLES
    samples = focal * np.linalg.norm(mesh.u, axis=1) / np.clip(nearest, 0.5, 1e6)
    level = np.floor(np.log2(np.maximum(texels / samples, 1e-6)))
    # Coarser than 16 texels a side, holes are gone.
    finest = np.minimum(atlas.log2_width, atlas.log2_height)[mesh.texture] - 4
    result: NDArray[np.int32] = np.clip(level, 0, np.maximum(finest, 0)).astype(np.int32)
    return result


def develop(view: View, lens: Lens, *, gain: float, noise: float, blur_px: float, rng: np.random.Generator) -> Bytes:
    """The 8 bit image (h, w, 3), red first, that a sensor makes of a view.

    Parameters
    ----------
    view, lens
        What falls on the sensor, through what.
    gain
        Factor of exposure on square-root intensities.
    noise
        1 is a good sensor in daylight, 0 none.
    blur_px
        Standard deviation of the point spread function.
    rng
        Source of the noise.
    """
    image = view.intensity
    if blur_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.float32)
    out = np.empty(image.shape, np.uint8)
    seed = int(rng.integers(1, 2**40))
    expose(image, lens.vignetting, gain, 0.022 * noise, 0.004 * noise, seed, out)
    return out
