"""Selection of the image pairs that are worth matching: never all of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from mrasfm_engine.config import PairConfig
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.geometry.frustum import view_overlap
from mrasfm_engine.geometry.neighbours import nearest_sorted
from mrasfm_engine.matching.image_motion import (
    NEXT_UNITS,
    Motion,
    are_following,
    following_units,
    next_in_time,
    spacing_m,
)
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools, Floats, Ints

REVISIT_PATH_M = 20.0  # units farther apart along the route than this, but near one another, are a revisit;
REVISIT_DIRECT = 0.5  # near: by less than this share of the trajectory between them
SMOOTHED_S = 0.9  # of a receiver's noise, by which even a standing car seems to move
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


def units_ahead(motion: Motion, config: PairConfig, usable: Bools | None = None) -> list[Ints]:
    """The units after each one that it is paired with, unless views say otherwise; of usable ones (u,), if given."""
    return following_units(
        motion.travelled_m, spacing_m=spacing_m(config.max_depth_m), count=config.window_units, usable=usable
    )


def usable_units(drive: Drive, usable: Bools | None) -> Bools | None:
    """Units (units,) that have an image that is usable (images,); None, as all are, where that is not given."""
    if usable is None:
        return None
    result = np.zeros(len(drive.timestamps_us), dtype=np.bool_)
    result[[image.unit for image, good in zip(drive.images, usable, strict=True) if good]] = True
    return result


def pairs_from_window(
    drive: Drive, config: PairConfig, motion: Motion, *, usable: Bools | None = None, min_matches: int = 0
) -> Ints:
    """Pairs (n, 2) of units and those that follow them, without any prior: the same camera, as long as so many matches
    are expected, and cameras that can see the same things if the car goes forward or back by the distance between them.
    Images that are not usable (i,) are in none.
    """
    views = _Views.from_drive(drive)
    index = {(int(u), int(c)): i for i, (u, c) in enumerate(zip(views.unit, views.camera, strict=True))}
    linked = _CommonViews(drive, views, config)
    pairs = set()
    if usable is not None:
        index = {place: image for place, image in index.items() if usable[image]}
    for unit, ahead in enumerate(units_ahead(motion, config, usable_units(drive, usable))):
        for place, other in enumerate([unit, *ahead.tolist()]):
            near = place <= config.cross_window_units
            common = linked.after(motion.travelled_m[other] - motion.travelled_m[unit]) if near else None
            for a in range(len(drive.cameras)):
                for b in range(len(drive.cameras)):
                    i, j = index.get((unit, a)), index.get((other, b))
                    if i is None or j is None or i == j:
                        continue
                    if a == b:
                        good = place <= NEXT_UNITS or motion.expected_matches(a, unit, other) >= min_matches
                    else:
                        good = common is not None and bool(common[a, b])
                    if good:
                        pairs.add((min(i, j), max(i, j)))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def pairs_without_selection(drive: Drive, config: PairConfig) -> Ints:
    """Pairs (n, 2) of all images of units at most `window_units` apart, whichever way their cameras look."""
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    last = np.searchsorted(unit, unit + config.window_units, side="right")
    pairs = [np.column_stack([np.full(stop - i - 1, i), np.arange(i + 1, stop)]) for i, stop in enumerate(last)]
    return np.concatenate(pairs or [np.zeros((0, 2))]).astype(np.int64)


@dataclass(frozen=True)
class _CommonViews:
    """Cameras that may see the same before and after some distance."""

    drive: Drive
    views: _Views
    config: PairConfig
    known: dict[int, Bools] = field(default_factory=dict)

    def after(self, travelled_m: float) -> Bools:
        """(cameras, cameras): which of now and which of `travelled_m` later, to the nearest half spacing of units."""
        step_m = 0.5 * spacing_m(self.config.max_depth_m)
        steps = round(travelled_m / step_m)
        if steps not in self.known:
            self.known[steps] = self._seen(steps * step_m)
        return self.known[steps]

    def _seen(self, travelled_m: float) -> Bools:
        n = len(self.drive.cameras)
        result = np.zeros((n, n), dtype=np.bool_)
        for shift in {-travelled_m, 0.0, travelled_m}:
            later = self.drive.rig_from_cam.copy()
            later[:, 0, 3] += shift
            poses = np.concatenate([self.drive.rig_from_cam, later])
            pairs = np.stack(np.meshgrid(np.arange(n), n + np.arange(n), indexing="ij"), -1).reshape(-1, 2)
            overlap = view_overlap(
                pairs,
                world_from_cam=poses,
                camera=np.tile(np.arange(n), 2),
                kind=self.views.kind,
                params=self.views.params,
                size_px=self.views.size_px,
                max_depth_m=self.config.max_depth_m,
            )
            good = overlap >= self.config.min_overlap
            good &= _axis_angle_ok(pairs, poses, self.config.max_view_angle_deg)
            result |= good.reshape(n, n)
        return result


def pairs_from_poses(drive: Drive, world_from_rig: Floats, config: PairConfig, usable: Bools | None = None) -> Ints:
    """Pairs (n, 2) by overlap of viewing frustums under prior poses (units, 4, 4), revisits included.

    An image keeps its best pairs by overlap; neighbours in time and cameras of the same unit come first, and images of
    a part of the route that is driven again have a share of their own, so that many neighbours don't crowd them out.
    Images that are not usable (i,) are in none.
    """
    known = np.isfinite(world_from_rig[:, 0, 3])
    if not known.all():
        return _pairs_where_known(drive, world_from_rig, known, config, usable)
    views = _Views.from_drive(drive)
    world_from_cam = world_from_rig[views.unit] @ drive.rig_from_cam[views.camera]
    # Frustums meet half way at the latest; poses far apart need no look.
    centres = world_from_cam[:, :3, 3] + 0.4 * config.max_depth_m * world_from_cam[:, :3, 2]
    tree = cKDTree(centres)
    pairs = tree.query_pairs(config.max_depth_m, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    pairs.sort(axis=1)
    if usable is not None:
        pairs = pairs[usable[pairs].all(axis=1)]
    motion = motion_from_poses(drive, world_from_rig)
    travelled_m = motion.travelled_m
    unit_a, unit_b = views.unit[pairs].T
    ahead = units_ahead(motion, config, usable_units(drive, usable))
    near = are_following(ahead, unit_a, unit_b)
    between_m = np.abs(travelled_m[unit_a] - travelled_m[unit_b])
    position = world_from_rig[views.unit, :3, 3]
    apart = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    revisit = ~near & (between_m > REVISIT_PATH_M) & (apart < REVISIT_DIRECT * between_m)
    keep = (near | revisit) & _axis_angle_ok(pairs, world_from_cam, config.max_view_angle_deg)
    pairs, revisit = pairs[keep], revisit[keep]
    overlap = view_overlap(
        pairs,
        world_from_cam=world_from_cam,
        camera=views.camera,
        kind=views.kind,
        params=views.params,
        size_px=views.size_px,
        max_depth_m=config.max_depth_m,
    )
    quota = round(config.pairs_per_image * REVISIT_SHARE)
    chosen = [
        next_in_time(drive, usable),
        _best_per_image(pairs, np.where(revisit, 0.0, overlap), config.pairs_per_image - quota, config.min_overlap),
        _best_per_image(pairs, np.where(revisit, overlap, 0.0), quota, config.min_overlap),
    ]
    return np.unique(np.concatenate(chosen), axis=0)


def _pairs_where_known(
    drive: Drive, world_from_rig: Floats, known: Bools, config: PairConfig, usable: Bools | None
) -> Ints:
    """Pairs by overlap among units with a prior, and by window where one of the units has none."""
    units = np.flatnonzero(known)
    near = units[nearest_sorted(units, np.arange(len(known)))]
    by_overlap = pairs_from_poses(drive, world_from_rig[near], config, usable)
    by_window = pairs_from_window(drive, config, motion_unknown(drive, config), usable=usable)
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    both = known[unit[by_overlap]].all(axis=1)
    one = ~known[unit[by_window]].all(axis=1)
    return np.unique(np.concatenate([by_overlap[both], by_window[one]]), axis=0)


def motion_from_poses(drive: Drive, world_from_rig: Floats) -> Motion:
    """Motion by the prior trajectory (units, 4, 4), smoothed, and steady across units of which it knows nothing."""
    times_s = drive.timestamps_us / 1e6
    known = np.flatnonzero(np.isfinite(world_from_rig[:, 0, 3]))
    travelled_m: Floats = np.zeros(len(times_s))
    if len(known) > 1:
        position_m = np.stack([np.interp(times_s, times_s[known], world_from_rig[known, k, 3]) for k in range(3)], 1)
        size = max(1, round(SMOOTHED_S / float(np.median(np.diff(times_s)))))
        smooth = uniform_filter1d(position_m, size, axis=0, mode="nearest")
        travelled_m[1:] = np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))
    return Motion.from_travelled(drive, travelled_m)


def motion_unknown(drive: Drive, config: PairConfig) -> Motion:
    """Motion of which nothing is known: each unit is as far from the last one as gives depth."""
    return Motion.from_travelled(
        drive, spacing_m(config.max_depth_m) * np.arange(len(drive.timestamps_us), dtype=np.float64)
    )


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
