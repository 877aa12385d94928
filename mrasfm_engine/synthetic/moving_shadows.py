"""Shadows that move over the road: the recording vehicle's own, and those of things that travel beside it unseen.

The hard case of a road's reconstruction. What casts the shadows is not drawn: a vehicle in view would be masked as a
dynamic object, its shadow is labelled road. An edge of a shadow that moves along the street satisfies the epipolar
geometry of a car that drives along it, and triangulates above or below the road.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.synthetic import objects
from mrasfm_engine.synthetic.motion import Motion
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.streets import Layout, Route
from mrasfm_engine.types import Floats

OWN_CENTRE_M = 1.3  # of the body ahead of the rear axle
REACH_M = (-10.0, 14.0)  # where along the trajectory a companion meets the vehicle, from behind to ahead
LATERAL_M = (-4.2, 4.2)  # of companions to the street's axis
HEIGHT_M = (1.2, 2.8)  # of what they carry above the ground
SPEED_SHARE = ((-0.9, -0.25), (0.2, 0.75))  # of the vehicle's speed: oncoming, and slower ones of the same direction
PARTS = (8, 13)  # slats and plates of a load, apart from one another: each is a blob on the road


@dataclass(frozen=True, kw_only=True)
class ShadowCaster:
    """Something that moves and casts a shadow but is not drawn."""

    motion: Motion
    parts: Floats  # (k, 7): centre x, y and lower and upper z, heading (rad), half length and half width, own frame

    def boxes(self, time_s: float) -> Floats:
        """Casters (k, 8) as `shading` wants them."""
        pose = self.motion.world_from_rig(time_s)
        heading = float(np.arctan2(pose[1, 0], pose[0, 0]))
        c, s = np.cos(heading), np.sin(heading)
        x, y, low, high, turn, half_length, half_width = self.parts.T
        return np.stack(
            [
                pose[0, 3] + c * x - s * y,
                pose[1, 3] + s * x + c * y,
                pose[2, 3] + low,
                pose[2, 3] + high,
                np.cos(heading + turn),
                np.sin(heading + turn),
                half_length,
                half_width,
            ],
            -1,
        )


def moving_shadows(
    options: SynthOptions, layout: Layout, drive: int, own: Motion, rng: np.random.Generator
) -> list[ShadowCaster]:
    """The recording vehicle's own shadow and `options.moving_shadows` companions along its path; none for zero."""
    if not options.moving_shadows:
        return []
    length, width, height = objects.CAR_SIZE_M
    body = [OWN_CENTRE_M, 0.0, 0.2, 0.6 * height, 0.0, length / 2, width / 2]
    cabin = [OWN_CENTRE_M - 0.3, 0.0, 0.6 * height, height, 0.0, 0.26 * length, 0.47 * width]
    casters = [ShadowCaster(motion=own, parts=np.array([body, cabin]))]
    return casters + [_companion(options, layout, drive, own, rng) for _ in range(options.moving_shadows)]


def street_heading(own: Motion, options: SynthOptions) -> float:
    """The vehicle's mean heading over a drive, radians."""
    ends = own.world_from_rig(np.array([0.0, (options.units - 1) / options.rate_hz]))
    moved = ends[1, :2, 3] - ends[0, :2, 3]
    if np.linalg.norm(moved) < 1.0:
        moved = ends[0, :2, 0]
    return float(np.arctan2(moved[1], moved[0]))


def _companion(
    options: SynthOptions, layout: Layout, drive: int, own: Motion, rng: np.random.Generator
) -> ShadowCaster:
    """An open load that is near the vehicle at some instant of the drive."""
    route = layout.routes[drive]
    duration_s = (options.units - 1) / options.rate_hz
    share = rng.uniform(*SPEED_SHARE[int(rng.random() < 0.6)])
    speed = share * options.spacing_m * options.rate_hz
    meets_s = rng.uniform(0.0, max(duration_s, 1.0 / options.rate_hz))
    place_m = float(np.interp(meets_s, own.time_s, own.travelled_m)) + rng.uniform(*REACH_M)
    time_s = np.array([-2.0, duration_s + 2.0])
    motion = Motion(
        street=layout.streets[route.street],
        ground=layout.ground,
        route=Route(
            street=route.street, start_m=route.start_m, direction=route.direction, lane_m=float(rng.uniform(*LATERAL_M))
        ),
        time_s=time_s,
        travelled_m=place_m + speed * (time_s - meets_s),
        sway_phase=float(rng.uniform(0, 2 * np.pi)),
        sway_m=0.0,
    )
    count = int(rng.integers(*PARTS))
    low = rng.uniform(*HEIGHT_M, count)
    parts = np.stack(
        [
            rng.uniform(-2.6, 2.6, count),
            rng.uniform(-1.5, 1.5, count),
            low,
            low + rng.uniform(0.04, 0.3, count),
            rng.uniform(0.0, np.pi, count),
            rng.uniform(0.12, 0.45, count),
            rng.uniform(0.06, 0.22, count),
        ],
        -1,
    )
    return ShadowCaster(motion=motion, parts=parts)
