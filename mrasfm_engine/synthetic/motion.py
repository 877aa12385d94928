"""Motion of vehicles: the pose of the rig at any instant of a drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.options import SpeedProfile, SynthOptions
from mrasfm_engine.synthetic.streets import Ground, Layout, Route, Street
from mrasfm_engine.types import Floats

_WHEELBASE_M = 2.7
_TRACK_M = 1.6
_AHEAD_M, _AHEAD_STEP_M = 12.0, 14.0  # from rear axle to rear axle of the first car ahead, and of the next ones
_SWING_M, _SWING_S = 1.5, 8.0  # of the distances of cars ahead
_BESIDE_M, _BESIDE_STEP_M = 2.0, 12.0  # of the first car beside, and how much farther back the next ones are
_OVERTAKES_M_S = 1.5


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One vehicle's motion; times are seconds since the drive's first unit."""

    street: Street
    ground: Ground
    route: Route
    time_s: Floats  # (n,) knots
    travelled_m: Floats  # (n,) from the start of the route
    sway_phase: float
    sway_m: float = 0.35

    def _point(self, travelled: Floats) -> Floats:
        """Ground positions (..., 2) below the reference point."""
        lateral = self.route.lane_m + self.sway_m * np.sin(travelled / 4.3 + self.sway_phase)
        xy, _ = self.street.at(self.route.start_m + self.route.direction * travelled, -self.route.direction * lateral)
        return xy

    def world_from_rig(self, time_s: ArrayLike) -> Floats:
        """Poses (..., 4, 4): origin on the ground below the rear axle, x forward, y left, z up.

        The body rolls and pitches on its springs by 0.3 degrees, beside following the ground.
        """
        t = np.asarray(time_s, dtype=np.float64)
        s = np.interp(t, self.time_s, self.travelled_m)
        at = self._point(s)
        tangent = self._point(s + 0.4) - self._point(s - 0.4)
        forward = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        left = np.stack([-forward[..., 1], forward[..., 0]], -1)
        z = self.ground.height(at)
        pitch = -np.arctan2(self.ground.height(at + _WHEELBASE_M * forward) - z, _WHEELBASE_M)
        half = _TRACK_M / 2
        roll = np.arctan2(self.ground.height(at + half * left) - self.ground.height(at - half * left), _TRACK_M)
        # Springs follow the distance travelled, so that a standing car stands still.
        pitch = pitch + np.radians(0.3) * np.sin(s / 1.9 + 2 * self.sway_phase)
        roll = roll + np.radians(0.3) * np.sin(s / 2.7 + 3 * self.sway_phase)
        yaw = np.arctan2(forward[..., 1], forward[..., 0])
        rotation = (
            se3.exp_so3(yaw[..., None] * np.array([0.0, 0.0, 1.0]))
            @ se3.exp_so3(pitch[..., None] * np.array([0.0, 1.0, 0.0]))
            @ se3.exp_so3(roll[..., None] * np.array([1.0, 0.0, 0.0]))
        )
        lifted = np.concatenate([at, (z + 0.01 * np.sin(s / 1.4))[..., None]], -1)
        return se3.transform(rotation, lifted)


def drive_motion(options: SynthOptions, layout: Layout, drive: int, rng: np.random.Generator) -> Motion:
    """The recording vehicle's motion in a drive: from 1 s before the first unit to 1 s after the last."""
    dt = 0.005
    t = np.arange(-1.0, (options.units - 1) / options.rate_hz + 1.0, dt)
    mean = options.spacing_m * options.rate_hz
    phase = rng.uniform(0, 2 * np.pi)
    if options.speed_profile is SpeedProfile.VARYING:
        speed = 7.5 + 4.5 * np.sin(2 * np.pi * t / max(t[-1], 2.0) + phase)
    elif options.speed_profile is SpeedProfile.GENTLE:
        speed = mean * (1 + 0.08 * np.sin(2 * np.pi * t / 4.0 + phase))
    else:
        speed = np.full_like(t, mean)
    if options.standing_units:
        first = (options.units - options.standing_units) // 2 / options.rate_hz
        last = first + (options.standing_units - 1) / options.rate_hz
        # Braking and starting take half a second.
        speed = speed * np.clip(np.maximum(first - t, t - last) / 0.5, 0.0, 1.0)
    travelled = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * dt)])
    travelled -= np.interp(0.0, t, travelled)
    if options.speed_profile is not SpeedProfile.VARYING:
        # Keep the promised length, on which overlaps between drives depend.
        end = float(np.interp((options.units - 1) / options.rate_hz, t, travelled))
        if options.units > 1 and end > 0:
            travelled *= options.drive_length_m / end
    route = layout.routes[drive]
    return Motion(
        street=layout.streets[route.street],
        ground=layout.ground,
        route=route,
        time_s=t,
        travelled_m=travelled,
        sway_phase=float(rng.uniform(0, 2 * np.pi)),
    )


def traffic(options: SynthOptions, layout: Layout, drive: int, rng: np.random.Generator) -> list[Motion]:
    """Other vehicles on the drive's street: most come towards it, some drive ahead or behind in its lane."""
    route = layout.routes[drive]
    duration = (options.units - 1) / options.rate_hz
    t = np.array([-2.0, duration + 2.0])
    result = []
    own = options.spacing_m * options.rate_hz
    for k in range(options.moving_cars):
        oncoming = k % 3 != 2
        if oncoming:
            speed = rng.uniform(6.0, 12.0)
            start = route.start_m + route.direction * (rng.uniform(8.0, 20.0) + k * 14.0)
        else:
            # Those who drive the same way keep their distance.
            speed = 0.97 * own
            start = route.start_m + route.direction * (16.0 if k % 2 == 0 else -16.0)
        result.append(
            Motion(
                street=layout.streets[route.street],
                ground=layout.ground,
                route=Route(
                    street=route.street,
                    start_m=start,
                    direction=-route.direction if oncoming else route.direction,
                    lane_m=1.75,
                ),
                time_s=t,
                travelled_m=speed * (t - 0.0),
                sway_phase=float(rng.uniform(0, 2 * np.pi)),
                sway_m=0.1,
            )
        )
    return result


def same_way_cars(options: SynthOptions, layout: Layout, drive: int, own: Motion) -> list[Motion]:
    """Vehicles that drive along with the recording one: ahead of it in its lane, and in the lane beside it.

    Those ahead keep a distance that swings by a few metres; those beside overtake or fall back.
    """
    route = layout.routes[drive]
    result = []
    for k in range(options.same_way_cars):
        ahead = k % 2 == 0
        place = k // 2
        gap_m = _AHEAD_M + place * _AHEAD_STEP_M if ahead else _BESIDE_M - place * _BESIDE_STEP_M
        t = own.time_s
        if ahead:
            lead_m = gap_m + _SWING_M * np.sin(2 * np.pi * t / _SWING_S + place)
        else:
            lead_m = gap_m + (_OVERTAKES_M_S if place % 2 == 0 else -_OVERTAKES_M_S) * t
        result.append(
            Motion(
                street=layout.streets[route.street],
                ground=layout.ground,
                route=Route(
                    street=route.street,
                    start_m=route.start_m,
                    direction=route.direction,
                    lane_m=route.lane_m if ahead else -route.lane_m,
                ),
                time_s=t,
                travelled_m=own.travelled_m + lead_m,
                sway_phase=float(k),
                sway_m=0.1,
            )
        )
    return result
