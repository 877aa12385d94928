"""Surface of the road from points on it: plane patches along the trajectory, and the relief on them.

A single plane does not fit a hill, patches of about 12 m do. Their weighted mean does not follow a speed bump, a crown
or a parking bay; the relief, fitted to the points that are supported by those around them, does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.height_plane import GATE_SIGMAS
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.scene.road import RoadSurface, patch_weight
from mrasfm_engine.triangulation.road_patches import (
    MIN_POINTS,
    Patches,
    RoadSample,
    add_patches,
    points_around,
    refit,
    thinned,
)
from mrasfm_engine.triangulation.road_relief import SIGMA_HEIGHT_M, fit_relief
from mrasfm_engine.triangulation.road_support import find_supported
from mrasfm_engine.types import Bools, Floats, Ints

ROUGHNESS_M = (0.008, 0.03)  # how uneven roads are, with what planes leave of their curvature: bounds
FIRST_ROUGHNESS_M = 0.02
ROUGHNESS_STEPS = 3
RELIEF_ROUNDS = 2  # the second with the roughness that the first has left
SURE_SHARE = 0.33  # of the points, those of the smallest uncertainty, which determine the roughness
HEIGHT_BIN_M = 0.1
MAX_SLOPE_CHANGE = 0.05  # of the road beyond its last patch
# Patches are fitted to the most precise points of every square: hundreds of points tell a plane as well as thousands.
THINNED_CELLS = 8  # a radius
THINNED_POINTS = 2  # a square
GROWN = 1.5  # times the points that a patch was found among: it is looked for anew


@dataclass(frozen=True, kw_only=True)
class KnownPatches:
    """Patches of an earlier fit, each fixed to the unit nearest to it: poses may have moved since."""

    unit: Ints  # (k,)
    centre_in_rig_m: Floats  # (k, 3)
    normal_in_rig: Floats  # (k, 3)
    points: Ints  # (k,) among which each was found


@dataclass(frozen=True, kw_only=True)
class FittedRoad:
    """The surface, and what was learnt about it on the way."""

    surface: RoadSurface
    roughness_m: float  # standard deviation of the road about the surface
    rig_height_m: float  # of the rig's origin above the road
    offset_m: Floats  # (n,) signed distances of the points from the surface; beyond its patches, from the nearest one
    beyond_m: Floats  # (n,) how far beyond the patches they are
    sigma_m: Floats  # (n,) of the surface at the points
    supported: Bools  # (n,) points that agree with the road around them
    patch: Ints  # (n,) -1 where there is none
    known: KnownPatches

    def limits_m(self, sigma_m: Floats, *, sigmas: float, max_offset_m: float) -> Floats:
        """Distances (n,) from the surface that points of these standard deviations may have, by themselves."""
        limit: Floats = sigmas * np.sqrt(sigma_m**2 + self.roughness_m**2 + self.sigma_m**2)
        return np.minimum(limit, largest_offset_m(max_offset_m, self.roughness_m))

    def off(self, limit_m: Floats) -> Bools:
        """Points (n,) beyond their limits that those around them do not support either."""
        away: Bools = np.abs(self.offset_m) > limit_m + MAX_SLOPE_CHANGE * self.beyond_m
        return away & ~self.supported


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
    max_offset_m: float = np.inf,
    rounds: int = 2,
    units: Ints | None = None,
    known: KnownPatches | None = None,
    threads: int = 1,
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
    max_offset_m
        From the road, beyond which a point is not supported however uncertain it is; see `largest_offset_m`.
    rounds
        Of fitting: after the first the roughness is known, and with it which points can be the road's.
    units, known
        Numbers (u,) of the poses' units, and patches of an earlier fit: they are fitted again from where they are, and
        planes are searched for only where the road is new.

    Returns
    -------
    The surface, or None where there are too few points near the vehicle's trajectory, or no plane agrees with them.
    """
    if len(points_m) < MIN_POINTS or not len(world_from_rig):
        return None
    axes = horizontal_axes(world_from_rig)
    units = np.arange(len(world_from_rig)) if units is None else units
    some, share = thinned(points_m @ axes.T, sigma_m, cell_m=radius_m / THINNED_CELLS, most=THINNED_POINTS)
    points, sigma = points_m[some], sigma_m[some]
    rig_height = rig_height_above(points, world_from_rig, reach_m=2 * radius_m)
    if rig_height is None:
        return None
    sample = RoadSample.from_points(points @ axes.T, sigma, share)
    below = (world_from_rig[:, :3, 3] - rig_height * world_from_rig[:, :3, 2]) @ axes.T
    slopes = _slopes(world_from_rig[:, :3, 2] @ axes.T)
    patches = Patches(radius_m=radius_m)
    if known is not None:
        patches = _placed(known, sample, world_from_rig, units, axes, radius_m)
    roughness, surface = FIRST_ROUGHNESS_M, None
    for _ in range(rounds):
        if patches.centre:
            patches = refit(sample, patches, roughness_m=roughness)
        add_patches(sample, below, slopes, patches, roughness_m=roughness, rng=rng)
        if not patches.centre:
            return None
        surface = _moved_by_residuals(sample, points, _surface(patches, axes), roughness_m=roughness)
        roughness = _roughness(surface.locate_on_patches(points)[0], sigma, roughness)
    assert surface is not None
    return _with_relief(
        surface,
        points_m,
        sigma_m,
        sample=some,
        roughness_m=roughness,
        rig_height_m=rig_height,
        max_offset_m=max_offset_m,
        known=_known(patches, surface, world_from_rig, units),
        threads=threads,
    )


def largest_offset_m(wanted_m: float, roughness_m: float) -> float:
    """Farthest that a point may be from the surface so that it is no farther than wanted from the road.

    The road is off its surface by its roughness; where that is much, three times as much is the least.
    """
    return max(wanted_m - roughness_m, GATE_SIGMAS * roughness_m)


def _with_relief(
    surface: RoadSurface,
    points_m: Floats,
    sigma_m: Floats,
    *,
    sample: Ints,
    roughness_m: float,
    rig_height_m: float,
    max_offset_m: float,
    known: KnownPatches,
    threads: int,
) -> FittedRoad:
    """The patches with the relief that the points say they have, and the points' distances to it.

    The roughness is told by the sample of the points.
    """
    offset, patch = surface.locate_on_patches(points_m, threads=threads)
    # Where no patch reaches, the nearest one is an estimate, the weaker the farther away.
    alone, beyond = patch < 0, np.zeros(len(points_m))
    offset[alone], beyond[alone] = surface.beyond(points_m[alone])
    feet = surface.feet(points_m, offset)
    sigma = np.hypot(sigma_m, MAX_SLOPE_CHANGE * beyond / GATE_SIGMAS)
    relief, supported = surface.relief, np.zeros(len(points_m), dtype=np.bool_)
    # Until the relief is known, what the patches miss of the road's shape counts as its roughness.
    sample = sample[~alone[sample]]
    for _ in range(RELIEF_ROUNDS):
        most = largest_offset_m(max_offset_m, roughness_m) + MAX_SLOPE_CHANGE * beyond
        supported = find_supported(feet, offset, sigma, most, roughness_m=roughness_m, threads=threads)
        carries = supported & ~alone
        relief = fit_relief(feet[carries], offset[carries], sigma[carries], roughness_m=roughness_m, threads=threads)
        height, _ = relief.at(feet[sample], threads=threads)
        roughness_m = _roughness(offset[sample] - height, sigma_m[sample], roughness_m)
    height, uncertain = relief.at(feet, threads=threads)
    return FittedRoad(
        surface=replace(surface, relief=relief),
        roughness_m=roughness_m,
        rig_height_m=rig_height_m,
        offset_m=offset - np.where(alone, 0.0, height),
        beyond_m=beyond,
        sigma_m=np.where(np.isfinite(uncertain), uncertain, SIGMA_HEIGHT_M),
        supported=supported,
        patch=patch,
        known=known,
    )


def _surface(patches: Patches, axes: Floats) -> RoadSurface:
    slope = np.stack(patches.slope)
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = np.column_stack([np.stack(patches.centre), patches.offset])
    return RoadSurface(axes=axes, centre_m=centre @ axes, normal=normal @ axes, radius_m=patches.radius_m)


def _known(patches: Patches, surface: RoadSurface, world_from_rig: Floats, units: Ints) -> KnownPatches:
    trajectory = world_from_rig[:, :3, 3] @ surface.axes.T
    row = nearest(trajectory[:, :2], (surface.centre_m @ surface.axes.T)[:, :2])[1][:, 0]
    rig_from_world = se3.inverse(world_from_rig[row])
    return KnownPatches(
        unit=units[row],
        centre_in_rig_m=np.einsum("nij,nj->ni", rig_from_world[:, :3, :3], surface.centre_m) + rig_from_world[:, :3, 3],
        normal_in_rig=np.einsum("nij,nj->ni", rig_from_world[:, :3, :3], surface.normal),
        points=np.array(patches.points, dtype=np.int64),
    )


def _placed(
    known: KnownPatches, sample: RoadSample, world_from_rig: Floats, units: Ints, axes: Floats, radius_m: float
) -> Patches:
    """Known patches where the poses of their units are now; without those whose points have become many more."""
    place = np.full(max(int(units.max()), int(known.unit.max(initial=0))) + 1, -1, dtype=np.int64)
    place[units] = np.arange(len(units))
    row = place[known.unit]
    pose = world_from_rig[row]
    centre = (np.einsum("nij,nj->ni", pose[:, :3, :3], known.centre_in_rig_m) + pose[:, :3, 3]) @ axes.T
    normal = np.einsum("nij,nj->ni", pose[:, :3, :3], known.normal_in_rig) @ axes.T
    slope, patches = _slopes(normal), Patches(radius_m=radius_m)
    if len(centre):
        now = np.diff(points_around(sample.tree, centre[:, :2], radius_m)[0])
        for n in np.flatnonzero((row >= 0) & (now <= GROWN * known.points)):
            patches.append(centre[n, :2], float(centre[n, 2]), slope[n], int(known.points[n]))
    return patches


def _slopes(normal: Floats) -> Floats:
    """Slopes (n, 2) of planes with upward normals (n, 3)."""
    result: Floats = -normal[:, :2] / np.maximum(normal[:, 2:], 0.1)
    return result


def _roughness(distance_m: Floats, sigma_m: Floats, roughness_m: float) -> float:
    """Standard deviation of the road about the surface, from points whose own uncertainty is small.

    `roughness_m` is what it was taken for so far. Wrong points lie near the surface too: only those within the gate of
    the fit have a say, and the gate narrows with what they say.
    """
    for _ in range(ROUGHNESS_STEPS):
        near = np.flatnonzero(np.abs(distance_m) < GATE_SIGMAS * np.hypot(sigma_m, roughness_m))
        if len(near) < MIN_POINTS:
            return roughness_m
        sure = near[sigma_m[near] <= np.quantile(sigma_m[near], SURE_SHARE)]
        variance = robust_sigma(distance_m[sure]) ** 2 - float(np.median(sigma_m[sure])) ** 2
        roughness_m = float(np.sqrt(np.clip(variance, ROUGHNESS_M[0] ** 2, ROUGHNESS_M[1] ** 2)))
    return roughness_m


def robust_sigma(values: Floats) -> float:
    """Standard deviation from the median absolute deviation about the median; zero for no values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _moved_by_residuals(
    sample: RoadSample, points_m: Floats, surface: RoadSurface, *, roughness_m: float
) -> RoadSurface:
    """The surface with every patch moved by the mean residual of its points, along its normal.

    Planes cut through crests and span dips. What they leave of a road's curvature is the same all over a patch, so that
    its points tell it (twicing; Tukey, Exploratory Data Analysis, 1977).
    """
    distance, _ = surface.locate_on_patches(points_m)
    gate = GATE_SIGMAS * np.hypot(sample.sigma, roughness_m)
    near = np.abs(distance) < gate
    # Tukey's weights, as in the fit: points near the gate are as likely wrong as right.
    share = np.where(near, (1.0 - (np.where(near, distance, 0.0) / gate) ** 2) ** 2, 0.0)
    share *= sample.weight / (sample.sigma**2 + roughness_m**2)
    centre = (surface.centre_m @ surface.axes.T)[:, :2]
    first, rows = points_around(sample.tree, centre, surface.radius_m)
    owner = np.repeat(np.arange(len(centre)), np.diff(first))
    rows, owner = rows[near[rows]], owner[near[rows]]
    weight = patch_weight(np.hypot(*(sample.xy[rows] - centre[owner]).T), surface.radius_m) * share[rows]
    total, moved, count = (
        np.bincount(owner, of, minlength=len(centre)) for of in (weight, weight * distance[rows], np.ones(len(rows)))
    )
    step = np.where(count >= MIN_POINTS, moved / np.maximum(total, 1e-12), 0.0)
    return replace(surface, centre_m=surface.centre_m + step[:, None] * surface.normal)
