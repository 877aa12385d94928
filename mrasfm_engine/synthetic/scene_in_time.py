"""One drive's scene at any instant: what stands, what moves, and the shadows of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic import objects
from mrasfm_engine.synthetic.light import Light, ShadowMap, cast_shadows
from mrasfm_engine.synthetic.materials import Materials
from mrasfm_engine.synthetic.mesh import Mesh, concatenate
from mrasfm_engine.synthetic.motion import Motion, same_way_cars, traffic
from mrasfm_engine.synthetic.moving_shadows import ShadowCaster, moving_shadows
from mrasfm_engine.synthetic.occluder import place_truck
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.rigs import TrueCamera
from mrasfm_engine.synthetic.streets import ROAD_HALF_M, Layout
from mrasfm_engine.synthetic.world import StaticWorld
from mrasfm_engine.types import Floats

_UNDERGROUND_M = -500.0  # where things wait that are not there
_COLLISION_STEP_S = 0.05


@dataclass(frozen=True, kw_only=True)
class Mover:
    """A vehicle that moves: by its own motion, or fixed to the recording vehicle."""

    mesh: Mesh  # in its own frame
    motion: Motion
    motion_from_mover: Floats  # (4, 4)
    size_m: tuple[float, float, float]
    is_truck: bool
    begin_s: float = -np.inf  # there only in between
    end_s: float = np.inf

    def pose(self, time_s: float) -> Floats | None:
        """`world_from_mover` (4, 4), or nothing while it is not there."""
        if not self.begin_s <= time_s < self.end_s:
            return None
        result: Floats = self.motion.world_from_rig(time_s) @ self.motion_from_mover
        return result


@dataclass(frozen=True, kw_only=True)
class SceneInTime:
    """All that a drive's cameras can see."""

    materials: Materials
    light: Light
    shadows: ShadowMap
    static: Mesh
    movers: list[Mover]
    everything: Mesh  # static, then the movers in their own frames
    casters: list[ShadowCaster]  # that move and are not drawn

    def at(self, time_s: float) -> tuple[Mesh, Floats]:
        """The mesh at an instant, and the moving casters (k, 8) of shadows."""
        boxes = [np.zeros((0, 8)), *(caster.boxes(time_s) for caster in self.casters)]
        if not self.movers:
            return self.static, np.concatenate(boxes)
        parts = []
        for mover in self.movers:
            pose = mover.pose(time_s)
            if pose is None:
                pose = np.eye(4)
                pose[2, 3] = _UNDERGROUND_M
            else:
                boxes.append(objects.shadow_boxes(pose, mover.size_m, is_truck=mover.is_truck))
            parts.append(mover.mesh.moved(pose))
        geometry = {
            name: np.concatenate([getattr(self.static, name), *(getattr(part, name) for part in parts)])
            for name in ("origin", "u", "v", "normal")
        }
        return replace(self.everything, **geometry), np.concatenate(boxes)


def parked_cars(
    options: SynthOptions, world: StaticWorld, drive: int, rng: np.random.Generator
) -> list[tuple[Mesh, Floats]]:
    """Cars in the parking lanes along a drive's path, none in another street: in the world, and where they stand."""
    layout: Layout = world.layout
    route = layout.routes[drive]
    street = layout.streets[route.street]
    result: list[tuple[Mesh, Floats]] = []
    places: list[tuple[int, float]] = []
    for _ in range(60 * options.parked_cars):
        if len(result) == options.parked_cars:
            break
        side = int(rng.choice([-1, 1]))
        along = float(rng.uniform(-12.0, options.drive_length_m + 30.0))
        if any(s == side and abs(a - along) < 5.6 for s, a in places):
            continue
        s = route.start_m + route.direction * along
        xy, heading = street.at(s, side * (ROAD_HALF_M - 1.05))
        others = [other for k, other in enumerate(layout.streets) if k != route.street]
        if any(other.distance(xy[None])[0] < ROAD_HALF_M + 4.0 for other in others):
            continue
        places.append((side, along))
        turn = float(heading) + (np.pi if side > 0 else 0.0) + float(rng.normal(0, 0.03))
        frame = objects.pose_on_ground(layout.ground.lift(xy), turn)
        result.append((objects.car(world.materials, is_moving=False, rng=rng).moved(frame), frame))
    return result


def _drives_through(lorry: Mover, pose_of_car: Callable[[float], Floats | None]) -> bool:
    """True if a lorry overlaps a car at some time; the car's pose is given as a function of time."""
    reach = (np.array(lorry.size_m[:2]) + np.array(objects.CAR_SIZE_M[:2])) / 2
    for time_s in np.arange(lorry.begin_s, lorry.end_s, _COLLISION_STEP_S).tolist():
        world_from_lorry, world_from_car = lorry.pose(time_s), pose_of_car(time_s)
        if world_from_lorry is None or world_from_car is None:
            continue
        if (np.abs((se3.inverse(world_from_lorry) @ world_from_car)[:2, 3]) < reach).all():
            return True
    return False


def _covers(lorry: Mover, world_from_car: Floats) -> bool:
    return _drives_through(lorry, lambda time_s: world_from_car)


def _car(world: StaticWorld, motion: Motion, rng: np.random.Generator) -> Mover:
    return Mover(
        mesh=objects.car(world.materials, is_moving=True, rng=rng),
        motion=motion,
        motion_from_mover=np.eye(4),
        size_m=objects.CAR_SIZE_M,
        is_truck=False,
    )


def build_scene(
    options: SynthOptions,
    world: StaticWorld,
    *,
    drive: int,
    own: Motion,
    rig: list[TrueCamera],
    light: Light,
    rng: np.random.Generator,
    shadow_rng: np.random.Generator,
    same_way_rng: np.random.Generator,
) -> SceneInTime:
    """The world with one drive's parked cars, traffic, moving shadows and light."""
    parked = parked_cars(options, world, drive, rng)
    movers = [_car(world, motion, rng) for motion in traffic(options, world.layout, drive, rng)]
    movers += [_car(world, motion, same_way_rng) for motion in same_way_cars(options, world.layout, drive, own)]
    lorries = [
        Mover(
            mesh=objects.truck(world.materials, rng=rng),
            motion=own,
            motion_from_mover=place_truck(camera, rig),
            size_m=objects.TRUCK_SIZE_M,
            is_truck=True,
            begin_s=0.25 * options.units / options.rate_hz - 0.05,
            end_s=0.75 * options.units / options.rate_hz - 0.05,
        )
        for camera in rig
        if camera.name in options.occluded_cameras
    ]
    movers = [mover for mover in movers if not any(_drives_through(lorry, mover.pose) for lorry in lorries)] + lorries
    static = concatenate(
        [world.mesh, *(mesh for mesh, at in parked if not any(_covers(lorry, at) for lorry in lorries))]
    )
    return SceneInTime(
        materials=world.materials,
        light=light,
        shadows=cast_shadows(static, world.materials.atlas, light.to_sun),
        static=static,
        movers=movers,
        everything=concatenate([static, *(mover.mesh for mover in movers)]) if movers else static,
        casters=moving_shadows(options, world.layout, drive, own, shadow_rng),
    )
