"""Image pairs between two scenes: few, and where their footprints on the ground overlap.

GNSS gives the initial alignment of two scenes, with an error of metres. A few units of one scene are therefore compared
with all units of the other that may have seen the same place. Once the transform is known, images are paired by the
overlap of their footprints and the angle between their views, over all cameras of both: the back camera of a vehicle in
the opposite direction has seen what the other's front camera saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.aggregation.footprint import footprints, overlaps
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.types import Floats, Ints

SIGHT_SHIFT_M = 12.0  # cameras this far apart along their views still match
MIN_OVERLAP = 0.15
LEAST_PROBES = 10  # units of a short trajectory that are looked for, or looked at
PROBE_PAIRS = 14  # of an image, while it is not known how the scenes lie
SIMILAR_DISTANCE_M = 10.0  # cameras this far apart count half


@dataclass(frozen=True, kw_only=True)
class Probe:
    """A unit of scene b, and image pairs (n, 2) of a and b that may relocalise it in a."""

    unit: int
    pairs: Ints


def thinned(scene: SourceScene, spacing_m: float) -> Ints:
    """Registered units with keypoints at least so far apart along the trajectory."""
    chosen: list[int] = []
    last = None
    for unit in np.unique(scene.image_unit[scene.image_matchable]):
        at = scene.world_from_rig[unit, :3, 3]
        if last is None or np.linalg.norm(at - last) >= spacing_m:
            chosen.append(int(unit))
            last = at
    return np.array(chosen, dtype=np.int64)


def _length_m(scene: SourceScene) -> float:
    return float(np.linalg.norm(np.diff(scene.trajectory_m, axis=0), axis=1).sum())


def nearest_distance_m(a: SourceScene, b: SourceScene, a_from_b: Floats) -> float:
    """Smallest horizontal distance between the trajectories of two scenes."""
    return _nearest_m(a, b, a_from_b)[0]


def height_between_m(a: SourceScene, b: SourceScene, a_from_b: Floats) -> float:
    """Height of scene b's trajectory above scene a's where they are horizontally nearest."""
    return _nearest_m(a, b, a_from_b)[1]


def _nearest_m(a: SourceScene, b: SourceScene, a_from_b: Floats) -> tuple[float, float]:
    """Horizontal distance of two trajectories where it is smallest, and the height of b's above a's there."""
    trajectory = b.trajectory_m @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    found = cKDTree(a.trajectory_m[:, :2]).query(trajectory[:, :2])
    apart, nearest = np.asarray(found[0]), np.asarray(found[1])
    best = int(np.argmin(apart))
    return float(apart[best]), float(trajectory[best, 2] - a.trajectory_m[nearest[best], 2])


def probes(a: SourceScene, b: SourceScene, a_from_b: Floats, config: AggregationConfig) -> list[Probe]:
    """Units of b to look for in a, the most promising first.

    Parameters
    ----------
    a_from_b
        How the scenes lie by their positions (4, 4).
    """
    reach = config.position_error_m + SIGHT_SHIFT_M
    units_a, units_b = probe_units(a, b, config)
    images_a, images_b = images_of(a, units_a), images_of(b, units_b)
    if not len(images_a) or not len(images_b):
        return []
    poses_a, poses_b = a.world_from_cam[images_a], a_from_b @ b.world_from_cam[images_b]
    pairs, score = _near_pairs(poses_a, poses_b, reach, config.max_view_angle_deg)
    found: dict[int, list[tuple[float, Ints]]] = {}
    order = np.lexsort((-score, pairs[:, 1]))
    pairs, score = pairs[order], score[order]
    starts = np.searchsorted(pairs[:, 1], pairs[:, 1])
    best = np.arange(len(pairs)) - starts < PROBE_PAIRS
    for (i, j), value in zip(pairs[best], score[best], strict=True):
        image_b = int(images_b[j])
        found.setdefault(int(b.image_unit[image_b]), []).append(
            (float(value), np.array([images_a[i], image_b], dtype=np.int64))
        )
    ranked = sorted(found.items(), key=lambda item: (-sum(value for value, _ in item[1]), item[0]))
    return [Probe(unit=unit, pairs=np.stack([pair for _, pair in rows])) for unit, rows in ranked]


def probe_units(a: SourceScene, b: SourceScene, config: AggregationConfig) -> tuple[Ints, Ints]:
    """Units of a that are looked at, and units of b that are looked for."""
    units_a, units_b = (
        thinned(s, min(config.probe_spacing_m * f, _length_m(s) / LEAST_PROBES)) for s, f in ((a, 0.75), (b, 1))
    )
    return units_a, units_b


def images_of(scene: SourceScene, units: Ints) -> Ints:
    """Images with keypoints of some units."""
    return np.flatnonzero(np.isin(scene.image_unit, units) & scene.image_matchable)


def _near_pairs(poses_a: Floats, poses_b: Floats, reach_m: float, max_angle_deg: float) -> tuple[Ints, Floats]:
    """Pairs (n, 2) of poses within reach that look in similar directions, and how promising (n,) each is."""
    near: list[list[int]] = list(cKDTree(poses_a[:, :3, 3]).query_ball_point(poses_b[:, :3, 3], reach_m))  # type: ignore[arg-type]
    pairs = np.array([(i, j) for j, found in enumerate(near) for i in sorted(found)], dtype=np.int64).reshape(-1, 2)
    cosine = (poses_a[pairs[:, 0], :3, 2] * poses_b[pairs[:, 1], :3, 2]).sum(1)
    keep = cosine > np.cos(np.radians(max_angle_deg))
    pairs, cosine = pairs[keep], cosine[keep]
    away = np.linalg.norm(poses_a[pairs[:, 0], :3, 3] - poses_b[pairs[:, 1], :3, 3], axis=1)
    return pairs, cosine**2 * np.exp(-((away / reach_m) ** 2))


def guided_pairs(a: SourceScene, b: SourceScene, a_from_b: Floats, config: AggregationConfig) -> Ints:
    """Image pairs (n, 2) of a and b whose footprints overlap as the scenes lie, the best of every image.

    Parameters
    ----------
    a_from_b
        How the scenes lie (4, 4), to within the size of a footprint.
    """
    pairs, score = _overlapping(a, b, a_from_b, config)
    chosen = np.zeros(len(pairs), dtype=np.bool_)
    for side in (0, 1):
        order = np.lexsort((-score, pairs[:, side]))
        image = pairs[order, side]
        chosen[order[np.arange(len(order)) - np.searchsorted(image, image) < config.pairs_per_image]] = True
    rows = np.flatnonzero(chosen)
    rows = np.sort(rows[np.argsort(-score[rows], kind="stable")[: config.max_pairs]])
    return pairs[rows]


def common_view(a: SourceScene, b: SourceScene, a_from_b: Floats, config: AggregationConfig) -> float:
    """Overlap of two scenes, in images: the best overlaps of all images, added."""
    pairs, score = _overlapping(a, b, a_from_b, config)
    best = [np.zeros(len(scene.image_unit)) for scene in (a, b)]
    for side in (0, 1):
        np.maximum.at(best[side], pairs[:, side], score)
    return float(min(best[0].sum(), best[1].sum()))


def _overlapping(a: SourceScene, b: SourceScene, a_from_b: Floats, config: AggregationConfig) -> tuple[Ints, Floats]:
    """Image pairs (n, 2) whose footprints overlap, and how alike (n,) they should look."""
    images_a, images_b = np.flatnonzero(a.image_matchable), np.flatnonzero(b.image_matchable)
    poses_a, poses_b = a.world_from_cam[images_a], a_from_b @ b.world_from_cam[images_b]
    pairs, _ = _near_pairs(poses_a, poses_b, 1.5 * SIGHT_SHIFT_M, config.max_view_angle_deg)
    if not len(pairs):
        return pairs, np.zeros(0)
    cosine = (poses_a[pairs[:, 0], :3, 2] * poses_b[pairs[:, 1], :3, 2]).sum(1)
    away = np.linalg.norm(poses_a[pairs[:, 0], :3, 3] - poses_b[pairs[:, 1], :3, 3], axis=1)
    pairs = np.column_stack([images_a[pairs[:, 0]], images_b[pairs[:, 1]]])
    depth = config.max_depth_m
    samples = footprints(a, depth), footprints(b, depth)
    overlap = overlaps(pairs, a, b, a_from_b=a_from_b, samples=samples, max_depth_m=depth)
    # What is seen from elsewhere, or at another angle, looks different however much the footprints overlap.
    score = overlap * cosine**2 / (1.0 + away / SIMILAR_DISTANCE_M)
    keep = overlap >= MIN_OVERLAP
    return pairs[keep], score[keep]
