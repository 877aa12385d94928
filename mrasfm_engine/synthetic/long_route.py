"""Observations of a vehicle's cameras on a long path through a city, without images, to measure scaling.

A point is found where it is neither too near nor too far for its size, and where nothing hides it; of those an image
has the most distinct ones, less some that are missed. So neighbouring images share most keypoints, and a street that is
driven again shows the same points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.jit import njit
from mrasfm_engine.synthetic.city import city_route, in_sight, points_beside
from mrasfm_engine.synthetic.rigs import TrueCamera, true_cameras
from mrasfm_engine.types import CountProgress, Floats, Floats32, Ints

SPACING_M = 1.0
KEYPOINTS = 400  # of an image
NOISE_PX = 0.7  # standard deviation of each coordinate
MISSED = 0.2  # share of the points in view that an image does not find
NEAREST_M, LARGEST_NEAREST_M = 3.0, 25.0  # from where on small and large points are found,
FARTHEST = 3.0  # up to so many times that
MAX_DISTANCE_M, MIN_DEPTH_M = 60.0, 1.0
CELL_M = 10.0

# Cameras of the rig, and width and height of their images: KITTI's and nuScenes'.
RIGS: dict[str, tuple[int, tuple[int, int]]] = {"stereo": (2, (1240, 376)), "surround": (6, (1600, 900))}


@dataclass(frozen=True, kw_only=True)
class LongRoute:
    """The truth, and every image's keypoints; images by unit, then camera."""

    cameras: list[TrueCamera]
    world_from_rig: Floats  # (units, 4, 4)
    points_m: Floats  # (points, 3) in the world
    xy_px: list[Floats32]  # by image (n, 2); the centre of the top left pixel is at (0.5, 0.5)
    point: list[Ints]  # by image (n,): index into points_m of every keypoint

    @property
    def travelled_m(self) -> Floats:
        """Way driven up to each unit (units,)."""
        steps = np.linalg.norm(np.diff(self.world_from_rig[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def require_rig(rig: str) -> None:
    """Refuse a rig that is none of `RIGS`.

    Raises
    ------
    InputError
        That names those there are.
    """
    if rig not in RIGS:
        raise InputError(f"there is no simulated rig {rig!r}", remedy=f"Use one of {', '.join(RIGS)}.")


class _Cells:
    """An index of points by square cells of the ground plane."""

    def __init__(self, xy_m: Floats) -> None:
        self._low = np.floor(xy_m.min(0) / CELL_M).astype(np.int64)
        cell = np.floor(xy_m / CELL_M).astype(np.int64) - self._low
        self._shape = cell.max(0) + 1
        number = cell[:, 0] * self._shape[1] + cell[:, 1]
        self.order = np.argsort(number, kind="stable")
        self._first = np.searchsorted(number[self.order], np.arange(self._shape.prod() + 1))

    def around(self, xy_m: Floats, radius_m: float) -> Ints:
        """Spans (n, 2) of the ordered points with all that are within a radius of a place (2,)."""
        low = np.maximum(np.floor((xy_m - radius_m) / CELL_M).astype(np.int64) - self._low, 0)
        high = np.minimum(np.floor((xy_m + radius_m) / CELL_M).astype(np.int64) - self._low, self._shape - 1)
        rows = np.arange(low[0], high[0] + 1) * self._shape[1]
        return np.stack([self._first[rows + low[1]], self._first[rows + high[1] + 1]], axis=-1)


def simulate_long_route(rig: str, units: int, *, seed: int = 0, progress: CountProgress | None = None) -> LongRoute:
    """Drive `units` metres through a city and see about `KEYPOINTS` points in every image.

    Parameters
    ----------
    rig
        One of `RIGS`.
    units
        Instants, `SPACING_M` apart.
    seed
        The same one gives the same route, points and noise.

    Raises
    ------
    InputError
        For an unknown rig, or less than two units.
    """
    require_rig(rig)
    if units < 2 or seed < 0:
        raise InputError(
            f"cannot simulate {units} units with seed {seed}", remedy="Ask for at least 2 units, and a seed from 0 on."
        )
    count, (width, height) = RIGS[rig]
    rng = np.random.default_rng(seed)
    cameras = true_cameras(count, width=width, height=height, rng=rng)
    travelled_m = SPACING_M * np.arange(units)
    world_from_rig = city_route(float(travelled_m[-1]), rng).world_from_rig(travelled_m)
    return observe_route(cameras, world_from_rig, seed=seed, progress=progress)


def observe_route(
    cameras: list[TrueCamera],
    world_from_rig: Floats,
    *,
    seed: int = 0,
    progress: CountProgress | None = None,
) -> LongRoute:
    """See about `KEYPOINTS` points of the city in every image that pinhole cameras take from poses (units, 4, 4)."""
    rng = np.random.default_rng([seed, len(cameras)])
    points = points_beside(world_from_rig[:, :2, 3], rng)
    cells = _Cells(points[:, :2])
    points = points[cells.order]
    nearest_m = np.exp(rng.uniform(np.log(NEAREST_M), np.log(LARGEST_NEAREST_M), len(points)))
    distinct = rng.random(len(points))
    xy_px: list[Floats32] = []
    point: list[Ints] = []
    for unit, pose in enumerate(world_from_rig):
        near = cells.around(pose[:2, 3], MAX_DISTANCE_M)
        own = np.random.default_rng([seed, unit])
        for camera in cameras:
            found, xy = _observe(camera, pose, near, points, nearest_m, distinct, own)
            xy_px.append(xy)
            point.append(found)
        if progress is not None:
            progress(unit + 1, len(world_from_rig))
    return LongRoute(cameras=cameras, world_from_rig=world_from_rig, points_m=points, xy_px=xy_px, point=point)


def _observe(
    camera: TrueCamera, world_from_rig: Floats, spans: Ints, points_m: Floats, nearest_m: Floats, distinct: Floats,
    rng: np.random.Generator,
) -> tuple[Ints, Floats32]:  # fmt: skip
    """Points (n,) that an image observes, in no order, and their positions (n, 2) in pixels."""
    size_px = np.array([camera.width, camera.height], dtype=np.float64)
    seen, exact = _in_view(
        spans, points_m, nearest_m, world_from_rig @ camera.rig_from_cam, np.array(camera.params[:4]), size_px
    )
    best = np.argsort(-distinct[seen], kind="stable")[: round(KEYPOINTS / (1.0 - MISSED))]
    found = rng.permutation(best[rng.random(len(best)) >= MISSED])
    xy = exact[found] + rng.normal(0.0, NOISE_PX, (len(found), 2))
    inside = np.all((xy > 0) & (xy < size_px), axis=1)
    return seen[found[inside]], xy[inside].astype(np.float32)


@njit(cache=True, nogil=True)
def _in_view(spans: Any, points_m: Any, nearest_m: Any, world_from_cam: Any, params: Any, size_px: Any) -> Any:
    """Points (n,) of some spans that a pinhole camera can find, and their pixels (n, 2)."""
    most = (spans[:, 1] - spans[:, 0]).sum()
    index, xy = np.empty(most, np.int64), np.empty((most, 2))
    centre, rotation = world_from_cam[:3, 3], world_from_cam[:3, :3]
    count = 0
    for span in range(len(spans)):
        for i in range(spans[span, 0], spans[span, 1]):
            dx, dy, dz = points_m[i, 0] - centre[0], points_m[i, 1] - centre[1], points_m[i, 2] - centre[2]
            z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
            if z < MIN_DEPTH_M:
                continue
            away = math.sqrt(dx * dx + dy * dy + dz * dz)
            if away < nearest_m[i] or away > min(FARTHEST * nearest_m[i], MAX_DISTANCE_M):
                continue
            x = (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z * params[0] + params[2]
            y = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z * params[1] + params[3]
            inside = 0 < x < size_px[0] and 0 < y < size_px[1]
            if inside and in_sight(centre[0], centre[1], points_m[i, 0], points_m[i, 1]):
                index[count], xy[count, 0], xy[count, 1] = i, x, y
                count += 1
    return index[:count], xy[:count]
