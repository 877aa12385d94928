"""Textured parallelograms and triangles: what the renderer draws."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32


class Label(IntEnum):
    """Cityscapes' train ids that occur in synthetic masks."""

    ROAD = 0
    SIDEWALK = 1
    BUILDING = 2
    WALL = 3
    POLE = 5
    SIGN = 7
    VEGETATION = 8
    TERRAIN = 9
    SKY = 10
    CAR = 13
    TRUCK = 14


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """n flat primitives `origin + a * u + b * v`, with a, b in 0..1, and a + b <= 1 where `is_triangle`."""

    origin: Floats  # (n, 3)
    u: Floats  # (n, 3)
    v: Floats  # (n, 3)
    is_triangle: Bools  # (n,)
    texture: NDArray[np.int32]  # (n,) index into the atlas
    texture_uv: Floats32  # (n, 6): u, v at the origin, their change along a, their change along b
    detail: NDArray[np.int32]  # (n,) a second texture that multiplies the first, 128 being 1, or -1
    detail_uv: Floats32  # (n, 6)
    tint: Floats32  # (n, 3) multiplies the texture
    normal: Floats32  # (n, 3) for shading; zero: lit alike from everywhere
    label: Bytes  # (n,)
    has_alpha: Bools  # (n,) texels with alpha below one half are holes
    casts_shadow: Bools  # (n,)
    is_moving: Bools  # (n,)

    def __len__(self) -> int:
        return len(self.origin)

    def moved(self, a_from_b: Floats) -> Mesh:
        """The same mesh after a rigid transform."""
        r = a_from_b[:3, :3]
        return replace(
            self,
            origin=se3.apply(a_from_b, self.origin),
            u=self.u @ r.T,
            v=self.v @ r.T,
            normal=(self.normal @ r.T).astype(np.float32),
        )


def concatenate(meshes: list[Mesh]) -> Mesh:
    """One mesh of several."""
    return Mesh(**{f.name: np.concatenate([getattr(mesh, f.name) for mesh in meshes]) for f in fields(Mesh)})


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Appearance of primitives."""

    texture: int
    label: Label
    tile_m: float | None = None  # repeat the texture with this period; otherwise it covers the primitive once
    uv: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)  # the part of the texture: u, v, width, height
    detail: int = -1
    detail_tile_m: float = 4.0
    offset: tuple[float, float] = (0.0, 0.0)  # of both textures where they repeat
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    has_alpha: bool = False
    casts_shadow: bool = True
    is_moving: bool = False
    planar: bool = False  # texture coordinates are the world's x and y, seamless across primitives


class MeshBuilder:
    """Collects primitives in batches."""

    def __init__(self) -> None:
        self._parts: list[Mesh] = []

    def add(
        self,
        surface: Surface,
        origin: ArrayLike,
        u: ArrayLike,
        v: ArrayLike,
        *,
        triangle: bool = False,
        normal: ArrayLike | None = None,
    ) -> None:
        """Add parallelograms (or triangles) of one look.

        Texture rows count along `-v`: the image's top row lies at `origin + v`.

        Parameters
        ----------
        surface
            The look.
        origin, u, v
            Corner and edges (n, 3) or (3,).
        triangle
            Whether only the half next to the origin is meant.
        normal
            For shading, (n, 3) or (3,); by default `cross(u, v)`.
        """
        o, eu, ev = (np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (origin, u, v))
        n = max(len(o), len(eu), len(ev))
        o, eu, ev = (np.broadcast_to(x, (n, 3)).copy() for x in (o, eu, ev))
        if normal is None:
            raw = np.cross(eu, ev)
            shading = raw / np.maximum(np.linalg.norm(raw, axis=1, keepdims=True), 1e-12)
        else:
            shading = np.broadcast_to(np.atleast_2d(np.asarray(normal, dtype=np.float64)), (n, 3))
        self._parts.append(
            Mesh(
                origin=o,
                u=eu,
                v=ev,
                is_triangle=np.full(n, triangle),
                texture=np.full(n, surface.texture, np.int32),
                texture_uv=_texture_uv(surface, o, eu, ev),
                detail=np.full(n, surface.detail, np.int32),
                detail_uv=_repeating_uv(surface, surface.detail_tile_m, o, eu, ev),
                tint=np.broadcast_to(np.asarray(surface.tint, np.float32), (n, 3)),
                normal=shading.astype(np.float32),
                label=np.full(n, int(surface.label), np.uint8),
                has_alpha=np.full(n, surface.has_alpha),
                casts_shadow=np.full(n, surface.casts_shadow),
                is_moving=np.full(n, surface.is_moving),
            )
        )

    def add_strip(self, surface: Surface, left: Floats, right: Floats) -> None:
        """Add a band of triangles between two lines (n, 3); pieces of no length are left out."""
        keep = np.linalg.norm(left[1:] - left[:-1], axis=1) + np.linalg.norm(right[1:] - right[:-1], axis=1) > 1e-6
        l0, l1, r0, r1 = left[:-1][keep], left[1:][keep], right[:-1][keep], right[1:][keep]
        if len(l0):
            self.add(surface, r0, r1 - r0, l0 - r0, triangle=True)
            self.add(surface, l1, l0 - l1, r1 - l1, triangle=True)

    def add_box(
        self, surface: Surface, world_from_box: Floats, size_m: tuple[float, float, float], *, bottom: bool = False
    ) -> None:
        """Add a box whose base is centred on its frame's origin: length along x, width along y, height along z."""
        length, width, height = size_m
        r, t = world_from_box[:3, :3], world_from_box[:3, 3]
        x, y, z = r[:, 0] * length, r[:, 1] * width, r[:, 2] * height
        base = t - x / 2 - y / 2
        origins = [base, base + x, base + x + y, base + y, base + z]
        edges_u = [x, y, -x, -y, x]
        edges_v = [z, z, z, z, y]
        if bottom:
            origins, edges_u, edges_v = [*origins, base], [*edges_u, y], [*edges_v, x]
        self.add(surface, np.array(origins), np.array(edges_u), np.array(edges_v))

    def build(self) -> Mesh:
        """Everything added so far."""
        return concatenate(self._parts)


def _texture_uv(surface: Surface, o: Floats, eu: Floats, ev: Floats) -> Floats32:
    if surface.tile_m is not None:
        return _repeating_uv(surface, surface.tile_m, o, eu, ev)
    u0, v0, width, height = surface.uv
    return np.tile(np.array([u0, v0 + height, width, 0.0, 0.0, -height], np.float32), (len(o), 1))


def _repeating_uv(surface: Surface, tile_m: float, o: Floats, eu: Floats, ev: Floats) -> Floats32:
    if surface.planar:
        uv = np.concatenate([o[:, :2], eu[:, :2], ev[:, :2]], 1) / tile_m
        # Whole periods make no difference, but they would cost float32 its digits far from the world's origin.
        uv[:, :2] %= 1.0
        return uv.astype(np.float32)
    lu, lv = np.linalg.norm(eu, axis=1) / tile_m, np.linalg.norm(ev, axis=1) / tile_m
    zero = np.zeros_like(lu)
    return np.stack([zero + surface.offset[0], zero + surface.offset[1], lu, zero, zero, -lv], 1).astype(np.float32)
