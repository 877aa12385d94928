"""The textures of a world and their places in the atlas."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.synthetic import paint_facades, paint_surfaces
from mrasfm_engine.synthetic.atlas import Atlas, AtlasBuilder
from mrasfm_engine.types import Bytes

_WORKERS = 2


@dataclass(frozen=True, kw_only=True)
class Materials:
    """Indices into the atlas, several where there is a choice."""

    atlas: Atlas
    facades: list[int]
    side_walls: list[int]
    details: list[int]
    asphalt: int
    paving: list[int]
    grass: int
    leaves: list[int]
    bark: int
    metal: list[int]
    posters: list[int]
    car_sides: list[int]
    car_fronts: list[int]
    car_backs: list[int]
    glass: int
    trucks: list[int]
    clouds: int
    skylines: list[int]
    cracks: list[int]
    patches: list[int]
    manholes: list[int]
    paint: int


def _seeds(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in rng.integers(0, 2**62, count)]


def paint_materials(*, facades: int, size: int, rng: np.random.Generator) -> Materials:
    """Paint all textures.

    Parameters
    ----------
    facades
        Number of different fronts.
    size
        Side of the largest textures in pixels, a power of two.
    rng
        Source of everything random.
    """
    atlas = AtlasBuilder()
    with ThreadPoolExecutor(_WORKERS) as pool:
        # Every texture has its own generator: threads may finish in any order.
        fronts: list[Bytes] = list(pool.map(lambda r: paint_facades.facade(size, r), _seeds(rng, facades)))
        walls = list(pool.map(lambda r: paint_facades.side_wall(size // 2, r), _seeds(rng, 4)))
        details = list(pool.map(lambda r: paint_surfaces.detail(size, r), _seeds(rng, 2)))
    half, small = max(64, size // 2), max(64, size // 4)
    plants = [((92.0, 128.0, 62.0), 0.9), ((118.0, 138.0, 60.0), 0.75), ((80.0, 112.0, 70.0), 0.85)]
    return Materials(
        facades=[atlas.add(image) for image in fronts],
        side_walls=[atlas.add(image) for image in walls],
        details=[atlas.add(image) for image in details],
        asphalt=atlas.add(paint_surfaces.asphalt(size, rng)),
        paving=[
            atlas.add(paint_surfaces.paving(half, rng, colour=colour))
            for colour in ((152, 147, 140), (138, 140, 146), (160, 140, 124))
        ],
        grass=atlas.add(paint_surfaces.grass(half, rng)),
        leaves=[atlas.add(paint_surfaces.leaves(256, rng, colour=c, cover=f)) for c, f in plants],
        bark=atlas.add(paint_surfaces.bark(small, rng)),
        metal=[atlas.add(paint_surfaces.metal(small, rng)) for _ in range(4)],
        posters=[atlas.add(paint_surfaces.poster(256, rng)) for _ in range(12)],
        car_sides=[atlas.add(paint_surfaces.car_side(rng)) for _ in range(4)],
        car_fronts=[atlas.add(paint_surfaces.car_face(rng, front=True)) for _ in range(3)],
        car_backs=[atlas.add(paint_surfaces.car_face(rng, front=False)) for _ in range(3)],
        glass=atlas.add(paint_surfaces.glass(128, rng)),
        trucks=[atlas.add(paint_surfaces.truck_side(rng)) for _ in range(2)],
        clouds=atlas.add(paint_surfaces.clouds(half, rng)),
        skylines=[atlas.add(paint_surfaces.skyline(rng)) for _ in range(3)],
        cracks=[atlas.add(paint_surfaces.crack_decal(128, rng)) for _ in range(6)],
        patches=[atlas.add(paint_surfaces.patch_decal(256, rng)) for _ in range(6)],
        manholes=[atlas.add(paint_surfaces.manhole(128, rng)) for _ in range(2)],
        paint=atlas.add(paint_surfaces.paint_line(256, rng)),
        atlas=atlas.build(),
    )
