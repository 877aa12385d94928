"""Plane patches that grow over the points of a road: below the vehicle's trajectory first, then outwards.

Each patch is found by LO-RANSAC among the points around its centre, near ones counting more, with a slope near that of
its neighbours and of the vehicle. What a patch needs is looked up around it, so that time grows with the road's length
and not with its square.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry.height_plane import HeightPlane, fit_height_plane, refit_height_planes
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.scene.road import patch_weight
from mrasfm_engine.types import Bools, Floats, Ints

SPACING = 0.75  # of patches' centres, in radii: neighbours overlap
MIN_POINTS = 8  # of a patch, that agree with its plane
LEVEL_M = 2.5  # points farther from where the road is expected are not of this patch's road
STEP_M = 0.3  # of a patch's height against what its neighbours' planes say, at most
SIGMA_SLOPE_RIG = 0.05  # of the road's slope against the vehicle's
MAX_SLOPE_RIG = 0.2
SIGMA_SLOPE_NEIGHBOURS = 0.02  # of a patch's slope against its neighbours'
MAX_SLOPE_NEIGHBOURS = 0.1
MIN_SUPPORT = 0.15  # of a patch, of the weight of its points


@dataclass(frozen=True, kw_only=True)
class RoadSample:
    """Points in the horizontal frame."""

    xy: Floats
    height: Floats
    sigma: Floats  # of the height, from triangulation
    weight: Floats  # points that each stands for
    tree: cKDTree

    @staticmethod
    def from_points(xyz: Floats, sigma_m: Floats, weight: Floats) -> RoadSample:
        """The points (n, 3) with the standard deviations (n,) of their heights, and how much each counts (n,)."""
        return RoadSample(xy=xyz[:, :2], height=xyz[:, 2], sigma=sigma_m, weight=weight, tree=cKDTree(xyz[:, :2]))

    def around(self, at: Floats, radius_m: float) -> int:
        """Count the points within a radius of a place (2,)."""
        return int(self.tree.query_ball_point(at, radius_m, return_length=True))


@dataclass(kw_only=True)
class Patches:
    """Patches found so far, in the horizontal frame."""

    radius_m: float
    centre: list[Floats] = field(default_factory=list)  # (2,)
    offset: list[float] = field(default_factory=list)
    slope: list[Floats] = field(default_factory=list)  # (2,)
    points: list[int] = field(default_factory=list)  # within the radius when its plane was searched for
    _cells: dict[tuple[int, int], list[int]] = field(default_factory=lambda: defaultdict(list))

    def append(self, centre: Floats, offset_m: float, slope: Floats, points: int) -> None:
        """Add one at a centre (2,)."""
        self._cells[self._cell(centre)].append(len(self.centre))
        self.centre.append(centre)
        self.offset.append(offset_m)
        self.slope.append(slope)
        self.points.append(points)

    def around(self, at: Floats) -> Ints:
        """Patches within two radii of a place (2,), and some farther ones."""
        row, column = self._cell(at)
        cells = [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return np.array([n for cell in cells for n in self._cells.get(cell, ())], dtype=np.int64)

    def expected(self, at: Floats, *, without: int = -1) -> tuple[float, Floats] | None:
        """Height and slope (2,) at a place (2,) by the patches within two radii of it, if there are any."""
        some = self.around(at)
        some = some[some != without]
        if not len(some):
            return None
        away = at - np.stack([self.centre[n] for n in some])
        weight = patch_weight(np.hypot(*away.T), 2 * self.radius_m)
        if not weight.any():
            return None
        slope = np.stack([self.slope[n] for n in some])
        height = np.array([self.offset[n] for n in some]) + (away * slope).sum(1)
        # Of roads above one another the one that is nearest counts.
        level = height[weight.argmax()]
        weight = np.where(np.abs(height - level) < 0.5 * LEVEL_M, weight, 0.0)
        weight /= weight.sum()
        return float(weight @ height), weight @ slope

    def covers(self, at: Floats) -> bool:
        """Return whether a place (3,) needs no patch of its own."""
        some = self.around(at[:2])
        if not len(some):
            return False
        away = np.hypot(*(np.stack([self.centre[n] for n in some]) - at[:2]).T)
        height = np.array([self.offset[n] for n in some])
        return bool(((away < SPACING * self.radius_m) & (np.abs(height - at[2]) < LEVEL_M)).any())

    def _cell(self, at: Floats) -> tuple[int, int]:
        side = 2 * self.radius_m
        return int(np.floor(at[0] / side)), int(np.floor(at[1] / side))


def add_patches(
    points: RoadSample,
    below: Floats,
    rig_slopes: Floats,
    patches: Patches,
    *,
    roughness_m: float,
    rng: np.random.Generator,
) -> None:
    """Add patches below the vehicle's trajectory, best supported first, then outwards over the rest of the points.

    Parameters
    ----------
    below, rig_slopes
        Where the road is expected below each of the vehicle's poses (u, 3), and its slopes there (u, 2).
    patches
        Those that are known; places that they cover get no other.
    """
    candidates = []
    for n in _cover(below, SPACING * patches.radius_m):
        if patches.covers(below[n]):
            continue
        plane = _fit(
            points,
            below[n],
            rig_slopes[n],
            SIGMA_SLOPE_RIG,
            MAX_SLOPE_RIG,
            patches.radius_m,
            roughness_m=roughness_m,
            rng=rng,
        )
        if plane is not None:
            candidates.append((plane.support * plane.inliers.sum(), n, plane))
    for _, n, plane in sorted(candidates, key=lambda c: -c[0]):
        known = patches.expected(below[n, :2])
        final: HeightPlane | None = plane
        if known is not None and abs(known[0] - below[n, 2]) < LEVEL_M:
            at = np.append(below[n, :2], known[0])
            final = _beside(points, at, known[1], patches.radius_m, roughness_m=roughness_m, rng=rng)
        if final is not None:
            patches.append(below[n, :2], final.offset_m, final.slope, points.around(below[n, :2], patches.radius_m))
    if patches.centre:
        _spread(points, patches, roughness_m=roughness_m, rng=rng)


def refit(points: RoadSample, patches: Patches, *, roughness_m: float) -> Patches:
    """The patches, each optimised again over its points from where it is; without those that too few agree with."""
    centre = np.stack(patches.centre)
    first, rows = points_around(points.tree, centre, patches.radius_m)
    owner = np.repeat(np.arange(len(centre)), np.diff(first))
    local = points.xy[rows] - centre[owner]
    planes = np.column_stack([patches.offset, np.stack(patches.slope)])
    slopes = planes[:, 1:].copy()
    for n in range(len(planes)):
        known = patches.expected(centre[n], without=n)
        if known is not None:
            slopes[n] = known[1]
    off = points.height[rows] - planes[owner, 0] - (local * planes[owner, 1:]).sum(1)
    weight = points.weight[rows] * patch_weight(np.hypot(*local.T), patches.radius_m) * (np.abs(off) < LEVEL_M)
    sigma = np.hypot(points.sigma[rows], roughness_m)
    fitted, support, count = refit_height_planes(
        planes, first, local, points.height[rows], sigma, weight, slopes, SIGMA_SLOPE_NEIGHBOURS
    )
    held = (support >= MIN_SUPPORT) & (count >= MIN_POINTS) & (np.abs(fitted[:, 0] - planes[:, 0]) < STEP_M)
    result = Patches(radius_m=patches.radius_m)
    for n in np.flatnonzero(held).tolist():
        result.append(centre[n], float(fitted[n, 0]), fitted[n, 1:], patches.points[n])
    return result


def points_around(tree: cKDTree, centre_m: Floats, radius_m: float) -> tuple[Ints, Ints]:
    """Points within the radius of every centre (k, 2): bounds (k + 1,) of each one's rows, and the rows."""
    found = list(tree.query_ball_point(centre_m, radius_m, return_sorted=True))
    rows = [np.asarray(some, dtype=np.int64) for some in found]
    first = np.concatenate([[0], np.cumsum([len(some) for some in rows])]).astype(np.int64)
    return first, np.concatenate([np.zeros(0, dtype=np.int64), *rows])


def thinned(xyz: Floats, sigma_m: Floats, *, cell_m: float, most: int) -> tuple[Ints, Floats]:
    """The most precise points (n, 3), at most so many in every cube: ascending rows, and how many each stands for.

    Cubes and not squares: roads may lie above one another.
    """
    cell = np.floor(xyz / cell_m).astype(np.int64)
    order = np.lexsort((sigma_m, cell[:, 2], cell[:, 1], cell[:, 0]))
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = (np.diff(cell[order], axis=0) != 0).any(axis=1)
    begin = np.flatnonzero(new)
    count = np.diff(np.append(begin, len(order)))
    rank = np.arange(len(order)) - np.repeat(begin, count)
    share = np.repeat(count / np.minimum(count, most), count)
    kept = order[rank < most]
    ascending = np.argsort(kept)
    return kept[ascending], share[rank < most][ascending]


def _cover(xyz: Floats, spacing_m: float) -> Sequence[int]:
    """Choose places (n, 3), in their order, at least the spacing from all chosen before, or on another level."""
    chosen: list[int] = []
    cells: dict[tuple[int, int], list[int]] = defaultdict(list)
    for n, (row, column) in enumerate(np.floor(xyz[:, :2] / spacing_m).astype(np.int64).tolist()):
        near = [m for i in (-1, 0, 1) for j in (-1, 0, 1) for m in cells.get((row + i, column + j), ())]
        away = xyz[near] - xyz[n]
        if not ((np.hypot(away[:, 0], away[:, 1]) < spacing_m) & (np.abs(away[:, 2]) < LEVEL_M)).any():
            chosen.append(n)
            cells[row, column].append(n)
    return chosen


def _spread(points: RoadSample, patches: Patches, *, roughness_m: float, rng: np.random.Generator) -> None:
    """Add patches over points that none reaches yet, each next to a known one: ahead of it, in side streets."""
    radius_m = patches.radius_m
    reach = nearest(np.stack(patches.centre), points.xy)[0][:, 0]
    tried: Bools = np.zeros(len(reach), dtype=np.bool_)
    open_points = np.flatnonzero((reach >= SPACING * radius_m) & (reach < 1.5 * radius_m))
    queue = [(float(reach[n]), int(n)) for n in open_points]
    heapq.heapify(queue)
    while queue:
        known_reach, n = heapq.heappop(queue)
        if tried[n] or known_reach != reach[n]:
            continue
        at = points.xy[n]
        known = patches.expected(at)
        assert known is not None  # a patch is within one and a half radii
        plane = _beside(points, np.append(at, known[0]), known[1], radius_m, roughness_m=roughness_m, rng=rng)
        if plane is None:
            tried[points.tree.query_ball_point(at, 0.25 * radius_m)] = True
            continue
        patches.append(at, plane.offset_m, plane.slope, points.around(at, radius_m))
        near = np.array(points.tree.query_ball_point(at, 1.5 * radius_m), dtype=np.int64)
        away = np.hypot(*(points.xy[near] - at).T)
        nearer = away < reach[near]
        reach[near[nearer]] = away[nearer]
        for m in near[nearer & (away >= SPACING * radius_m)].tolist():
            heapq.heappush(queue, (float(reach[m]), m))


def _beside(
    points: RoadSample, at: Floats, slope: Floats, radius_m: float, *, roughness_m: float, rng: np.random.Generator
) -> HeightPlane | None:
    """A patch at a place (3,) whose height and slope are expected from its neighbours: no road has steps."""
    plane = _fit(
        points,
        at,
        slope,
        SIGMA_SLOPE_NEIGHBOURS,
        MAX_SLOPE_NEIGHBOURS,
        radius_m,
        roughness_m=roughness_m,
        rng=rng,
        level_m=STEP_M + MAX_SLOPE_NEIGHBOURS * radius_m,
    )
    return plane if plane is not None and abs(plane.offset_m - at[2]) < STEP_M else None


def _fit(
    points: RoadSample,
    at: Floats,
    slope: Floats,
    sigma_slope: float,
    max_slope_change: float,
    radius_m: float,
    *,
    roughness_m: float,
    rng: np.random.Generator,
    level_m: float = LEVEL_M,
) -> HeightPlane | None:
    """The plane at a place (3,) where the road is expected; None where less than MIN_SUPPORT of the points agree.

    Points farther than `level_m` from the expected level are left out.
    """
    rows = np.array(points.tree.query_ball_point(at[:2], radius_m), dtype=np.int64)
    if len(rows) < MIN_POINTS:
        return None
    local = points.xy[rows] - at[:2]
    level = np.abs(points.height[rows] - at[2] - local @ slope) < level_m
    rows, local = rows[level], local[level]
    plane = fit_height_plane(
        local,
        points.height[rows],
        np.hypot(points.sigma[rows], roughness_m),
        points.weight[rows] * patch_weight(np.hypot(*local.T), radius_m),
        expected_slope=slope,
        sigma_slope=sigma_slope,
        max_slope_change=max_slope_change,
        min_points=MIN_POINTS,
        rng=rng,
    )
    return plane if plane is not None and plane.support >= MIN_SUPPORT else None
