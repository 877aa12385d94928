"""Selection of the image pairs that are worth matching: never all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from mrasfm_engine.config import PairConfig
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.geometry.frustum import view_overlap
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools, Floats, Ints

ASSUMED_STEP_M = 1.5  # how far a car may have gone from one unit to the next, where nothing else is known
REVISIT_PATH_M = 20.0  # units farther apart along the route than this, but near one another, are a revisit;
REVISIT_DIRECT = 0.5  # near: by less than this share of the trajectory between them
SMOOTHED_UNITS = 9
REVISIT_SHARE = 0.4  # of an image's pairs that revisits may take


@dataclass(frozen=True)
class _Views:
    """Arrays over the drive's images."""

    unit: Ints
    camera: Ints
    kind: Ints
    params: Floats
    size_px: Ints

    @staticmethod
    def from_drive(drive: Drive) -> _Views:
        kind, params = pack_cameras(drive.cameras)
        return _Views(
            unit=np.array([image.unit for image in drive.images], dtype=np.int64),
            camera=np.array([image.camera for image in drive.images], dtype=np.int64),
            kind=kind,
            params=params,
            size_px=np.array([(c.width, c.height) for c in drive.cameras], dtype=np.int64),
        )


def _axis_angle_ok(pairs: Ints, world_from_cam: Floats, max_angle_deg: float) -> Bools:
    axis = world_from_cam[:, :3, 2]
    result: Bools = (axis[pairs[:, 0]] * axis[pairs[:, 1]]).sum(1) > np.cos(np.radians(max_angle_deg))
    return result


def pairs_from_window(drive: Drive, config: PairConfig) -> Ints:
    """Pairs (n, 2) within a window of units, without any prior: the same camera, and cameras that can see the same
    things if the car stands or goes some way forward or back.
    """
    views = _Views.from_drive(drive)
    cameras = len(drive.cameras)
    index = {(int(u), int(c)): i for i, (u, c) in enumerate(zip(views.unit, views.camera, strict=True))}
    gaps = range(max(config.window_units, config.cross_window_units) + 1)
    linked = {gap: _cameras_with_common_view(drive, views, gap, config) for gap in gaps}
    pairs = set()
    for (u, a), i in index.items():
        for gap in gaps:
            for b in range(cameras):
                same_in_window = a == b and 0 < gap <= config.window_units
                cross_in_window = a != b and gap <= config.cross_window_units and linked[gap][a, b]
                j = index.get((u + gap, b))
                if j is not None and (same_in_window or cross_in_window):
                    pairs.add((min(i, j), max(i, j)))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def pairs_without_selection(drive: Drive, config: PairConfig) -> Ints:
    """Pairs (n, 2) of all images of units at most `window_units` apart, whichever way their cameras look."""
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    last = np.searchsorted(unit, unit + config.window_units, side="right")
    pairs = [np.column_stack([np.full(stop - i - 1, i), np.arange(i + 1, stop)]) for i, stop in enumerate(last)]
    return np.concatenate(pairs or [np.zeros((0, 2))]).astype(np.int64)


def _cameras_with_common_view(drive: Drive, views: _Views, gap: int, config: PairConfig) -> Bools:
    """(cameras, cameras): which of now and which of `gap` units later may see the same."""
    n = len(drive.cameras)
    result = np.zeros((n, n), dtype=np.bool_)
    for shift in (-gap * ASSUMED_STEP_M, 0.0, gap * ASSUMED_STEP_M):
        later = drive.rig_from_cam.copy()
        later[:, 0, 3] += shift
        poses = np.concatenate([drive.rig_from_cam, later])
        pairs = np.stack(np.meshgrid(np.arange(n), n + np.arange(n), indexing="ij"), -1).reshape(-1, 2)
        overlap = view_overlap(
            pairs,
            world_from_cam=poses,
            camera=np.tile(np.arange(n), 2),
            kind=views.kind,
            params=views.params,
            size_px=views.size_px,
            max_depth_m=config.max_depth_m,
        )
        good = (overlap >= config.min_overlap) & _axis_angle_ok(pairs, poses, config.max_view_angle_deg)
        result |= good.reshape(n, n)
    return result


def pairs_from_poses(drive: Drive, world_from_rig: Floats, config: PairConfig) -> Ints:
    """Pairs (n, 2) by overlap of viewing frustums under prior poses (units, 4, 4), revisits included.

    An image keeps its best pairs by overlap; neighbours in time and cameras of the same unit come first, and images of
    a part of the route that is driven again have a share of their own, so that many neighbours don't crowd them out.
    """
    known = np.isfinite(world_from_rig[:, 0, 3])
    if not known.all():
        return _pairs_where_known(drive, world_from_rig, known, config)
    views = _Views.from_drive(drive)
    world_from_cam = world_from_rig[views.unit] @ drive.rig_from_cam[views.camera]
    # Frustums meet half way at the latest; poses far apart need no look.
    centres = world_from_cam[:, :3, 3] + 0.4 * config.max_depth_m * world_from_cam[:, :3, 2]
    tree = cKDTree(centres)
    pairs = tree.query_pairs(config.max_depth_m, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    pairs.sort(axis=1)
    travelled_m = _travelled_m(world_from_rig[:, :3, 3])
    gap = np.abs(views.unit[pairs[:, 0]] - views.unit[pairs[:, 1]])
    between_m = np.abs(travelled_m[views.unit[pairs[:, 0]]] - travelled_m[views.unit[pairs[:, 1]]])
    position = world_from_rig[views.unit, :3, 3]
    apart = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    revisit = (gap > config.window_units) & (between_m > REVISIT_PATH_M) & (apart < REVISIT_DIRECT * between_m)
    keep = (gap <= config.window_units) | revisit
    keep &= _axis_angle_ok(pairs, world_from_cam, config.max_view_angle_deg)
    pairs, gap, revisit = pairs[keep], gap[keep], revisit[keep]
    overlap = view_overlap(
        pairs,
        world_from_cam=world_from_cam,
        camera=views.camera,
        kind=views.kind,
        params=views.params,
        size_px=views.size_px,
        max_depth_m=config.max_depth_m,
    )
    neighbours = _next_in_time(views)
    quota = round(config.pairs_per_image * REVISIT_SHARE)
    chosen = [
        neighbours,
        _best_per_image(pairs, np.where(revisit, 0.0, overlap), config.pairs_per_image - quota, config.min_overlap),
        _best_per_image(pairs, np.where(revisit, overlap, 0.0), quota, config.min_overlap),
    ]
    return np.unique(np.concatenate(chosen), axis=0)


def _pairs_where_known(drive: Drive, world_from_rig: Floats, known: Bools, config: PairConfig) -> Ints:
    """Pairs by overlap among units with a prior, and by window where one of the units has none."""
    units = np.flatnonzero(known)
    nearest = units[np.abs(np.arange(len(known))[:, None] - units[None]).argmin(1)]
    by_overlap = pairs_from_poses(drive, world_from_rig[nearest], config)
    by_window = pairs_from_window(drive, config)
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    both = known[unit[by_overlap]].all(axis=1)
    one = ~known[unit[by_window]].all(axis=1)
    return np.unique(np.concatenate([by_overlap[both], by_window[one]]), axis=0)


def _travelled_m(position_m: Floats) -> Floats:
    """Way driven up to each unit (units,); smoothed, as a receiver's noise from unit to unit is no way."""
    smooth = np.stack([uniform_filter1d(position_m[:, k], SMOOTHED_UNITS, mode="nearest") for k in range(3)], axis=1)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])


def _next_in_time(views: _Views) -> Ints:
    """Each image with the two next of its camera: however wrong the prior is, these overlap."""
    pairs = []
    for camera in np.unique(views.camera):
        images = np.flatnonzero(views.camera == camera)
        for gap in (1, 2):
            pairs.append(np.stack([images[:-gap], images[gap:]], 1))
    return np.concatenate(pairs).astype(np.int64) if pairs else np.zeros((0, 2), dtype=np.int64)


def _best_per_image(pairs: Ints, overlap: Floats, count: int, minimum: float) -> Ints:
    """Pairs that are among the `count` best of at least one of their images."""
    keep = np.zeros(len(pairs), dtype=np.bool_)
    good = np.flatnonzero(overlap >= minimum)
    ends = np.concatenate([pairs[good, 0], pairs[good, 1]])
    which = np.concatenate([good, good])
    order = np.lexsort((-overlap[which], ends))
    ends, which = ends[order], which[order]
    starts = np.searchsorted(ends, ends)
    keep[which[np.arange(len(ends)) - starts < count]] = True
    return pairs[keep]
