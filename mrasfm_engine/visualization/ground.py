"""The height of the ground along the trajectory, from the scene's own points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats, Ints

REACH_M = 12.0  # points farther from the trajectory than this say nothing of the ground beside it,
LANE_SIGMA_M = 2.0  # and the farther to its side they are the less: there are kerbs
BELOW_CAMERAS_M = (0.3, 6.0)  # the ground is that far below the lowest camera
MAX_SLOPE = 0.12  # of the ground against the rig
INLIER_M = 0.08
MIN_POINTS = 40
MIN_SHARE = 0.1  # of the points below the cameras, that must lie in one plane: between cars few do
# Bonnets and window sills of cars that stand in line make a plane too, with the road's points below it. Below the road
# are only wrong points and reflections.
BELOW_M = 0.25
SIMILAR_M = 0.4  # two points of one level 7 m apart on a slope of 0.06: the road's, seldom those of a car beside it
MAX_SHARE_BELOW = 0.1  # of the plane's own points
SAMPLED_POINTS = 4000
HYPOTHESES = 400
STATION_M = 2.0  # between the patches
PATCH_RADIUS_M = 8.0
BLEND_SIGMA_M = 3.0
BLENDED_PATCHES = 24  # at one place: all within four sigmas of a way that goes there twice
SMALLEST_WEIGHT = 0.01
HEIGHT_STEP_M = 0.5  # of the grid on which heights are interpolated
TILE_STEPS = 16
LOSS_SCALE = 1.5  # in sigmas
POINT_SIGMA_M = 0.03  # of a ground point's height; its triangulation and the road's unevenness
# How far a patch may be from where the rig's plane puts it: the car pitches, the road bends.
PATCH_SIGMA_M, PATCH_SIGMA_SLOPE = 0.1, 0.03


class GroundHeights(Protocol):
    """Height of the ground, in a frame whose z axis points up."""

    def height_m(self, xy_m: Floats) -> Floats:
        """Heights (n,) of the ground at positions (n, 2)."""
        ...


@dataclass(frozen=True, kw_only=True)
class GroundPatches:
    """Planes `z = p0 + p1 (x - x_centre) + p2 (y - y_centre)` along the path, the nearest ones blended by distance."""

    centre_m: Floats  # (k, 2)
    plane: Floats  # (k, 3) height at the centre in metres, and two slopes

    @cached_property
    def _kd_tree(self) -> cKDTree:
        return cKDTree(self.centre_m)

    def height_m(self, xy_m: Floats) -> Floats:
        """See `GroundHeights`; takes as long for a long trajectory as for a short one."""
        count = min(BLENDED_PATCHES, len(self.centre_m))
        distance, nearest = (np.reshape(a, (len(xy_m), count)) for a in self._kd_tree.query(xy_m, k=count))
        offset, plane = xy_m[:, None] - self.centre_m[nearest], self.plane[nearest]
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / BLEND_SIGMA_M**2)
        height = plane[..., 0] + (offset * plane[..., 1:]).sum(-1)
        result: Floats = (weight * height).sum(1) / weight.sum(1)
        return result


class GroundTiles:
    """Heights at the corners of squares of `HEIGHT_STEP_M`, computed at the first use.

    So they cost time and memory by the length of the trajectory, and not by the rectangle that it fits into.
    """

    def __init__(self, ground: GroundHeights) -> None:
        self._ground = ground
        self._tiles: dict[tuple[int, int], Floats] = {}
        self._last: tuple[list[int], Floats] | None = None

    def around(self, centre_m: Floats, reach_m: float) -> tuple[Floats, Floats]:
        """Heights (rows, columns), y growing with the rows, that cover the square of `reach_m` around a place (2,).

        And x and y (2,) of the first one.
        """
        side_m = TILE_STEPS * HEIGHT_STEP_M
        low = np.floor((centre_m - reach_m) / side_m).astype(int)
        # One step more: interpolation asks for the corner after the place.
        high = np.floor((centre_m + reach_m + HEIGHT_STEP_M) / side_m).astype(int)
        corners = [*low.tolist(), *high.tolist()]
        # The cameras of one rig stand close together.
        last = self._last  # of whichever thread
        if last is None or last[0] != corners:
            tiles = [[self._tile(i, j) for i in range(low[0], high[0] + 1)] for j in range(low[1], high[1] + 1)]
            self._last = last = corners, np.block(tiles)
        return last[1], low * side_m

    def _tile(self, i: int, j: int) -> Floats:
        if (i, j) not in self._tiles:
            steps = np.arange(TILE_STEPS)
            x, y = np.meshgrid(*(HEIGHT_STEP_M * (TILE_STEPS * n + steps) for n in (i, j)))
            height = self._ground.height_m(np.column_stack([x.ravel(), y.ravel()]))
            self._tiles[i, j] = height.reshape(TILE_STEPS, TILE_STEPS)
        return self._tiles[i, j]


def estimate_ground(
    points_m: Floats, world_from_rig: Floats, camera_position_m: Floats, *, rng: np.random.Generator
) -> GroundPatches | None:
    """The ground's height along the trajectory; None where too few points lie on a plane below the cameras.

    First the plane that the ground is on average in the rig's frame, by RANSAC over the points near every unit: that
    is the rig's height and its pitch against the road. Then a patch every `STATION_M`, fitted robustly to the points
    around it and held near that plane, so that hills are followed and holes are bridged.

    Parameters
    ----------
    points_m
        The scene's points (n, 3) in a frame whose z axis points up.
    world_from_rig
        Poses (u, 4, 4) of the registered units in that frame.
    camera_position_m
        Where the cameras sit on the rig (c, 3).
    """
    if len(points_m) < MIN_POINTS:
        return None
    distance, nearest = cKDTree(world_from_rig[:, :2, 3]).query(points_m[:, :2], distance_upper_bound=REACH_M)
    near = np.flatnonzero(np.isfinite(distance))
    poses = world_from_rig[np.asarray(nearest)[near]]
    in_rig = np.einsum("nji,nj->ni", poses[:, :3, :3], points_m[near] - poses[:, :3, 3])
    depth = camera_position_m[:, 2].min() - in_rig[:, 2]
    low = (depth > BELOW_CAMERAS_M[0]) & (depth < BELOW_CAMERAS_M[1])
    weight = np.exp(-0.5 * (in_rig[low, 1] / LANE_SIGMA_M) ** 2)
    rig_plane = _best_plane(in_rig[low], weight, rng)
    if rig_plane is None:
        return None
    return _patches(points_m[near[low]], weight, world_from_rig[_stations(world_from_rig[:, :3, 3])], rig_plane)


def _best_plane(points: Floats, weight: Floats, rng: np.random.Generator) -> Floats | None:
    """The plane z = p0 + p1 x + p2 y (3,) that most points (n, 3) lie on and few below, nearly level; None where there
    is none."""
    chosen = rng.permutation(np.flatnonzero(weight > SMALLEST_WEIGHT))[:SAMPLED_POINTS]
    if len(chosen) < MIN_POINTS:
        return None
    chosen = chosen[np.argsort(points[chosen, 2], kind="stable")]
    sample, weight = points[chosen], weight[chosen]
    rows = np.column_stack([np.ones(len(sample)), sample[:, :2]])
    best, plane = 0.0, None
    for three in _similar_heights(sample[:, 2], weight, rng):
        try:
            candidate = np.linalg.solve(rows[three], sample[three, 2])
        except np.linalg.LinAlgError:
            continue
        if np.hypot(candidate[1], candidate[2]) > MAX_SLOPE:
            continue
        above = sample[:, 2] - rows @ candidate
        score = float(weight[np.abs(above) < INLIER_M].sum())
        if score > best and weight[above < -BELOW_M].sum() < MAX_SHARE_BELOW * score:
            best, plane = score, candidate
    if plane is None or best < MIN_SHARE * weight.sum():
        return None
    return _fitted(rows, sample[:, 2], weight, start=plane)


def _similar_heights(height_m: Floats, weight: Floats, rng: np.random.Generator) -> Iterator[Ints]:
    """Triples of points, of ascending heights (n,), as their weights have it: a first one and two of about its height.

    Where few points are the ground's, hardly any three that have nothing to do with each other are all three.
    """
    total = np.concatenate([[0.0], np.cumsum(weight)])
    for _ in range(HYPOTHESES):
        first = height_m[min(int(np.searchsorted(total, rng.uniform(0.0, total[-1]), side="right")), len(weight)) - 1]
        low, high = np.searchsorted(height_m, [first - SIMILAR_M, first + SIMILAR_M])
        chosen = np.searchsorted(total, rng.uniform(total[low], total[high], 3), side="right") - 1
        yield np.minimum(chosen, len(weight) - 1)


def _fitted(rows: Floats, height_m: Floats, weight: Floats, *, start: Floats, sigma: Floats | None = None) -> Floats:
    """Iteratively reweighted (Geman-McClure) plane (3,) from a start near it; held there with `sigma` (3,) if given."""
    plane = start
    for _ in range(10):
        residual = height_m - rows @ plane
        robust = weight * (1.0 + (residual / (LOSS_SCALE * POINT_SIGMA_M)) ** 2) ** -2 / POINT_SIGMA_M**2
        h, g = rows.T @ (robust[:, None] * rows), rows.T @ (robust * residual)
        if sigma is not None:
            h, g = h + np.diag(1 / sigma**2), g + (start - plane) / sigma**2
        plane = plane + np.linalg.solve(h + 1e-9 * np.eye(3), g)
    result: Floats = plane
    return result


def _stations(position_m: Floats) -> Ints:
    """Units (k,) at least `STATION_M` apart along the trajectory."""
    chosen = [0]
    for u in range(1, len(position_m)):
        if np.linalg.norm(position_m[u] - position_m[chosen[-1]]) >= STATION_M:
            chosen.append(u)
    return np.array(chosen, dtype=np.int64)


def _patches(points_m: Floats, weight: Floats, stations: Floats, rig_plane: Floats) -> GroundPatches:
    tree = cKDTree(points_m[:, :2])
    normal = np.array([-rig_plane[1], -rig_plane[2], 1.0])
    centres, planes = [], []
    for pose in stations:
        foot = se3.apply(pose, [[0.0, 0.0, rig_plane[0]]])[0]
        up = pose[:3, :3] @ normal
        given = np.array([foot[2], -up[0] / up[2], -up[1] / up[2]])
        near = tree.query_ball_point(foot[:2], PATCH_RADIUS_M)
        around = points_m[near]
        rows = np.column_stack([np.ones(len(around)), around[:, :2] - foot[:2]])
        sigma = np.array([PATCH_SIGMA_M, PATCH_SIGMA_SLOPE, PATCH_SIGMA_SLOPE])
        # What the patch may hold at all: a wall's points would pull it in small steps.
        close = np.abs(rows @ given - around[:, 2]) < 3 * np.hypot(PATCH_SIGMA_M, PATCH_SIGMA_SLOPE * PATCH_RADIUS_M)
        centres.append(foot[:2])
        planes.append(_fitted(rows[close], around[close, 2], weight[near][close], start=given, sigma=sigma))
    return GroundPatches(centre_m=np.array(centres), plane=np.array(planes))
