"""Points of the road where no mask names it: those on one level below the vehicle's trajectory."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.triangulation.road_patches import MIN_POINTS
from mrasfm_engine.triangulation.road_surface import horizontal_axes, most_frequent
from mrasfm_engine.types import Bools, Floats

CORRIDOR_M = 3.0  # to both sides of the trajectory: a lane
# Of the corridor, which tells the level where it has points: cars that are parked beside it, whose bonnets and window
# sills make levels too, stand farther away than half a car's width and what passing them takes.
FREE_M = 2.0
FREE_POINTS, FREE_SHARE = 20, 0.02  # a few wrong points, of all in the corridor, tell no level
DRIVEN_M = 0.8  # to both sides of the trajectory: where the vehicle itself was
VEHICLE_HEIGHT_M = 1.2  # above the road, in which nothing was where the vehicle drove
AHEAD_M = 12.0  # how far beyond the ends of the trajectory the road is believed to go on
BELOW_CAMERAS_M = 0.3  # the road is at least that far below the lowest camera
ON_LEVEL_M = 0.1  # half the thickness of the road itself, as triangulation has it
LEVEL_M = 0.5  # half the thickness of the layer that holds the road and what is wrong about it
LEVEL_PER_M = 0.08  # what slopes add to it a metre of distance from the vehicle
MIN_SHARE = 0.2  # of the points below the cameras on the way that must be on one level


def points_below_trajectory(points_m: Floats, world_from_rig: Floats, lowest_camera_m: float) -> Bools | None:
    """Return which points (n, 3) are near the road's level in the lane that the vehicle drove.

    Parameters
    ----------
    points_m, world_from_rig
        Points (n, 3) and the vehicle's poses (u, 4, 4), x forward, z up, in one frame.
    lowest_camera_m
        Height of the lowest camera over the rig's origin.

    Returns
    -------
    Marks (n,), or None where no level stands out: the cameras do not see the road.
    """
    if not len(points_m):
        return None
    lateral, away, height = _beside_trajectory(points_m, world_from_rig)
    lane = (np.abs(lateral) < CORRIDOR_M) & (height < lowest_camera_m - BELOW_CAMERAS_M)
    if lane.sum() < MIN_POINTS:
        return None
    free = lane & (np.abs(lateral) < FREE_M)
    tells = free.sum() >= max(FREE_POINTS, FREE_SHARE * lane.sum())
    for told in (free, lane) if tells else (lane,):
        level = most_frequent(height[told])
        on_level = lane & (np.abs(height - level) < ON_LEVEL_M + LEVEL_PER_M * away)
        if on_level.sum() >= max(MIN_POINTS, MIN_SHARE * lane.sum()):
            near: Bools = lane & (np.abs(height - level) < LEVEL_M + LEVEL_PER_M * away)
            return near
    return None


def ground_level_m(points_m: Floats, world_from_rig: Floats, lowest_camera_m: float) -> float | None:
    """Height of the ground in the rig, from points (n, 3) below the trajectory; None where no level stands out."""
    below = points_below_trajectory(points_m, world_from_rig, lowest_camera_m)
    if below is None:
        return None
    return float(np.median(_beside_trajectory(points_m[below], world_from_rig)[2]))


def standing_is_impossible(points_m: Floats, distance_m: Floats, world_from_rig: Floats) -> Bools:
    """Return where (n,) nothing that stands can be: below the road, or above it in the lane that the vehicle drove.

    `distance_m` (n,) is signed, to the road's surface. Kerbs, bollards and parked cars beside it may be there.
    """
    lateral, _, _ = _beside_trajectory(points_m, world_from_rig)
    driven = (np.abs(lateral) < DRIVEN_M) & (distance_m < VEHICLE_HEIGHT_M)
    result: Bools = (distance_m < 0) | driven
    return result


def _beside_trajectory(points_m: Floats, world_from_rig: Floats) -> tuple[Floats, Floats, Floats]:
    """Lateral offset of points (n, 3) from the trajectory, distance from its nearest pose, height in that pose's rig.

    Points farther than AHEAD_M beyond the ends of the trajectory have an infinite offset.
    """
    axes = horizontal_axes(world_from_rig)
    trajectory, xyz = world_from_rig[:, :3, 3] @ axes.T, points_m @ axes.T
    unit = nearest(trajectory[:, :2], xyz[:, :2])[1][:, 0]
    local = np.einsum("nji,nj->ni", world_from_rig[unit, :3, :3], points_m - world_from_rig[unit, :3, 3])
    lateral = np.where(np.abs(local[:, 0]) <= AHEAD_M, local[:, 1], np.inf)
    return lateral, np.hypot(local[:, 0], local[:, 1]), local[:, 2]
