"""A city without images: streets in a grid, a route that comes back to them, and points on houses, trees and roads.

Middles of streets lie at multiples of `BLOCK_M`; between them stand houses that nothing is seen through. The world is
x east, y north, z up.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from mrasfm_engine.geometry import se3
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Floats

Junction = tuple[int, int]

_BLOCK_X_M, _BLOCK_Y_M = 120.0, 100.0
BLOCK_M = np.array([_BLOCK_X_M, _BLOCK_Y_M])  # between the middles of streets, along x and along y
HOUSES_M = 9.0  # from the middle of a street to the houses' walls
LANE_M = 1.75  # to the right of the middle
TURN_RADIUS_M = 8.0
SWAY_M = 0.3  # nobody drives exactly in the middle of a lane, nor twice in the same place
SEEN_FROM_M = 70.0  # streets farther than this from the route have no points
POINTS_PER_M = 500.0  # of street
ROUND_A_BLOCK: tuple[Junction, ...] = ((1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (2, 1))

# How willingly a street is taken: a new one, one that was driven in the same direction, one driven only in the other.
NEW, AGAIN, OPPOSITE = 1.0, 0.8, 0.3
NEW_STREETS = 0.75  # of a route's streets; the city is as small as that

_STEP_M = 0.1
_SIGHT_SAMPLES = 20


def ground_m(xy_m: ArrayLike) -> Floats:
    """Height (...) of the ground at (..., 2): slopes of up to 3 %."""
    xy = np.asarray(xy_m, dtype=np.float64)
    result: Floats = 1.5 * np.sin(xy[..., 0] / 70.0) + 1.2 * np.cos(xy[..., 1] / 55.0)
    return result


def walk(streets: int, rng: np.random.Generator) -> list[Junction]:
    """Junctions (streets + 1) of a route: once around a block and into its first street again, then at random.

    At a junction it goes on in any direction but back, so that it crosses and follows streets that it knows.
    """
    side = 3
    while 2 * side * (side - 1) < NEW_STREETS * streets:
        side += 1
    route = list(ROUND_A_BLOCK[: streets + 1])
    driven = Counter(pairwise(route))
    while len(route) <= streets:
        before, here = route[-2], route[-1]
        around = [(here[0] + dx, here[1] + dy) for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ahead = [j for j in around if j != before and min(j) >= 0 and max(j) < side]
        known = [AGAIN if driven[here, j] else OPPOSITE if driven[j, here] else NEW for j in ahead]
        chosen = ahead[int(rng.choice(len(ahead), p=np.array(known) / sum(known)))]
        driven[here, chosen] += 1
        route.append(chosen)
    return route


def city_route(travelled_m: float, rng: np.random.Generator) -> CityRoute:
    """A route of at least `travelled_m` through a city that is small enough for it to come back."""
    # A street less what corners cut off is longer than 90 m.
    return route_over(walk(math.ceil(travelled_m / 90.0) + 2, rng), rng)


def route_over(junctions: Sequence[Junction], rng: np.random.Generator) -> CityRoute:
    """A route over junctions, from the first to the last; each is a street from the one before."""
    middle = _middle_of_street(np.array(junctions, dtype=np.float64) * BLOCK_M)
    along = _lengths(middle)
    right = -LANE_M + SWAY_M * np.sin(along / 17.0 + rng.uniform(0, 2 * np.pi))
    forward = np.gradient(middle, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    xy = middle + right[:, None] * np.stack([-forward[:, 1], forward[:, 0]], -1)
    return CityRoute(xy_m=xy, travelled_m=_lengths(xy))


def _lengths(xy_m: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])


def _middle_of_street(corners_m: Floats) -> Floats:
    """Points (n, 2) every 10 cm along a route over junctions, whose corners are quarter circles."""
    ends, pieces = corners_m[0], []
    for before, here, after in zip(corners_m[:-2], corners_m[1:-1], corners_m[2:], strict=True):
        come, go = (d / np.linalg.norm(d) for d in (here - before, after - here))
        if come @ go > 0.5:
            continue  # straight on
        start = here - TURN_RADIUS_M * come
        pieces.append(_line(ends, start))
        angle = np.arange(_STEP_M / TURN_RADIUS_M, np.pi / 2, _STEP_M / TURN_RADIUS_M)[:, None]
        pieces.append(start + TURN_RADIUS_M * (np.sin(angle) * come + (1 - np.cos(angle)) * go))
        ends = here + TURN_RADIUS_M * go
    pieces.append(_line(ends, corners_m[-1]))
    return np.concatenate(pieces)


def _line(start: Floats, end: Floats) -> Floats:
    steps = max(1, round(float(np.linalg.norm(end - start)) / _STEP_M))
    return start + np.arange(steps)[:, None] / steps * (end - start)


@dataclass(frozen=True, kw_only=True)
class CityRoute:
    """The path of a vehicle's rear axle through the city, as a fine polyline."""

    xy_m: Floats  # (n, 2)
    travelled_m: Floats  # (n,) driven until there

    def world_from_rig(self, travelled_m: ArrayLike) -> Floats:
        """Poses (..., 4, 4) after a distance (...) travelled: x forward, y left, z up, origin on the ground.

        The body follows the ground, and pitches and rolls on its springs by 0.3 degrees.
        """
        along_m = np.asarray(travelled_m, dtype=np.float64)
        at = self._at(along_m)
        forward = self._at(along_m + 0.4) - self._at(along_m - 0.4)
        forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
        left = np.stack([-forward[..., 1], forward[..., 0]], -1)
        pitch = -np.arctan2(ground_m(at + forward) - ground_m(at - forward), 2.0) + 0.005 * np.sin(along_m / 1.9)
        roll = np.arctan2(ground_m(at + left) - ground_m(at - left), 2.0) + 0.005 * np.sin(along_m / 2.7)
        yaw = np.arctan2(forward[..., 1], forward[..., 0])
        rotation = (
            se3.exp_so3(yaw[..., None] * np.array([0.0, 0.0, 1.0]))
            @ se3.exp_so3(pitch[..., None] * np.array([0.0, 1.0, 0.0]))
            @ se3.exp_so3(roll[..., None] * np.array([1.0, 0.0, 0.0]))
        )
        return se3.transform(rotation, np.concatenate([at, ground_m(at)[..., None]], -1))

    def _at(self, travelled_m: Floats) -> Floats:
        return np.stack([np.interp(travelled_m, self.travelled_m, self.xy_m[:, k]) for k in range(2)], -1)


def points_beside(route_xy_m: Floats, rng: np.random.Generator) -> Floats:
    """Points (n, 3) of all streets that are seen from a route (m, 2): of ten six on houses, two on what stands before
    them, the rest on the road."""
    low = np.floor(route_xy_m.min(0) / BLOCK_M).astype(int) - 1
    high = np.ceil(route_xy_m.max(0) / BLOCK_M).astype(int) + 1
    near = cKDTree(route_xy_m)
    streets = []
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            for axis in (0, 1):
                start = np.array([i, j]) * BLOCK_M
                middle = start + np.linspace(0.0, 1.0, 9)[:, None] * np.eye(2)[axis] * BLOCK_M
                if np.min(near.query(middle)[0]) < SEEN_FROM_M:
                    streets.append(_points_of_street(start, axis, rng))
    return np.concatenate(streets)


def _points_of_street(start_m: Floats, axis: int, rng: np.random.Generator) -> Floats:
    length = float(BLOCK_M[axis])
    n = round(POINTS_PER_M * length)
    kind, side = rng.random(n), rng.choice([-1.0, 1.0], n)
    house, road = kind < 0.6, kind > 0.8
    along = np.where(house, rng.uniform(HOUSES_M, length - HOUSES_M, n), rng.uniform(0.0, length, n))
    across = np.where(house, rng.uniform(HOUSES_M - 0.8, HOUSES_M - 0.05, n), rng.uniform(4.5, HOUSES_M - 1.0, n))
    across = side * np.where(road, rng.uniform(0.0, 4.5, n), across)
    above = np.where(house, rng.uniform(0.2, 11.0, n), rng.uniform(0.1, 4.0, n))
    xy = start_m + along[:, None] * np.eye(2)[axis] + across[:, None] * np.eye(2)[1 - axis]
    return np.concatenate([xy, (ground_m(xy) + np.where(road, 0.0, above))[:, None]], -1)


@njit(cache=True, nogil=True)
def in_sight(from_x_m: float, from_y_m: float, x_m: float, y_m: float) -> bool:
    """True if no house blocks the line of sight between two places."""
    for k in range(_SIGHT_SAMPLES):
        share = (k + 0.5) / _SIGHT_SAMPLES
        x = (from_x_m + share * (x_m - from_x_m)) % _BLOCK_X_M
        y = (from_y_m + share * (y_m - from_y_m)) % _BLOCK_Y_M
        if HOUSES_M < x < _BLOCK_X_M - HOUSES_M and HOUSES_M < y < _BLOCK_Y_M - HOUSES_M:
            return False
    return True
