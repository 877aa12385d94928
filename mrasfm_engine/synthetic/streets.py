"""Layout of the streets, height of the ground, and the path of each drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.synthetic.options import LOOP_OVERLAP_M, SynthOptions, World
from mrasfm_engine.types import Floats

ROAD_HALF_M = 5.4  # two lanes and a parking lane on each side
KERB_M = 0.12
SIDEWALK_M = 2.9  # width
LANE_M = 1.65  # centre of the right lane, to the right of the street's axis
TURN_AFTER_M, TURN_WAY_M = 4.0, 30.0  # of a street that turns; its radius is 9.5 m in the middle of it
MARGIN_M = 75.0  # street before and after a drive
_STEP_M = 0.25
GROUND_GRID_M = 4.0


@dataclass(frozen=True)
class Street:
    """A street's axis as a fine polyline; `closed` returns to its start."""

    points: Floats  # (n, 2)
    closed: bool = False

    @property
    def length_m(self) -> float:
        """Length from the first point to the last, and back to the first if closed."""
        return float(self._s[-1])

    @cached_property
    def _s(self) -> Floats:
        return np.linspace(0.0, (len(self.points) - 1) * _STEP_M, len(self.points))

    @cached_property
    def _heading(self) -> Floats:
        dx, dy = np.gradient(self.points, axis=0).T
        result: Floats = np.asarray(np.unwrap(np.arctan2(dy, dx)), dtype=np.float64)
        return result

    def at(self, s_m: ArrayLike, lateral_m: ArrayLike = 0.0) -> tuple[Floats, Floats]:
        """Positions (..., 2) and headings (...) in radians at arc lengths, `lateral_m` to the left of the axis."""
        s = np.asarray(s_m, dtype=np.float64)
        if self.closed:
            s = np.mod(s, self.length_m)
        inside = np.clip(s, 0.0, self.length_m)
        x, y = (np.interp(inside, self._s, self.points[:, k]) for k in (0, 1))
        heading = np.interp(inside, self._s, self._heading)
        # Beyond its ends a street goes straight on.
        ahead = s - inside
        c, sn = np.cos(heading), np.sin(heading)
        lateral = np.asarray(lateral_m, dtype=np.float64)
        return np.stack([x + ahead * c - lateral * sn, y + ahead * sn + lateral * c], -1), heading

    def distance(self, xy: Floats) -> Floats:
        """Distances (n,) of points (n, 2) from the axis."""
        coarse = self.points[::4]
        result: Floats = np.sqrt(((xy[:, None] - coarse[None]) ** 2).sum(-1).min(1))
        return result


@dataclass(frozen=True)
class Ground:
    """Height of the ground: level, then a ramp, then level again, along one direction.

    Heights are linear between nodes every 4 m, so that a grid of flat pieces is exact.
    """

    direction: Floats  # (2,) unit vector
    nodes_m: Floats  # (k,) heights at multiples of 4 m along the direction from `first_m`
    first_m: float

    def height(self, xy: ArrayLike) -> Floats:
        """Heights (...) of points (..., 2)."""
        q = np.asarray(xy, dtype=np.float64) @ self.direction
        at = self.first_m + np.arange(len(self.nodes_m)) * GROUND_GRID_M
        result: Floats = np.interp(q, at, self.nodes_m)
        return result

    def lift(self, xy: ArrayLike, above_m: float = 0.0) -> Floats:
        """Points (..., 3) above the ground at (..., 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        return np.concatenate([xy, (self.height(xy) + above_m)[..., None]], -1)


@dataclass(frozen=True, kw_only=True)
class Route:
    """A drive's trajectory along one street."""

    street: int
    start_m: float  # arc length of the first unit
    direction: int  # 1 along the axis, -1 against it
    lane_m: float = LANE_M  # to the right of the axis in driving direction


@dataclass(frozen=True, kw_only=True)
class Layout:
    """All streets, the ground, and one route a drive."""

    streets: list[Street]
    ground: Ground
    routes: list[Route]


def _line(start: Floats, heading: float, length_m: float) -> Street:
    s = np.arange(0.0, length_m + _STEP_M, _STEP_M)
    return Street(start + s[:, None] * np.array([np.cos(heading), np.sin(heading)]))


def _winding(heading: float, length_m: float) -> Street:
    """A street whose heading swings by 24 degrees to both sides; its arc length MARGIN_M is at the world's origin."""
    s = np.arange(0.0, length_m + _STEP_M, _STEP_M)
    angle = heading + np.radians(24.0) * np.sin((s - MARGIN_M) / 19.0)
    steps = np.stack([np.cos(angle), np.sin(angle)], -1)[:-1] * _STEP_M
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    return Street(points - points[round(MARGIN_M / _STEP_M)])


def _turning(heading: float, length_m: float) -> Street:
    """A straight street that turns to the left by 90 degrees soon after arc length MARGIN_M, at the world's origin.

    Its curvature rises and falls smoothly, as a steering wheel is turned.
    """
    s = np.arange(0.0, length_m + _STEP_M, _STEP_M)
    x = np.clip((s - MARGIN_M - TURN_AFTER_M) / TURN_WAY_M, 0.0, 1.0)
    angle = heading + np.pi / 2 * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
    steps = np.stack([np.cos(angle), np.sin(angle)], -1)[:-1] * _STEP_M
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    return Street(points - points[round(MARGIN_M / _STEP_M)])


def _block(heading: float, length_m: float) -> Street:
    """A closed rounded rectangle, counter-clockwise."""
    radius = 9.0
    straight = length_m - 2 * np.pi * radius
    sides = [straight * f for f in (0.29, 0.21, 0.29, 0.21)]
    count = round(length_m / _STEP_M)
    s = np.arange(count) * (length_m / count)
    # Start in the middle of the first side.
    s = np.mod(s + sides[0] / 2, length_m)
    angle = np.zeros_like(s)
    at = 0.0
    for side in sides:
        angle += np.clip((s - at - side) / radius, 0.0, np.pi / 2)
        at += side + radius * np.pi / 2
    # After one round the heading has grown by a full turn.
    angle = heading + np.unwrap(angle)
    steps = np.stack([np.cos(angle), np.sin(angle)], -1) * (length_m / count)
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    # Integration leaves a gap of centimetres: spread it over the whole round.
    points -= np.linspace(0, 1, len(points))[:, None] * (points[-1] - points[0])
    return Street(points, closed=True)


def _hill(heading: float, percent: float, length_m: float) -> Ground:
    direction = np.array([np.cos(heading), np.sin(heading)])
    if percent == 0:
        return Ground(direction, np.zeros(2), 0.0)
    q = np.arange(-400.0, 800.0, GROUND_GRID_M)
    # Flat, up from 10 m on for 60 % of the trajectory, flat; slopes change over 12 m.
    begin, end = 10.0, 10.0 + max(20.0, 0.6 * length_m)
    fine = np.arange(-400.0, 804.0, 0.5)
    slope = percent / 100 * np.clip((fine - begin) / 12.0, 0, 1) * np.clip((end - fine) / 12.0, 0, 1)
    height = np.cumsum(slope) * 0.5
    height -= np.interp(0.0, fine, height)
    return Ground(direction, np.interp(q, fine, height), float(q[0]))


def lay_out(options: SynthOptions, rng: np.random.Generator) -> Layout:
    """Streets and routes of a world."""
    heading = float(rng.uniform(0.3, 0.9))
    length = options.drive_length_m
    ground = _hill(heading, options.ramp_percent, length)
    if options.world is World.LOOP:
        per_drive = options.loop_length_m / options.drives
        block = _block(heading, options.loop_length_m)
        routes = [Route(street=0, start_m=k * per_drive, direction=1) for k in range(options.drives)]
        assert abs(options.drive_length_m - per_drive - LOOP_OVERLAP_M) < 1e-6
        return Layout(streets=[block], ground=ground, routes=routes)
    total = length * (1.6 if options.drives > 1 else 1.0) + 2 * MARGIN_M
    if options.straight or options.world is World.REPEATED:
        along = np.array([np.cos(heading), np.sin(heading)])
        first = _line(-MARGIN_M * along, heading, total)
    elif options.world is World.TURN:
        first = _turning(heading, total)
    else:
        first = _winding(heading, total)
    if options.world is World.REPEATED:
        across = np.array([-np.sin(heading), np.cos(heading)])
        second = Street(first.points + 60.0 * across)
        routes = [Route(street=k % 2, start_m=MARGIN_M + 2.0 * (k // 2), direction=1) for k in range(options.drives)]
        return Layout(streets=[first, second] if options.drives > 1 else [first], ground=ground, routes=routes)
    if options.world in (World.STREET, World.TURN):
        routes = [
            Route(street=0, start_m=MARGIN_M + 0.25 * length * (k % 3), direction=1, lane_m=LANE_M - 0.2 * (k % 2))
            for k in range(options.drives)
        ]
        return Layout(streets=[first], ground=ground, routes=routes)
    return _crossing(options, first, heading, ground)


def _crossing(options: SynthOptions, first: Street, heading: float, ground: Ground) -> Layout:
    length = options.drive_length_m
    middle, along = first.at(MARGIN_M + 0.5 * length)
    across = float(along) + np.radians(82.0)
    unit = np.array([np.cos(across), np.sin(across)])
    second = _line(middle - unit * (MARGIN_M + 0.5 * length), across, length + 2 * MARGIN_M)
    streets = [first, second]
    paths = [
        Route(street=0, start_m=MARGIN_M, direction=1),
        Route(street=0, start_m=MARGIN_M + 0.1 * length, direction=1, lane_m=LANE_M - 0.3),
        Route(street=0, start_m=MARGIN_M + 1.05 * length, direction=-1),
        Route(street=1, start_m=MARGIN_M, direction=1),
        Route(street=0, start_m=MARGIN_M + 0.55 * length, direction=1),
        Route(street=1, start_m=MARGIN_M + length, direction=-1),
    ]
    routes = [paths[k % len(paths)] for k in range(options.drives)]
    if options.drives >= 7:
        away = first.points[0] - 300.0 * np.array([np.cos(heading), np.sin(heading)])
        far = _line(away - unit * (MARGIN_M + length / 2), across, length + 2 * MARGIN_M)
        streets.append(far)
        routes[-1] = Route(street=2, start_m=MARGIN_M, direction=1)
    return Layout(streets=streets, ground=ground, routes=routes)
