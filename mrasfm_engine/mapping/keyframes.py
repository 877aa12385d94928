"""Keyframes: units of a standing or creeping car take no part in mapping, and get their poses afterwards.

Motion is measured in the images, as GNSS positions jitter when the car stands. A unit whose keypoints are where those
of the last keyframe were adds no parallax, only more of the same equations. After the refinement, each such unit is
registered against the reconstruction with all points held, so that a hundred of them neither drift nor bend anything.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.unit_registration import Registration, register_unit
from mrasfm_engine.types import Bools, Ints

MIN_COMMON = 40  # keypoints of a camera in common with the last keyframe; with fewer, nothing is known


def select_keyframes(mapper: Mapper) -> Bools:
    """Select the units (u,) that moved against the last keyframe before them, in the camera that moved most.

    A camera's motion is its median, because others drive past a standing car. One camera is enough, because a lorry
    that drives along stands still in all that it covers: a unit too many costs time, one too few loses points. Where
    images are not simultaneous, the first and the last unit of a stop stay keyframes: they tell that the car stood. A
    drive without motion has keyframes only.
    """
    units, cameras = len(mapper.registered), len(mapper.camera_kind)
    keyframe = np.ones(units, dtype=np.bool_)
    # Of every track in every camera, its keypoint in the last keyframe; -1 for none.
    before = np.full(len(mapper.tracks) * cameras, -1, dtype=np.int32)
    of_last = np.zeros(0, dtype=np.int64)
    for unit, rows in enumerate(mapper.rows_of_unit):
        place = mapper.tracks.of_keypoint[rows] * cameras + mapper.keypoints.camera[rows]
        if len(of_last):
            moved_px = _displacement_px(mapper, before[place], rows)
            keyframe[unit] = not moved_px < mapper.config.mapping.keyframe_motion_px
        if keyframe[unit] and len(rows):
            before[of_last], before[place] = -1, rows
            of_last = place
    if mapper.motion.needed:
        stands = ~keyframe
        keyframe |= stands & ~(np.append(False, stands[:-1]) & np.append(stands[1:], False))
    return keyframe if keyframe.sum() > 1 else np.ones(units, dtype=np.bool_)


def _displacement_px(mapper: Mapper, before: Ints, now: Ints) -> float:
    """Way (px) of a camera's keypoints from `before` (n,), -1 for none, to `now` (n,): its median, in the camera where
    that is largest.

    NaN where no camera has enough of them.
    """
    before, now = before[before >= 0], now[before >= 0]
    way_px = np.linalg.norm(mapper.keypoints.xy_px[now] - mapper.keypoints.xy_px[before], axis=1)
    camera = mapper.keypoints.camera[now]
    enough = np.flatnonzero(np.bincount(camera) >= MIN_COMMON)
    return max((float(np.median(way_px[camera == c])) for c in enough), default=float("nan"))


def register_between_keyframes(mapper: Mapper, *, max_error_px: float) -> list[Registration]:
    """Give all units that are no keyframes their poses from the finished scene, whose points stay as they are.

    They observe the points of their tracks that they see within `max_error_px`.
    """
    results = []
    for unit in np.flatnonzero(~mapper.keyframe & ~mapper.registered).tolist():
        mapper.motion.predict(mapper.state, mapper.registered, unit)
        registration = register_unit(mapper, unit)
        results.append(registration)
        if registration.world_from_rig is not None:
            mapper.set_pose(unit, registration.world_from_rig)
            rows = mapper.rows_of_unit[unit]
            rows = rows[mapper.triangulated[mapper.tracks.of_keypoint[rows]]]
            tracks = mapper.tracks.of_keypoint[rows]
            mapper.is_inlier[rows] = (
                mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, tracks) < max_error_px
            )
    return results


def nearest_keyframes(mapper: Mapper) -> Ints:
    """The registered keyframe (u,) nearest to each unit; itself, where it is one."""
    known = np.flatnonzero(mapper.keyframe & mapper.registered)
    units = np.arange(len(mapper.registered))
    after = np.searchsorted(known, units)
    low, high = known[np.maximum(after - 1, 0)], known[np.minimum(after, len(known) - 1)]
    return np.where(units - low <= high - units, low, high)
