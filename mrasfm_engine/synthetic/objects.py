"""Things that stand and drive in streets: buildings, trees, lamps, signs, cars, lorries."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.materials import Materials
from mrasfm_engine.synthetic.mesh import Label, Mesh, MeshBuilder, Surface
from mrasfm_engine.types import Floats

CAR_SIZE_M = (4.4, 1.78, 1.5)  # length, width, height
TRUCK_SIZE_M = (8.5, 2.4, 3.9)

_CAR_COLOURS = ((0.95, 0.95, 0.95), (0.35, 0.36, 0.38), (0.75, 0.2, 0.18), (0.25, 0.38, 0.68), (0.6, 0.62, 0.64))


def pose_on_ground(xyz: Floats, heading: float) -> Floats:
    """A level frame (4, 4) at a point, x along the heading, z up."""
    return se3.transform(se3.exp_so3([0.0, 0.0, heading]), xyz)


def _offset(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.random()), float(rng.random())


def add_building(
    builder: MeshBuilder,
    materials: Materials,
    world_from_front: Floats,
    size_m: tuple[float, float, float],
    *,
    facade: int,
    plain: bool,
    rng: np.random.Generator,
) -> None:
    """Add a building whose front looks along `-y` of its frame.

    Parameters
    ----------
    builder, materials
        Where to and with what.
    world_from_front
        Frame with its origin below the middle of the front, x along the front.
    size_m
        Width of the front, depth, height.
    facade
        Texture of the front.
    plain
        No balconies, signs and tints: every such building with this facade looks the same.
    rng
        Source of the differences.
    """
    width, depth, height = size_m
    r, t = world_from_front[:3, :3], world_from_front[:3, 3]
    x, y, z = r[:, 0] * width, r[:, 1] * depth, r[:, 2] * height
    tint = (1.0, 1.0, 1.0) if plain else tuple(float(c) for c in rng.uniform(0.92, 1.06) * rng.uniform(0.98, 1.02, 3))
    offset = (0.0, 0.0) if plain else _offset(rng)
    front = Surface(
        texture=facade,
        label=Label.BUILDING,
        detail=materials.details[0],
        offset=offset,
        tint=(tint[0], tint[1], tint[2]),
    )
    builder.add(front, t - x / 2, x, z)
    side = Surface(
        texture=materials.side_walls[facade % len(materials.side_walls)],
        label=Label.BUILDING,
        tile_m=6.0,
        detail=materials.details[1],
        offset=offset,
    )
    builder.add(side, t + x / 2, y, z)
    builder.add(side, t - x / 2 + y, -y, z)
    builder.add(side, t + x / 2 + y, -x, z)
    builder.add(side, t - x / 2 + z, x, y)
    # The plinth reaches below the ground, which may slope.
    builder.add(side, t - x / 2 - 2.0 * r[:, 2] - 0.03 * r[:, 1], x, 2.45 * r[:, 2])
    cornice = Surface(texture=side.texture, label=Label.BUILDING, tile_m=3.0, tint=(0.8, 0.8, 0.8))
    top = se3.transform(r, t + z - 0.15 * r[:, 1] - 0.4 * r[:, 2])
    builder.add_box(cornice, top, (width, 0.4, 0.5), bottom=True)
    if plain:
        return
    _add_relief(builder, materials, se3.transform(r, t - x / 2), width, height, rng)


def _add_relief(
    builder: MeshBuilder, materials: Materials, corner: Floats, width: float, height: float, rng: np.random.Generator
) -> None:
    """Balconies, signs and air conditioners, whose parallax a flat front would not have."""
    r, t = corner[:3, :3], corner[:3, 3]
    for _ in range(int(rng.integers(1, 5))):
        at = t + r @ np.array([rng.uniform(1.2, width - 1.2), -0.5, height * rng.uniform(0.3, 0.85)])
        look = Surface(
            texture=int(rng.choice(materials.metal)),
            label=Label.BUILDING,
            tile_m=2.0,
            detail=materials.details[0],
            offset=_offset(rng),
        )
        builder.add_box(look, se3.transform(r, at), (float(rng.uniform(1.6, 2.6)), 1.0, 1.0), bottom=True)
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.6, 1.1)
        at = t + r @ np.array([rng.uniform(0.8, width - 0.8), -0.05, rng.uniform(2.6, 4.0)])
        sign = Surface(texture=int(rng.choice(materials.posters)), label=Label.BUILDING)
        # Stands out from the wall, readable along the street.
        builder.add(sign, at, -r[:, 1] * size, r[:, 2] * size)
    for _ in range(int(rng.integers(0, 3))):
        size = rng.uniform(0.8, 1.6)
        at = t + r @ np.array([rng.uniform(0.5, width - 2.2), -0.04, rng.uniform(0.6, 1.4)])
        builder.add(
            Surface(texture=int(rng.choice(materials.posters)), label=Label.BUILDING),
            at,
            r[:, 0] * size,
            r[:, 2] * size,
        )


def add_tree(builder: MeshBuilder, materials: Materials, foot: Floats, *, rng: np.random.Generator) -> None:
    """Add a tree of a trunk and a cloud of leafy squares."""
    trunk_m, crown_m = float(rng.uniform(2.0, 2.8)), np.array([1.7, 1.7, 1.9]) * rng.uniform(0.8, 1.25)
    frame = pose_on_ground(foot, float(rng.uniform(0, 3)))
    builder.add_box(
        Surface(texture=materials.bark, label=Label.VEGETATION, tile_m=1.2, offset=_offset(rng)),
        frame,
        (0.26, 0.26, trunk_m + 1.0),
    )
    count = 110
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = foot + [0.0, 0.0, trunk_m + crown_m[2] * 0.8] + direction * crown_m * rng.uniform(0.45, 1.0, (count, 1))
    _add_leaves(builder, int(rng.choice(materials.leaves)), centre, direction, size_m=(0.8, 1.3), rng=rng)


def _add_leaves(
    builder: MeshBuilder,
    texture: int,
    centre: Floats,
    outward: Floats,
    *,
    size_m: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    count = len(centre)
    axis = rng.normal(size=(count, 3))
    u = np.cross(axis, outward + 0.7 * rng.normal(size=(count, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, axis)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    size = rng.uniform(*size_m, (count, 1))
    # Three tints instead of one for each: surfaces are added in batches.
    for k in range(3):
        tone = float(rng.uniform(0.8, 1.15))
        look = Surface(texture=texture, label=Label.VEGETATION, has_alpha=True, tint=(tone, tone, tone * 0.95))
        o = centre[k::3] - (u[k::3] + v[k::3]) * size[k::3] / 2
        builder.add(look, o, u[k::3] * size[k::3], v[k::3] * size[k::3], normal=outward[k::3])


def add_hedge(builder: MeshBuilder, materials: Materials, frame: Floats, *, rng: np.random.Generator) -> None:
    """Add 2.5 m of hedge along the frame's x axis."""
    height = float(rng.uniform(1.0, 1.5))
    look = Surface(
        texture=materials.grass, label=Label.VEGETATION, tile_m=1.7, offset=_offset(rng), tint=(0.75, 0.8, 0.7)
    )
    builder.add_box(look, frame, (2.5, 0.5, height * 0.9))
    count = 24
    local = np.stack(
        [rng.uniform(-1.3, 1.3, count), rng.uniform(-0.35, 0.35, count), rng.uniform(0.15, height, count)], -1
    )
    outward = np.stack([np.zeros(count), np.sign(local[:, 1]), np.full(count, 0.6)], -1) / 1.17
    _add_leaves(
        builder,
        int(rng.choice(materials.leaves)),
        se3.apply(frame, local),
        outward @ frame[:3, :3].T,
        size_m=(0.5, 0.8),
        rng=rng,
    )


def add_lamp(builder: MeshBuilder, materials: Materials, frame: Floats, *, rng: np.random.Generator) -> None:
    """Add a street lamp whose arm reaches along the frame's x axis."""
    look = Surface(texture=int(rng.choice(materials.metal)), label=Label.POLE, tile_m=0.9, offset=_offset(rng))
    builder.add_box(look, frame, (0.14, 0.14, 6.0))
    r, t = frame[:3, :3], frame[:3, 3]
    builder.add_box(look, se3.transform(r, t + r @ np.array([0.7, 0.0, 5.9])), (1.5, 0.1, 0.1), bottom=True)
    builder.add_box(look, se3.transform(r, t + r @ np.array([1.4, 0.0, 5.8])), (0.6, 0.25, 0.12), bottom=True)
    if rng.random() < 0.6:
        board = Surface(texture=int(rng.choice(materials.posters)), label=Label.SIGN)
        for sign in (1.0, -1.0):
            at = t + r @ np.array([-0.3 * sign, 0.09 * sign, 1.3])
            builder.add(board, at, r[:, 0] * 0.6 * sign, r[:, 2] * 0.8)


def add_sign(builder: MeshBuilder, materials: Materials, frame: Floats, *, rng: np.random.Generator) -> None:
    """Add a traffic sign that faces `-x`."""
    r, t = frame[:3, :3], frame[:3, 3]
    pole = Surface(texture=int(rng.choice(materials.metal)), label=Label.POLE, tile_m=0.6, offset=_offset(rng))
    builder.add_box(pole, frame, (0.07, 0.07, 2.6))
    board = Surface(texture=int(rng.choice(materials.posters)), label=Label.SIGN)
    at = t + r @ np.array([-0.05, 0.35, 2.0])
    builder.add(board, at, -r[:, 1] * 0.7, r[:, 2] * 0.7)


def add_furniture(builder: MeshBuilder, materials: Materials, frame: Floats, *, rng: np.random.Generator) -> None:
    """Add a bin, a distribution box or an advertising board."""
    kind = rng.random()
    if kind < 0.6:
        look = Surface(
            texture=int(rng.choice(materials.metal)),
            label=Label.WALL,
            tile_m=1.3,
            detail=materials.details[1],
            offset=_offset(rng),
            tint=tuple(float(c) for c in rng.uniform(0.6, 1.2, 3)),  # type: ignore[arg-type]
        )
        low, high = ((0.5, 0.4, 0.7), (0.7, 0.6, 1.0)) if kind < 0.35 else ((0.9, 0.35, 1.0), (1.4, 0.5, 1.4))
        size = rng.uniform(low, high)
        builder.add_box(look, frame, (float(size[0]), float(size[1]), float(size[2])))
    else:
        look = Surface(texture=int(rng.choice(materials.posters)), label=Label.WALL)
        builder.add_box(look, frame, (1.2, 0.16, 1.9))


def car(materials: Materials, *, is_moving: bool, rng: np.random.Generator) -> Mesh:
    """A car in its own frame: origin on the ground below its middle, x forward."""
    length, width, height = CAR_SIZE_M
    tone = _CAR_COLOURS[int(rng.integers(len(_CAR_COLOURS)))]
    kind = {"label": Label.CAR, "is_moving": is_moving}
    builder = MeshBuilder()
    side = Surface(texture=int(rng.choice(materials.car_sides)), has_alpha=True, tint=tone, **kind)  # type: ignore[arg-type]
    x, z = np.array([length, 0.0, 0.0]), np.array([0.0, 0.0, height])
    builder.add(side, [-length / 2, -width / 2, 0.0], x, z)
    builder.add(side, [-length / 2, width / 2, 0.0], x, z, normal=[0.0, 1.0, 0.0])
    # Outline of the side texture in metres: (x, z) from the back over the roof to the front, and what covers it.
    outline = np.array(
        [[4, 214], [4, 140], [40, 116], [118, 104], [176, 20], [360, 16], [430, 104], [504, 128], [508, 214]]
    )
    px = outline[:, 0] / 512 * length - length / 2
    pz = (256 - outline[:, 1]) / 256 * height
    paint = Surface(texture=materials.metal[0], tile_m=2.5, tint=tone, detail=materials.details[0], **kind)  # type: ignore[arg-type]
    glass = Surface(texture=materials.glass, **kind)  # type: ignore[arg-type]
    back = Surface(texture=int(rng.choice(materials.car_backs)), tint=tone, **kind)  # type: ignore[arg-type]
    front = Surface(texture=int(rng.choice(materials.car_fronts)), tint=tone, **kind)  # type: ignore[arg-type]
    for k, look in enumerate([back, paint, paint, glass, paint, glass, paint, front]):
        a, b = np.array([px[k], 0.0, pz[k]]), np.array([px[k + 1], 0.0, pz[k + 1]])
        half = np.array([0.0, width / 2, 0.0])
        if look is front:
            builder.add(look, b - half, 2 * half, a - b)
        else:
            builder.add(look, a + half, -2 * half, b - a)
    builder.add(
        Surface(texture=materials.metal[0], tile_m=2.5, tint=(0.1, 0.1, 0.1), **kind),  # type: ignore[arg-type]
        [-length / 2 + 0.1, -width / 2, 0.24],
        [length - 0.2, 0.0, 0.0],
        [0.0, width, 0.0],
    )
    return builder.build()


def truck(materials: Materials, *, rng: np.random.Generator) -> Mesh:
    """A lorry in its own frame: origin on the ground below its middle, x forward."""
    length, width, height = TRUCK_SIZE_M
    builder = MeshBuilder()
    box = Surface(
        texture=int(rng.choice(materials.trucks)), label=Label.TRUCK, is_moving=True, detail=materials.details[1]
    )
    builder.add_box(box, pose_on_ground(np.array([0.0, 0.0, 0.5]), 0.0), (length, width, height - 0.5), bottom=True)
    wheels = Surface(texture=materials.metal[1], label=Label.TRUCK, is_moving=True, tile_m=1.0, tint=(0.25, 0.25, 0.25))
    for x in (-0.35 * length, 0.33 * length):
        builder.add_box(wheels, pose_on_ground(np.array([x, 0.0, 0.0]), 0.0), (1.0, width * 0.96, 0.9))
    return builder.build()


def shadow_boxes(world_from_car: Floats, size_m: tuple[float, float, float], *, is_truck: bool) -> Floats:
    """Casters (k, 8) of a moving vehicle as `shading` wants them."""
    length, width, height = size_m
    heading = np.arctan2(world_from_car[1, 0], world_from_car[0, 0])
    x, y, z = world_from_car[:3, 3]
    c, s = np.cos(heading), np.sin(heading)
    if is_truck:
        return np.array([[x, y, z + 0.3, z + height, c, s, length / 2, width / 2]])
    return np.array(
        [
            [x, y, z + 0.15, z + 0.6 * height, c, s, length / 2, width / 2],
            [x, y, z + 0.6 * height, z + 0.97 * height, c, s, 0.26 * length, 0.47 * width],
        ]
    )
