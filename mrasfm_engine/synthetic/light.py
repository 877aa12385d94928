"""Time of day: the sun, the sky and the shadows of everything that does not move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.synthetic.atlas import Atlas
from mrasfm_engine.synthetic.mesh import Mesh
from mrasfm_engine.synthetic.rasteriser import rasterise_linear
from mrasfm_engine.types import Floats, Floats32

_CELL_M = 0.07
_MAX_CELLS = 5000  # a side


@dataclass(frozen=True, kw_only=True)
class Light:
    """Illumination of one drive; colours are intensities of a white surface."""

    to_sun: Floats  # (3,) unit vector in the world
    sun: Floats  # (3,)
    sky: Floats  # (3,)
    haze: Floats  # (3,) in square-root intensities, as are the next two
    zenith: Floats  # (3,)
    glow: Floats  # (3,)
    haze_m: float
    cloudiness: float
    gain: float  # of the camera's exposure

    def packed(self, shadow_strength: float) -> Floats:
        """The array (7, 3) that the shading kernel takes."""
        return np.array(
            [
                self.to_sun,
                self.sun,
                self.sky,
                self.haze,
                self.zenith,
                [self.haze_m, shadow_strength, self.cloudiness],
                self.glow,
            ]
        )


@dataclass(frozen=True, kw_only=True)
class ShadowMap:
    """Depth seen from the sun."""

    sun_from_world: Floats  # (3, 4): x and y across, z towards the sun
    frame: Floats  # (3,): x and y of the corner, cell size
    depth: Floats32  # (rows, columns)


def daylight(rng: np.random.Generator) -> Light:
    """Some hour of a clear day."""
    elevation, azimuth = np.radians(rng.uniform(32.0, 58.0)), rng.uniform(0, 2 * np.pi)
    warm = float(rng.uniform(0.0, 1.0))
    strength = float(rng.uniform(0.75, 0.95))
    return Light(
        to_sun=np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]),
        sun=strength * np.array([1.0, 0.96 - 0.05 * warm, 0.9 - 0.12 * warm]),
        sky=np.array([0.50, 0.54, 0.6]) * float(rng.uniform(0.9, 1.1)),
        haze=np.array([0.83, 0.87, 0.92]),
        zenith=np.array([0.42, 0.6, 0.86]),
        glow=np.array([0.3, 0.27, 0.2]),
        haze_m=float(rng.uniform(700.0, 1200.0)),
        cloudiness=float(rng.uniform(0.3, 0.8)),
        gain=1.2 * float(np.exp(rng.normal(0.0, 0.07))),
    )


def dusk(light: Light) -> Light:
    """The same place late under clouds: the sun is low and faint, what light there is comes from all over the sky."""
    level = light.to_sun[:2] / np.hypot(light.to_sun[0], light.to_sun[1])
    low = np.radians(18.0)
    return replace(
        light,
        to_sun=np.array([*(np.cos(low) * level), np.sin(low)]),
        sun=0.2 * light.sun * np.array([1.0, 0.8, 0.6]),
        sky=0.75 * light.sky * np.array([0.95, 0.95, 1.1]),
        cloudiness=1.0,
        gain=0.8 * light.gain,
    )


def along_street(light: Light, heading_rad: float) -> Light:
    """The same light with the sun within 15 degrees of the street's direction, ahead or behind as it was before."""
    azimuth = float(np.arctan2(light.to_sun[1], light.to_sun[0])) - heading_rad
    behind = np.cos(azimuth) < 0
    off = np.radians(15.0) * np.sin(azimuth)
    turned = heading_rad + (np.pi - off if behind else off)
    level = float(np.hypot(light.to_sun[0], light.to_sun[1]))
    return replace(light, to_sun=np.array([level * np.cos(turned), level * np.sin(turned), light.to_sun[2]]))


def cast_shadows(mesh: Mesh, atlas: Atlas, to_sun: Floats) -> ShadowMap:
    """The shadow map of a mesh under parallel light."""
    keep = np.flatnonzero(mesh.casts_shadow)
    # Any axis will do that the sun is not on.
    across = np.cross([0.0, 0.0, 1.0] if abs(to_sun[2]) < 0.99 else [1.0, 0.0, 0.0], to_sun)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(to_sun, across), to_sun])
    o, u, v = (x[keep] @ rotation.T for x in (mesh.origin, mesh.u, mesh.v))
    corners = np.stack([o, o + u, o + v, np.where(mesh.is_triangle[keep, None], o, o + u + v)], 1)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    cell = max(_CELL_M, float((high - low)[:2].max()) / _MAX_CELLS)
    # The kernel draws positive depth keys only.
    shift = 10.0 - low[2]
    det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    flat = np.abs(det) > 1e-6
    o, u, v, det, keep, corners = o[flat], u[flat], v[flat], det[flat], keep[flat], corners[flat]
    plane = np.zeros((len(o), 4, 3))
    plane[:, 0, 0], plane[:, 0, 1] = v[:, 1] / det, -v[:, 0] / det
    plane[:, 1, 0], plane[:, 1, 1] = -u[:, 1] / det, u[:, 0] / det
    for row in (0, 1):
        plane[:, row, 2] = -(plane[:, row, 0] * o[:, 0] + plane[:, row, 1] * o[:, 1])
    plane[:, 2, 2] = 1.0
    plane[:, 3] = plane[:, 0] * u[:, 2:] + plane[:, 1] * v[:, 2:]
    plane[:, 3, 2] += o[:, 2] + shift
    columns, rows = (int(n) for n in np.ceil((high - low)[:2] / cell) + 1)
    bounds = np.concatenate(
        [
            np.floor((corners.min(1)[:, :2] - low[:2]) / cell - 0.5),
            np.ceil((corners.max(1)[:, :2] - low[:2]) / cell - 0.5),
        ],
        1,
    )
    bounds = np.clip(bounds, 0, [columns - 1, rows - 1, columns - 1, rows - 1]).astype(np.int32)
    depth = np.zeros((rows, columns), np.float32)
    rasterise_linear(
        np.arange(len(o)),
        plane,
        bounds,
        mesh.is_triangle[keep],
        mesh.has_alpha[keep],
        np.full(len(o), 2, np.int32),
        mesh.texture[keep],
        mesh.texture_uv[keep],
        atlas.texels,
        atlas.offset,
        atlas.log2_width,
        atlas.log2_height,
        np.array([low[0] + 0.5 * cell, cell, low[1] + 0.5 * cell, cell]),
        depth,
        np.empty((rows, columns), np.int32),
    )
    sun_from_world = np.concatenate([rotation, [[0.0], [0.0], [shift]]], 1)
    return ShadowMap(sun_from_world=sun_from_world, frame=np.array([low[0], low[1], cell]), depth=depth)
