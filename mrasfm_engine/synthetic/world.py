"""The static world: ground, streets with their markings, buildings, plants and street furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic import objects
from mrasfm_engine.synthetic.materials import Materials, paint_materials
from mrasfm_engine.synthetic.mesh import Label, Mesh, MeshBuilder, Surface
from mrasfm_engine.synthetic.options import SynthOptions, World
from mrasfm_engine.synthetic.streets import KERB_M, ROAD_HALF_M, SIDEWALK_M, Layout, Street, lay_out
from mrasfm_engine.types import Bools, Floats

_FRONT_M = ROAD_HALF_M + SIDEWALK_M  # where buildings begin
_YARD_M = 7.0  # paved or green strip behind the sidewalk, on which buildings stand
_MAX_FACADES = 32
_REPEATED_FACADES = 1
_DECAL_M = 0.012  # above the road: thicker than rounding, thinner than anything visible


@dataclass(frozen=True, kw_only=True)
class StaticWorld:
    """The static part of a world, the same for all drives."""

    layout: Layout
    materials: Materials
    mesh: Mesh


def build_world(options: SynthOptions, rng: np.random.Generator) -> StaticWorld:
    """Lay out, paint and furnish a world."""
    layout = lay_out(options, rng)
    length = sum(street.length_m for street in layout.streets)
    # Painting takes most of the time before the first image; small textures are for those in a hurry.
    most = _MAX_FACADES if options.texture_px > 256 else _MAX_FACADES // 3
    facades = _REPEATED_FACADES if options.world is World.REPEATED else min(most, max(8, round(length / 6)))
    materials = paint_materials(facades=facades, size=options.texture_px, rng=rng)
    builder = MeshBuilder()
    _add_ground(builder, materials, layout)
    taken: list[Floats] = []
    for number, street in enumerate(layout.streets):
        others = [other for k, other in enumerate(layout.streets) if k != number]
        site = _Site(
            builder=builder, materials=materials, layout=layout, street=street, others=others, taken=taken, rng=rng
        )
        for side in (1, -1):
            _add_sidewalk(site, side)
            _add_buildings(site, side, plain=options.world is World.REPEATED)
            _add_plants_and_furniture(site, side)
        _add_markings(site)
        _add_wear(site)
    _add_horizon(builder, materials, layout)
    return StaticWorld(layout=layout, materials=materials, mesh=builder.build())


@dataclass(frozen=True, kw_only=True)
class _Site:
    builder: MeshBuilder
    materials: Materials
    layout: Layout
    street: Street
    others: list[Street]
    taken: list[Floats]  # circles x, y, radius that buildings occupy
    rng: np.random.Generator

    def point(self, s: float, lateral: float, above_m: float = 0.0) -> Floats:
        xy, _ = self.street.at(s, lateral)
        return self.layout.ground.lift(xy, above_m)

    def frame(self, s: float, lateral: float, *, turn: float = 0.0, above_m: float = KERB_M) -> Floats:
        xy, heading = self.street.at(s, lateral)
        return objects.pose_on_ground(self.layout.ground.lift(xy, above_m), float(heading) + turn)

    def clear_of_streets(self, xy: Floats, distance_m: float) -> bool:
        """True if points (n, 2) keep their distance from all other streets, and from far parts of this one."""
        own = bool((self.street.distance(xy) > min(distance_m, _FRONT_M - 0.4)).all())
        return own and all((other.distance(xy) > distance_m).all() for other in self.others)


def _add_ground(builder: MeshBuilder, materials: Materials, layout: Layout) -> None:
    """Asphalt everywhere near streets, in flat pieces on the height's own grid, grass beyond."""
    everything = np.concatenate([street.points for street in layout.streets])
    e = layout.ground.direction
    basis = np.array([e, [-e[1], e[0]]])
    q = everything @ basis.T
    step = 4.0
    low, high = np.floor((q.min(0) - 60) / step) * step, np.ceil((q.max(0) + 60) / step) * step
    grid = np.stack(
        np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step), indexing="ij"), -1
    ).reshape(-1, 2)
    centre = (grid + step / 2) @ basis
    coarse = everything[::12]
    near = np.sqrt(((centre[:, None] - coarse[None]) ** 2).sum(-1).min(1))
    road = near < ROAD_HALF_M + 5.0
    asphalt = Surface(
        texture=materials.asphalt,
        label=Label.ROAD,
        tile_m=7.3,
        detail=materials.details[0],
        detail_tile_m=3.1,
        planar=True,
        casts_shadow=False,
    )
    grass = Surface(
        texture=materials.grass,
        label=Label.TERRAIN,
        tile_m=3.7,
        detail=materials.details[1],
        detail_tile_m=5.3,
        planar=True,
        casts_shadow=False,
    )
    for surface, chosen in ((asphalt, road), (grass, ~road & (near < 70))):
        if not chosen.any():
            continue
        corner = [
            layout.ground.lift((grid[chosen] + [i * step, j * step]) @ basis) for i, j in ((0, 0), (1, 0), (0, 1))
        ]
        builder.add(surface, corner[0], corner[1] - corner[0], corner[2] - corner[0])


def _add_sidewalk(site: _Site, side: int) -> None:
    """Kerb, sidewalk and the strip behind it, interrupted where other streets are."""
    street, rng, materials = site.street, site.rng, site.materials
    s = np.arange(0.0, street.length_m + 0.5, 1.0)
    if street.closed:
        s = np.append(s[s < street.length_m], street.length_m)
    paving = materials.paving
    look = Surface(
        texture=int(rng.choice(paving)),
        label=Label.SIDEWALK,
        tile_m=4.1,
        detail=materials.details[1],
        detail_tile_m=2.7,
        planar=True,
        casts_shadow=False,
    )
    kerb = Surface(texture=paving[1], label=Label.SIDEWALK, tile_m=3.0, planar=False, casts_shadow=False)
    # A world-aligned texture on a vertical face would be smeared, so the kerb's repeats along its length.
    yard_texture = materials.grass if rng.random() < 0.5 else int(rng.choice(paving))
    yard = Surface(
        texture=yard_texture,
        label=Label.TERRAIN if yard_texture == materials.grass else Label.SIDEWALK,
        tile_m=3.3,
        detail=materials.details[0],
        detail_tile_m=4.3,
        planar=True,
        casts_shadow=False,
    )

    def line(lateral: float, above_m: float) -> Floats:
        xy, _ = street.at(s, side * lateral)
        return site.layout.ground.lift(xy, above_m)

    edge, back, far = ROAD_HALF_M, ROAD_HALF_M + SIDEWALK_M, ROAD_HALF_M + SIDEWALK_M + _YARD_M
    middle, _ = street.at(s, side * (edge + SIDEWALK_M / 2))
    free = np.ones(len(s), bool)
    for other in site.others:
        free &= other.distance(middle) > edge + SIDEWALK_M / 2
    # The yard's far edge folds over inside tight bends; there it ends earlier.
    if street.closed and side == 1:
        far = back + 1.5
    for lines in ((edge, back, look), (back, far, yard)):
        near_line, far_line, surface = line(lines[0], KERB_M), line(lines[1], KERB_M), lines[2]
        for piece in _runs(free):
            builder_lines = (near_line[piece], far_line[piece]) if side < 0 else (far_line[piece], near_line[piece])
            site.builder.add_strip(surface, *builder_lines)
    low, high = line(edge, -0.02), line(edge, KERB_M)
    for piece in _runs(free):
        a, b = low[piece], high[piece]
        site.builder.add(kerb, a[:-1], a[1:] - a[:-1], b[:-1] - a[:-1])


def _runs(free: Bools) -> list[slice]:
    """Slices of at least two consecutive true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], free.astype(int), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def _add_buildings(site: _Site, side: int, *, plain: bool) -> None:
    """A row of buildings with some gaps, and taller ones behind."""
    street, rng = site.street, site.rng
    s = 0.0
    order = rng.permutation(len(site.materials.facades))
    number = 0
    while s < street.length_m:
        width = 12.0 if plain else float(rng.uniform(9.0, 14.5))
        if not plain and rng.random() < 0.14:
            s += float(rng.uniform(3.0, 7.0))
            continue
        depth = 9.0 if not (street.closed and side == 1) else 4.0
        height = 12.5 if plain else float(rng.uniform(10.0, 15.0))
        lateral = _FRONT_M if plain else _FRONT_M + float(rng.choice([0.0, 0.0, 0.4, 1.2]))
        middle = s + width / 2
        facade = site.materials.facades[int(order[number % len(order)])]
        number += 1
        # Along the inside of a bend the chord is shorter than the axis.
        _place_building(site, middle, side * lateral, (width, depth, height), facade=facade, plain=plain)
        s += width + (0.0 if plain else 0.15)
    if plain:
        return
    s = 10.0
    while s < street.length_m and not (street.closed and side == 1):
        size = (float(rng.uniform(14, 20)), 10.0, float(rng.uniform(15, 24)))
        facade = int(rng.choice(site.materials.facades))
        _place_building(site, s, side * float(rng.uniform(30, 40)), size, facade=facade, plain=False)
        s += float(rng.uniform(22, 34))


def _place_building(
    site: _Site, s: float, lateral: float, size_m: tuple[float, float, float], *, facade: int, plain: bool
) -> None:
    side = 1 if lateral > 0 else -1
    frame = site.frame(s, lateral, turn=0.0 if side > 0 else np.pi, above_m=KERB_M)
    width, depth, _ = size_m
    outline = np.array([[f * width, d * depth, 0.0] for f in (-0.5, 0.0, 0.5) for d in (0.0, 0.5, 1.0)])
    corners = se3.apply(frame, outline)[:, :2]
    if not site.clear_of_streets(corners, _FRONT_M + 0.5):
        return
    middle = se3.apply(frame, np.array([[0.0, depth / 2, 0.0]]))[0, :2]
    radius = 0.42 * width
    if any(np.hypot(*(middle - t[:2])) < radius + t[2] - 1.0 for t in site.taken):
        return
    site.taken.append(np.array([*middle, radius]))
    objects.add_building(site.builder, site.materials, frame, size_m, facade=facade, plain=plain, rng=site.rng)


def _add_plants_and_furniture(site: _Site, side: int) -> None:
    """Trees, lamps, signs, boxes and hedges along a sidewalk."""
    street, rng, builder, materials = site.street, site.rng, site.builder, site.materials
    inward = -side * np.pi / 2
    s = float(rng.uniform(2.0, 6.0))
    lamp = 0
    while s < street.length_m - 1:
        kind = rng.random()
        lateral = side * (ROAD_HALF_M + 0.7)
        at = site.point(s, lateral, KERB_M)
        if site.clear_of_streets(at[None, :2], ROAD_HALF_M + 0.3) or not site.others:
            if lamp <= 0:
                objects.add_lamp(builder, materials, site.frame(s, lateral, turn=inward), rng=rng)
                lamp = 5
            elif kind < 0.42:
                objects.add_tree(builder, materials, at, rng=rng)
            elif kind < 0.75:
                turn = float(rng.normal(0, 0.15)) + (np.pi / 2 if rng.random() < 0.3 else 0.0)
                objects.add_furniture(builder, materials, site.frame(s, lateral, turn=turn), rng=rng)
            else:
                turn = 0.0 if side < 0 else np.pi
                objects.add_sign(builder, materials, site.frame(s, lateral, turn=turn), rng=rng)
        lamp -= 1
        s += float(rng.uniform(2.5, 5.5))
    s = 1.5
    while s < street.length_m - 1:
        # Hedges and trees stand where there is no building.
        frame = site.frame(s, side * (_FRONT_M + 0.6))
        open_ground = all(np.hypot(*(frame[:2, 3] - t[:2])) > t[2] + 1.6 for t in site.taken)
        if open_ground and site.clear_of_streets(frame[None, :2, 3], _FRONT_M):
            objects.add_hedge(builder, materials, frame, rng=rng)
            if rng.random() < 0.5:
                objects.add_tree(builder, materials, site.point(s, side * (_FRONT_M + 4.0), KERB_M), rng=rng)
        s += 2.5


def _add_markings(site: _Site) -> None:
    """Dashed line in the middle, lines beside the parking lanes, zebra crossings, interrupted at other streets."""
    paint = Surface(
        texture=site.materials.paint,
        label=Label.ROAD,
        tile_m=2.9,
        detail=site.materials.details[1],
        has_alpha=True,
        casts_shadow=False,
    )
    length = site.street.length_m

    def stripe(s0: float, s1: float, lateral: float, width: float) -> None:
        ends, _ = site.street.at(np.array([s0, s1]), lateral)
        if any((other.distance(ends) < ROAD_HALF_M + 1.5).any() for other in site.others):
            return
        a, b = site.layout.ground.lift(ends, _DECAL_M)
        along = (b - a) / np.linalg.norm(b - a)
        left = np.array([-along[1], along[0], 0.0])
        look = Surface(**{**paint.__dict__, "offset": (float(site.rng.random()), float(site.rng.random()))})
        site.builder.add(look, a - left * width / 2, b - a, left * width)

    s = 0.0
    while s + 3.0 < length:
        stripe(s, s + 2.5 + float(site.rng.uniform(-0.1, 0.1)), 0.0, 0.14)
        s += 6.0
    for lateral in (-3.3, 3.3):
        for s in np.arange(0.0, length - 1.0, 2.0):
            stripe(s, s + 2.01, lateral, 0.12)
    for s in np.arange(40.0, length - 20.0, 55.0):
        for lateral in np.arange(-5.0, 5.01, 1.0):
            stripe(s, s + 3.0, float(lateral), 0.5)


def _add_wear(site: _Site) -> None:
    """Cracks, mended patches and manholes, so that no two pieces of road are the same."""
    rng, materials = site.rng, site.materials
    count = int(site.street.length_m * 1.3)
    for _ in range(count):
        kind = rng.random()
        if kind < 0.5:
            texture, size = int(rng.choice(materials.cracks)), float(rng.uniform(1.0, 2.6))
        elif kind < 0.94:
            texture, size = int(rng.choice(materials.patches)), float(np.exp(rng.uniform(np.log(0.12), np.log(1.6))))
        else:
            texture, size = int(rng.choice(materials.manholes)), 0.7
        turn = float(rng.uniform(0, 2 * np.pi))
        xy, heading = site.street.at(rng.uniform(0, site.street.length_m), rng.uniform(-4.9, 4.9))
        angle = float(heading) + turn
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) * size
        # Alike things at slightly different heights do not fight for the same depth.
        above = _DECAL_M * float(rng.uniform(0.4, 0.95))
        corner = [site.layout.ground.lift(xy + offset, above) for offset in (-axes.sum(0) / 2, (axes[0] - axes[1]) / 2)]
        third = site.layout.ground.lift(xy + (axes[1] - axes[0]) / 2, above)
        look = Surface(
            texture=texture,
            label=Label.ROAD,
            has_alpha=True,
            casts_shadow=False,
            detail=materials.details[0],
            detail_tile_m=2.3,
            offset=(float(rng.random()), float(rng.random())),
        )
        site.builder.add(look, corner[0], corner[1] - corner[0], third - corner[0])


def _add_horizon(builder: MeshBuilder, materials: Materials, layout: Layout) -> None:
    """Far hills all around."""
    everything = np.concatenate([street.points for street in layout.streets])
    centre = (everything.min(0) + everything.max(0)) / 2
    radius = 260.0 + float(np.ptp(everything, axis=0).max()) / 2
    angle = np.linspace(0, 2 * np.pi, 13)
    ring = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    base = float(layout.ground.height(everything).min()) - 12.0
    for k in range(12):
        a, b = np.append(ring[k], base), np.append(ring[k + 1], base)
        look = Surface(
            texture=materials.skylines[k % len(materials.skylines)],
            label=Label.VEGETATION,
            has_alpha=True,
            casts_shadow=False,
        )
        builder.add(look, a, b - a, [0.0, 0.0, 62.0])
