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
    units = len(mapper.registered)
    keyframe = np.ones(units, dtype=np.bool_)
    last = -1
    for unit in range(units):
        if last >= 0:
            moved_px = _displacement_px(mapper, last, unit)
            keyframe[unit] = not moved_px < mapper.config.mapping.keyframe_motion_px
        if keyframe[unit] and len(mapper.rows_of_unit[unit]):
            last = unit
    if mapper.motion.needed:
        stands = ~keyframe
        keyframe |= stands & ~(np.append(False, stands[:-1]) & np.append(stands[1:], False))
    return keyframe if keyframe.sum() > 1 else np.ones(units, dtype=np.bool_)


def _displacement_px(mapper: Mapper, before: int, now: int) -> float:
    """Way (px) of a camera's tracks that both units see: its median, in the camera where that is largest.

    NaN where no camera has enough of them.
    """
    rows = [mapper.rows_of_unit[unit] for unit in (before, now)]
    cameras = len(mapper.camera_kind)
    keys = [mapper.tracks.of_keypoint[r] * cameras + mapper.keypoints.camera[r] for r in rows]
    _, a, b = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    way_px = np.linalg.norm(mapper.keypoints.xy_px[rows[1][b]] - mapper.keypoints.xy_px[rows[0][a]], axis=1)
    camera = mapper.keypoints.camera[rows[0][a]]
    enough = np.flatnonzero(np.bincount(camera, minlength=cameras) >= MIN_COMMON)
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
