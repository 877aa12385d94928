"""Noisy observations of random points from a driving camera set, without images: for testing solvers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.rigs import true_cameras
from mrasfm_engine.types import Bools, Floats, Ints, Ints32

RATE_HZ = 10.0
_ROW_ROUNDS = 5
_FINE = 20  # steps of the curve from unit to unit


@dataclass(frozen=True, kw_only=True)
class SimulatedObservations:
    """A drive reduced to numbers; everything but `xy_px` is exact.

    Observations are sorted by unit, then camera, then point.
    """

    world_from_rig: Floats  # (units, 4, 4)
    rig_from_cam: Floats  # (cameras, 4, 4)
    camera_params: Floats  # (cameras, 4): PINHOLE's fx fy cx cy, px
    image_size_px: tuple[int, int]  # width, height
    timestamps_us: Ints  # (units,), at RATE_HZ
    points_m: Floats  # (points, 3), world frame
    unit: Ints32  # (observations,) index into world_from_rig
    camera: Ints32  # (observations,) index into rig_from_cam
    point: Ints32  # (observations,) index into points_m
    xy_px: Floats  # (observations, 2), the centre of the top left pixel is at (0.5, 0.5)
    exact_xy_px: Floats  # (observations, 2), without noise and outliers
    is_outlier: Bools  # (observations,), where xy_px is anywhere in the image


def simulate_trajectory(
    units: int, *, spacing_m: float = 1.1, straight: bool = False, radius_m: float | None = None
) -> Floats:
    """`world_from_rig` (units, 4, 4) of a car on a gently winding (or straight) flat street, world z up.

    Over 40 units of 1.1 m the heading of the winding street varies by 29 degrees. With a radius the rig's origin, which
    is at the rear axle, goes round a circle to the left.
    """
    travelled_m = (np.arange(units) * _FINE).astype(np.float64) * (spacing_m / _FINE)
    return poses_along(travelled_m, spacing_m=spacing_m, straight=straight, radius_m=radius_m)


def poses_along(
    travelled_m: Floats, *, spacing_m: float = 1.1, straight: bool = False, radius_m: float | None = None
) -> Floats:
    """Poses (n, 4, 4) of the car of `simulate_trajectory` after any distance (n,), also before its first unit."""

    def heading(s: Floats) -> Floats:
        if radius_m is not None:
            swing = s / radius_m
        elif straight:
            swing = np.zeros_like(s)
        else:
            swing = np.radians(24.0) * np.sin(s / 19.0) + np.radians(5.0) * np.sin(s / 4.0)
        result: Floats = np.radians(25.0) + swing
        return result

    # Fine steps forward and back from the start: the poses belong to one smooth curve.
    step_m = spacing_m / _FINE
    ahead = np.arange(max(0, math.ceil(travelled_m.max(initial=0.0) / step_m)) + 2) * step_m
    back = -np.arange(max(0, math.ceil(-travelled_m.min(initial=0.0) / step_m)) + 2) * step_m
    grids, places = [], []
    for grid in (back, ahead):
        along = np.stack([np.cos(heading(grid)), np.sin(heading(grid)), np.zeros_like(grid)], -1) * (grid[1] - grid[0])
        grids.append(grid)
        places.append(np.concatenate([np.zeros((1, 3)), np.cumsum(along, 0)[:-1]]))
    grid = np.concatenate([grids[0][:0:-1], grids[1]])
    place = np.concatenate([places[0][:0:-1], places[1]])
    position = np.stack([np.interp(travelled_m, grid, place[:, k]) for k in range(3)], -1)
    pitch_roll = np.radians(0.4) * np.stack([np.sin(travelled_m / 1.3), np.sin(travelled_m / 2.1 + 1.0)], -1)
    rotation = (
        se3.exp_so3(heading(travelled_m)[:, None] * np.array([0.0, 0.0, 1.0]))
        @ se3.exp_so3(pitch_roll[:, :1] * np.array([0.0, 1.0, 0.0]))
        @ se3.exp_so3(pitch_roll[:, 1:] * np.array([1.0, 0.0, 0.0]))
    )
    return se3.transform(rotation, position)


def _points_along(world_from_rig: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Points (count, 3) on facades, in trees and on the road beside a trajectory and up to 40 m beyond its ends."""
    spacing_m = 1.1 if len(world_from_rig) < 2 else float(np.linalg.norm(np.diff(world_from_rig[:2, :3, 3], axis=0)))
    beyond = 40.0 / max(spacing_m, 0.1)
    place = rng.uniform(-beyond, len(world_from_rig) - 1 + beyond, count)
    near = world_from_rig[np.clip(np.round(place), 0, len(world_from_rig) - 1).astype(int)]
    # Beyond the ends, and between units, go straight on along the nearest unit's heading.
    ahead_m = (place - np.clip(np.round(place), 0, len(world_from_rig) - 1)) * spacing_m
    side = rng.choice([-1.0, 1.0], count)
    kind = rng.random(count)
    lateral = np.where(kind < 0.6, side * rng.uniform(7.5, 11.0, count), side * rng.uniform(4.0, 25.0, count))
    height = np.where(kind < 0.6, rng.uniform(0.2, 11.0, count), rng.uniform(0.5, 5.0, count))
    road = kind > 0.85
    lateral = np.where(road, rng.uniform(-6.0, 6.0, count), lateral)
    height = np.where(road, 0.0, height)
    local = np.stack([ahead_m, lateral, height], -1)
    level = near.copy()
    heading = np.arctan2(near[:, 1, 0], near[:, 0, 0])
    level[:, :3, :3] = se3.exp_so3(heading[:, None] * np.array([0.0, 0.0, 1.0]))
    return se3.apply(level, local[:, None, :])[:, 0]


def simulate_observations(
    *,
    units: int = 20,
    cameras: int = 6,
    points: int = 2000,
    noise_px: float = 0.5,
    outlier_fraction: float = 0.0,
    spacing_m: float = 1.1,
    straight: bool = False,
    radius_m: float | None = None,
    max_depth_m: float = 60.0,
    image_size_px: tuple[int, int] = (960, 540),
    time_offset_s: ArrayLike = 0.0,
    readout_s: float = 0.0,
    travelled_m: Floats | None = None,
    rng: np.random.Generator,
) -> SimulatedObservations:
    """Random points around a trajectory and what the cameras see of them.

    Parameters
    ----------
    units, cameras, points
        How many; cameras as in `rigs.mounts`. Points that fewer than two images see are left out, so that fewer than
        `points` may remain.
    noise_px
        Standard deviation of each image coordinate.
    outlier_fraction
        Share of observations that are put anywhere in their image.
    spacing_m
        Distance between units.
    straight
        Whether the street is straight.
    radius_m
        Radius of the circle that the street is.
    max_depth_m
        Farther points are not seen.
    image_size_px
        Width and height of every image.
    time_offset_s
        When each camera (cameras,) takes its image, from its unit's timestamp on; for a rolling shutter its middle row.
    readout_s
        Time from the first row of an image to the last.
    travelled_m
        Way driven until every unit (units,), instead of equal steps of `spacing_m`: a car that stands or creeps.
    rng
        Source of everything random.

    Raises
    ------
    InputError
        When a number makes no sense.
    """
    if units < 1 or points < 1 or noise_px < 0 or not 0 <= outlier_fraction <= 1 or spacing_m <= 0:
        raise InputError(
            f"cannot simulate {units} units, {points} points, {noise_px} px noise, {outlier_fraction} outliers, "
            f"{spacing_m} m spacing",
            remedy="Give positive numbers and a fraction from 0 to 1.",
        )
    width, height = image_size_px
    rig = true_cameras(cameras, width=width, height=height, rng=rng)
    rig_from_cam = np.stack([camera.rig_from_cam for camera in rig])
    params = np.array([camera.params for camera in rig])
    steady_m = (np.arange(units) * _FINE).astype(np.float64) * (spacing_m / _FINE)
    along_m = steady_m if travelled_m is None else np.asarray(travelled_m, dtype=np.float64)
    world_from_rig = poses_along(along_m, spacing_m=spacing_m, straight=straight, radius_m=radius_m)
    steps = max(2, round(float(np.ptp(along_m)) / spacing_m) + 1)
    along = (
        world_from_rig
        if travelled_m is None
        else simulate_trajectory(steps, spacing_m=spacing_m, straight=straight, radius_m=radius_m)
    )
    world = _points_along(along, points, rng)

    cam_from_world = se3.inverse(world_from_rig[:, None] @ rig_from_cam[None])
    in_camera = se3.apply(cam_from_world, world)  # (units, cameras, points, 3)
    depth = in_camera[..., 2]
    safe = np.where(depth > 0.3, depth, np.inf)
    xy = in_camera[..., :2] / safe[..., None] * params[:, None, :2] + params[:, None, 2:]
    seen = (depth > 0.3) & (depth < max_depth_m) & np.all((xy > 0) & (xy < np.array([width, height])), -1)
    offset_s = np.broadcast_to(np.asarray(time_offset_s, dtype=np.float64), (cameras,))
    if offset_s.any() or readout_s > 0:
        which = np.nonzero(seen)
        time_s = which[0] / RATE_HZ + offset_s[which[1]]
        for _ in range(_ROW_ROUNDS):
            # The row tells the time, and the time the row.
            at_s = time_s + (xy[which][:, 1] / height - 0.5) * readout_s
            then_m = at_s * RATE_HZ * spacing_m
            if travelled_m is not None:
                then_m = np.interp(at_s * RATE_HZ, np.arange(units), along_m)
            then = poses_along(then_m, spacing_m=spacing_m, straight=straight, radius_m=radius_m)
            local = se3.apply(se3.inverse(then @ rig_from_cam[which[1]]), world[which[2], None])[:, 0]
            xy[which] = local[:, :2] / local[:, 2:].clip(0.3) * params[which[1], :2] + params[which[1], 2:]
        seen[which] = (local[:, 2] > 0.3) & np.all((xy[which] > 0) & (xy[which] < np.array([width, height])), -1)
    kept = np.flatnonzero(seen.sum((0, 1)) >= 2)
    unit, camera, point = np.nonzero(seen[:, :, kept])
    exact = xy[:, :, kept][unit, camera, point]
    noisy = exact + rng.normal(0.0, noise_px, exact.shape) if noise_px > 0 else exact.copy()
    is_outlier = rng.random(len(exact)) < outlier_fraction
    noisy[is_outlier] = rng.uniform(0.0, 1.0, (int(is_outlier.sum()), 2)) * np.array([width, height])
    return SimulatedObservations(
        world_from_rig=world_from_rig,
        rig_from_cam=rig_from_cam,
        camera_params=params,
        image_size_px=image_size_px,
        timestamps_us=1_750_000_000_000_000 + np.arange(units, dtype=np.int64) * 100_000,
        points_m=world[kept],
        unit=unit.astype(np.int32),
        camera=camera.astype(np.int32),
        point=point.astype(np.int32),
        xy_px=noisy,
        exact_xy_px=exact,
        is_outlier=is_outlier,
    )
