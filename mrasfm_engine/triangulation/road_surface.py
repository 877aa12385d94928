"""Surface of the road from points on it: local plane patches along the trajectory, each found by LO-RANSAC.

A single plane does not fit a hill, patches of about 12 m do. Each patch is fitted to the points around its centre, with
more weight on near ones, and with a normal near that of its neighbours and near the vehicle's up. The weighted mean of
the patches is the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry.height_plane import GATE_SIGMAS, HeightPlane, fit_height_plane
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.scene.road import RoadSurface, patch_weight
from mrasfm_engine.types import Floats

SPACING = 0.75  # of patches' centres, in radii: neighbours overlap
MIN_POINTS = 8  # of a patch, that agree with its plane
LEVEL_M = 2.5  # points farther from where the road is expected are not of this patch's road
ROUGHNESS_M = (0.008, 0.03)  # how uneven roads are, with what planes leave of their curvature: bounds
FIRST_ROUGHNESS_M = 0.02
STEP_M = 0.3  # of a patch's height against what its neighbours' planes say, at most
ROUGHNESS_STEPS = 3
SURE_SHARE = 0.33  # of the points, those of the smallest uncertainty, which determine the roughness
SIGMA_SLOPE_RIG = 0.05  # of the road's slope against the vehicle's
MAX_SLOPE_RIG = 0.2
SIGMA_SLOPE_NEIGHBOURS = 0.02  # of a patch's slope against its neighbours'
MAX_SLOPE_NEIGHBOURS = 0.1
MIN_SUPPORT = 0.15  # of a patch, of the weight of its points
HEIGHT_BIN_M = 0.1


@dataclass(frozen=True, kw_only=True)
class FittedRoad:
    """The surface, and what was learnt about it on the way."""

    surface: RoadSurface
    roughness_m: float  # standard deviation of the road about its patches
    rig_height_m: float  # of the rig's origin above the road


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Points in the horizontal frame."""

    xy: Floats
    height: Floats
    sigma: Floats  # of the height, from triangulation
    tree: cKDTree


def horizontal_axes(world_from_rig: Floats) -> Floats:
    """Rows (3, 3): two horizontal axes and up, from the mean up direction of vehicle poses (n, 4, 4)."""
    up = world_from_rig[:, :3, 2].mean(0)
    up /= np.linalg.norm(up)
    first = np.eye(3)[np.abs(up).argmin()]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def rig_height_above(points_m: Floats, world_from_rig: Floats, *, reach_m: float) -> float | None:
    """Height of the rig's origin above the road: the most frequent one over points (n, 3) near the trajectory.

    None where fewer than MIN_POINTS points are near it.
    """
    if not len(points_m):
        return None
    axes = horizontal_axes(world_from_rig)
    trajectory = world_from_rig[:, :3, 3] @ axes.T
    xyz = points_m @ axes.T
    reach, unit = nearest(trajectory[:, :2], xyz[:, :2], within_m=reach_m)
    near = np.isfinite(reach[:, 0])
    if near.sum() < MIN_POINTS:
        return None
    rig = world_from_rig[unit[near, 0]]
    height = -((points_m[near] - rig[:, :3, 3]) * rig[:, :3, 2]).sum(1)
    return most_frequent(height)


def most_frequent(values: Floats) -> float:
    """The densest value: the median of those within a bin of the fullest place of a smoothed histogram."""
    bins = np.floor((values - values.min()) / HEIGHT_BIN_M).astype(np.int64)
    # Outliers of kilometres must not make a histogram of gigabytes: only bins that have something count.
    filled, counts = np.unique(bins, return_counts=True)
    smooth = counts.astype(np.float64)
    for shift in (-1, 1):
        at = np.searchsorted(filled, filled + shift).clip(0, len(filled) - 1)
        smooth += np.where(filled[at] == filled + shift, counts[at], 0)
    fullest = filled[smooth.argmax()]
    return float(np.median(values[np.abs(bins - fullest) <= 1]))


def fit_road(
    points_m: Floats,
    sigma_m: Floats,
    world_from_rig: Floats,
    *,
    radius_m: float,
    rng: np.random.Generator,
    rounds: int = 2,
) -> FittedRoad | None:
    """The surface through points of the road, robustly: half of them and more may be wrong.

    Parameters
    ----------
    points_m, sigma_m
        Points (n, 3) and the standard deviations (n,) of their heights.
    world_from_rig
        The vehicle's poses (u, 4, 4), z up.
    radius_m
        Of a patch.
    rounds
        Of fitting: after the first the roughness is known, and with it which points can be the road's.

    Returns
    -------
    The surface, or None where there are too few points near the vehicle's trajectory, or no plane agrees with them.
    """
    if len(points_m) < MIN_POINTS or not len(world_from_rig):
        return None
    rig_height = rig_height_above(points_m, world_from_rig, reach_m=2 * radius_m)
    if rig_height is None:
        return None
    axes = horizontal_axes(world_from_rig)
    xyz = points_m @ axes.T
    points = _Points(xy=xyz[:, :2], height=xyz[:, 2], sigma=sigma_m, tree=cKDTree(xyz[:, :2]))
    below = (world_from_rig[:, :3, 3] - rig_height * world_from_rig[:, :3, 2]) @ axes.T
    slopes = _slopes(world_from_rig[:, :3, 2] @ axes.T)
    roughness, fitted = FIRST_ROUGHNESS_M, None
    for _ in range(rounds):
        fitted = _grow(points, below, slopes, axes, radius_m=radius_m, roughness_m=roughness, rng=rng)
        if fitted is None:
            return None
        fitted = _moved_by_residuals(points, points_m, fitted, roughness_m=roughness)
        roughness = _roughness(points_m, sigma_m, fitted, roughness)
    assert fitted is not None
    return FittedRoad(surface=fitted, roughness_m=roughness, rig_height_m=rig_height)


def _slopes(normal: Floats) -> Floats:
    """Slopes (n, 2) of planes with upward normals (n, 3)."""
    result: Floats = -normal[:, :2] / np.maximum(normal[:, 2:], 0.1)
    return result


def _roughness(points_m: Floats, sigma_m: Floats, surface: RoadSurface, roughness_m: float) -> float:
    """Standard deviation of the road about the surface, from points whose own uncertainty is small.

    `roughness_m` is what it was taken for so far. Wrong points lie near the surface too: only those within the gate of
    the fit have a say, and the gate narrows with what they say.
    """
    distance, _ = surface.locate(points_m)
    for _ in range(ROUGHNESS_STEPS):
        near = np.flatnonzero(np.abs(distance) < GATE_SIGMAS * np.hypot(sigma_m, roughness_m))
        if len(near) < MIN_POINTS:
            return roughness_m
        sure = near[sigma_m[near] <= np.quantile(sigma_m[near], SURE_SHARE)]
        variance = robust_sigma(distance[sure]) ** 2 - float(np.median(sigma_m[sure])) ** 2
        roughness_m = float(np.sqrt(np.clip(variance, ROUGHNESS_M[0] ** 2, ROUGHNESS_M[1] ** 2)))
    return roughness_m


def robust_sigma(values: Floats) -> float:
    """Standard deviation from the median absolute deviation about the median; zero for no values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


@dataclass(kw_only=True)
class _Patches:
    """Patches found so far."""

    centre: list[Floats]  # (2,)
    offset: list[float]
    slope: list[Floats]  # (2,)

    def expected(self, at: Floats, reach_m: float) -> tuple[float, Floats] | None:
        """Height and slope (2,) at a place by the patches around it, if there are any."""
        if not self.centre:
            return None
        away = at - np.stack(self.centre)
        weight = patch_weight(np.linalg.norm(away, axis=1), reach_m)
        if not weight.any():
            return None
        slope = np.stack(self.slope)
        height = np.array(self.offset) + (away * slope).sum(1)
        # Of roads above one another the one that is nearest counts.
        level = height[weight.argmax()]
        weight = np.where(np.abs(height - level) < 0.5 * LEVEL_M, weight, 0.0) / weight.sum()
        weight /= weight.sum()
        return float(weight @ height), weight @ slope


def _grow(
    points: _Points,
    below: Floats,
    rig_slopes: Floats,
    axes: Floats,
    *,
    radius_m: float,
    roughness_m: float,
    rng: np.random.Generator,
) -> RoadSurface | None:
    """Patches below the vehicle's trajectory first, best supported first, then outwards over the rest of the points."""
    centres = _cover(below, SPACING * radius_m)
    candidates = []
    for n in centres:
        plane = _fit(
            points, below[n], rig_slopes[n], SIGMA_SLOPE_RIG, MAX_SLOPE_RIG, radius_m, roughness_m=roughness_m, rng=rng
        )
        if plane is not None:
            candidates.append((plane.support * plane.inliers.sum(), n, plane))
    patches = _Patches(centre=[], offset=[], slope=[])
    for _, n, plane in sorted(candidates, key=lambda c: -c[0]):
        known = patches.expected(below[n, :2], 2 * radius_m)
        final: HeightPlane | None = plane
        if known is not None and abs(known[0] - below[n, 2]) < LEVEL_M:
            at = np.append(below[n, :2], known[0])
            final = _beside(points, at, known[1], radius_m, roughness_m=roughness_m, rng=rng)
        if final is not None:
            _append(patches, below[n, :2], final)
    if not patches.centre:
        return None
    _spread(points, patches, radius_m, roughness_m=roughness_m, rng=rng)
    slope = np.stack(patches.slope)
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = np.column_stack([np.stack(patches.centre), patches.offset])
    return RoadSurface(axes=axes, centre_m=centre @ axes, normal=normal @ axes, radius_m=radius_m)


def _moved_by_residuals(points: _Points, points_m: Floats, surface: RoadSurface, *, roughness_m: float) -> RoadSurface:
    """The surface with every patch moved by the mean residual of its points, along its normal.

    Planes cut through crests and span dips. What they leave of a road's curvature is the same all over a patch, so that
    its points tell it (twicing; Tukey, Exploratory Data Analysis, 1977).
    """
    distance, _ = surface.locate(points_m)
    gate = GATE_SIGMAS * np.hypot(points.sigma, roughness_m)
    near = np.abs(distance) < gate
    information = 1.0 / (points.sigma**2 + roughness_m**2)
    moved = surface.centre_m.copy()
    for n, centre in enumerate(surface.centre_m @ surface.axes.T):
        rows = np.array(points.tree.query_ball_point(centre[:2], surface.radius_m), dtype=np.int64)
        rows = rows[near[rows]]
        if len(rows) < MIN_POINTS:
            continue
        weight = patch_weight(np.hypot(*(points.xy[rows] - centre[:2]).T), surface.radius_m) * information[rows]
        # Tukey's weights, as in the fit: points near the gate are as likely wrong as right.
        weight *= (1.0 - (distance[rows] / gate[rows]) ** 2) ** 2
        moved[n] += surface.normal[n] * float(weight @ distance[rows] / weight.sum())
    return replace(surface, centre_m=moved)


def _append(patches: _Patches, xy: Floats, plane: HeightPlane) -> None:
    patches.centre.append(xy)
    patches.offset.append(plane.offset_m)
    patches.slope.append(plane.slope)


def _cover(xyz: Floats, spacing_m: float) -> Sequence[int]:
    """Choose places (n, 3), in their order, at least the spacing from all chosen before, or on another level."""
    chosen: list[int] = []
    for n in range(len(xyz)):
        away = xyz[chosen] - xyz[n]
        if not ((np.hypot(away[:, 0], away[:, 1]) < spacing_m) & (np.abs(away[:, 2]) < LEVEL_M)).any():
            chosen.append(n)
    return chosen


def _spread(
    points: _Points, patches: _Patches, radius_m: float, *, roughness_m: float, rng: np.random.Generator
) -> None:
    """Add patches over points that none reaches yet, each next to a known one: ahead of it, in side streets."""
    reach = nearest(np.stack(patches.centre), points.xy)[0][:, 0]
    tried = np.zeros(len(reach), dtype=np.bool_)
    while True:
        open_points = np.flatnonzero(~tried & (reach >= SPACING * radius_m) & (reach < 1.5 * radius_m))
        if not len(open_points):
            return
        n = open_points[reach[open_points].argmin()]
        at = points.xy[n]
        known = patches.expected(at, 2 * radius_m)
        assert known is not None  # a patch is within one and a half radii
        plane = _beside(points, np.append(at, known[0]), known[1], radius_m, roughness_m=roughness_m, rng=rng)
        if plane is None:
            tried[np.hypot(*(points.xy - at).T) < 0.25 * radius_m] = True
            continue
        _append(patches, at, plane)
        reach = np.minimum(reach, np.hypot(*(points.xy - at).T))


def _beside(
    points: _Points, at: Floats, slope: Floats, radius_m: float, *, roughness_m: float, rng: np.random.Generator
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
    points: _Points,
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
        patch_weight(np.hypot(*local.T), radius_m),
        expected_slope=slope,
        sigma_slope=sigma_slope,
        max_slope_change=max_slope_change,
        min_points=MIN_POINTS,
        rng=rng,
    )
    return plane if plane is not None and plane.support >= MIN_SUPPORT else None
