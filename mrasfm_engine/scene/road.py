"""The road's surface as overlapping plane patches with a relief on them, and what a scene says of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np

from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.scene.road_relief import Relief
from mrasfm_engine.types import Bools, Floats, Ints

SAME_LEVEL_M = 1.0  # patches farther apart in height are of different roads, above one another
NEIGHBOURS = 12  # nearest patches that count at one place
SMALLEST_WEIGHT = 1e-9  # of a patch within its radius: no point there is without one


class RoadSource(StrEnum):
    """Source of the decision that a point is on the road."""

    MASKS = "masks"
    GEOMETRY = "geometry"  # below the vehicle's trajectory, where no mask says what is road: less sure


@dataclass(frozen=True, kw_only=True)
class RoadSurface:
    """Plane patches whose weighted mean, with the relief on it, is the surface. Metres of the scene's frame.

    A patch holds within `radius_m` of its centre, horizontally; its weight falls to zero there, so that the surface has
    no steps.
    """

    axes: Floats  # (3, 3) rows: two horizontal directions and up
    centre_m: Floats  # (n, 3)
    normal: Floats  # (n, 3) unit, upwards
    radius_m: float
    relief: Relief = field(default_factory=Relief.none)

    def __len__(self) -> int:
        return len(self.centre_m)

    def locate(self, points_m: Floats) -> tuple[Floats, Ints]:
        """Signed distances (p,) of points (p, 3) to the surface, up positive, and the nearest patches (p,).

        Where roads lie above one another, the nearer one counts. Beyond all patches the distance is NaN, the patch -1.
        """
        distance, patch = self.locate_on_patches(points_m)
        inside = patch >= 0
        height, _ = self.relief.at(self.feet(points_m[inside], distance[inside]))
        distance[inside] -= height
        return distance, patch

    def feet(self, points_m: Floats, distance_m: Floats) -> Floats:
        """Places (p, 3) in the horizontal frame below points at signed distances (p,) from the patches."""
        feet: Floats = points_m @ self.axes.T
        feet[:, 2] -= distance_m
        return feet

    def locate_on_patches(self, points_m: Floats, *, threads: int = 1) -> tuple[Floats, Ints]:
        """As `locate`, without the relief."""
        distance, patch = np.full(len(points_m), np.nan), np.full(len(points_m), -1, dtype=np.int64)
        if not len(self) or not len(points_m):
            return distance, patch
        xyz, centre, normal = points_m @ self.axes.T, self.centre_m @ self.axes.T, self.normal @ self.axes.T
        reach, near = nearest(centre[:, :2], xyz[:, :2], count=NEIGHBOURS, within_m=self.radius_m, threads=threads)
        known = (xyz, centre, normal, reach, near, self.radius_m)
        in_ranges(threads, len(xyz), partial(_blend, *known, distance, patch))
        return distance, patch

    def beyond(self, points_m: Floats) -> tuple[Floats, Floats]:
        """Distances (p,) of points (p, 3) to the nearest patch's plane, and how far (p,) beyond its radius they are.

        The first is along its normal, the second horizontal.
        """
        xyz, centre, normal = points_m @ self.axes.T, self.centre_m @ self.axes.T, self.normal @ self.axes.T
        reach, near = nearest(centre[:, :2], xyz[:, :2])
        offset: Floats = ((xyz - centre[near[:, 0]]) * normal[near[:, 0]]).sum(1)
        return offset, np.maximum(reach[:, 0] - self.radius_m, 0.0)


def patch_weight(reach_m: Floats, radius_m: float) -> Floats:
    """Weight of a patch at a horizontal distance from its centre: 1 there, 0 from its radius on."""
    scaled = np.minimum(np.where(np.isfinite(reach_m), reach_m, radius_m) / radius_m, 1.0)
    result: Floats = np.maximum((1.0 - scaled**2) ** 2, SMALLEST_WEIGHT) * (scaled < 1.0)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _blend(
    xyz: Any,
    centre: Any,
    normal: Any,
    reach: Any,
    near: Any,
    radius: float,
    distance: Any,
    patch: Any,
    lo: int,
    hi: int,
) -> None:
    """Mean distances of points lo to hi along the normals of their nearest patches (n, k), and the heaviest patch."""
    count = reach.shape[1]
    offset = np.empty(count)
    for i in range(lo, hi):
        level = np.inf
        for k in range(count):
            if reach[i, k] == np.inf:
                continue
            j = near[i, k]
            offset[k] = 0.0
            for axis in range(3):
                offset[k] += (xyz[i, axis] - centre[j, axis]) * normal[j, axis]
            if abs(offset[k]) < abs(level):
                level = offset[k]
        total, value, heaviest = 0.0, 0.0, 0.0
        for k in range(count):
            if reach[i, k] < radius and abs(offset[k] - level) < SAME_LEVEL_M:
                weight = max((1.0 - (reach[i, k] / radius) ** 2) ** 2, SMALLEST_WEIGHT)
                total += weight
                value += weight * offset[k]
                if weight > heaviest:
                    heaviest, patch[i] = weight, near[i, k]
        if total > 0.0:
            distance[i] = value / total


@dataclass(frozen=True, kw_only=True)
class Thickness:
    """Thickness of the layer of points about the surface, from the signed distances of all points."""

    range90_m: float  # between the 5th and the 95th percentile
    spread_m: float  # 1.4826 times the median absolute deviation: the standard deviation, were they normal

    @staticmethod
    def from_distances(distance_m: Floats) -> Thickness:
        """Compute from signed distances (n,) without the NaN ones; NaN for none."""
        known = distance_m[np.isfinite(distance_m)]
        if not len(known):
            return Thickness(range90_m=float("nan"), spread_m=float("nan"))
        low, middle, high = np.percentile(known, [5, 50, 95])
        return Thickness(range90_m=float(high - low), spread_m=float(1.4826 * np.median(np.abs(known - middle))))


@dataclass(frozen=True, kw_only=True)
class RoadPoints:
    """Points that were taken for the road's, before those off its surface were dropped."""

    points_m: Floats  # (n, 3)
    distance_m: Floats  # (n,) signed, to the surface; NaN where there is none
    is_inlier: Bools  # (n,)


@dataclass(frozen=True, kw_only=True)
class Road:
    """The road of a scene."""

    source: RoadSource
    surface: RoadSurface
    roughness_m: float  # standard deviation of the road about the surface
    rig_height_m: float  # of the rig's origin above the road
    before: RoadPoints

    @property
    def thickness_before(self) -> Thickness:
        """Thickness of all points taken for the road."""
        return Thickness.from_distances(self.before.distance_m)

    @property
    def thickness_after(self) -> Thickness:
        """Thickness of the inliers."""
        return Thickness.from_distances(self.before.distance_m[self.before.is_inlier])
