"""The ground along the vehicle's path: nothing is seen below it."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.triangulation.road_prior import ground_level_m
from mrasfm_engine.triangulation.track_motion import GroundPath

STEP_M = 1.0
MAX_CAMERA_HEIGHT_M = 4.0  # of any camera above the ground, where no level of it is seen,
CAMERA_HEIGHT_M = 1.6  # and what it is on cars as a rule
LONGEST_GAP_M = 100.0  # between units, of which stations are made: what is beyond is seen from neither side
SAME_HEADING = 0.5  # cosine
TOLERANCE_M = 0.2  # of the ground's height on the path: what the body moves on its springs, and the level's points err


def ground_path(mapper: Mapper) -> GroundPath:
    """The ground below the registered units, of which there is one at least."""
    units = np.flatnonzero(mapper.registered)
    poses = mapper.state.world_from_rig[units]
    place = poses[:, :3, 3]
    steps_m = np.minimum(np.linalg.norm(np.diff(place, axis=0), axis=1), LONGEST_GAP_M)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    stations_m = np.arange(int(travelled_m[-1] / STEP_M) + 1) * STEP_M
    before = np.searchsorted(travelled_m, stations_m, side="right") - 1
    after = np.minimum(before + 1, len(units) - 1)
    part = (stations_m - travelled_m[before]) / np.maximum(travelled_m[after] - travelled_m[before], 1e-9)
    part = np.clip(part, 0.0, 1.0)[:, None]
    between = (1 - part[..., None]) * poses[before] + part[..., None] * poses[after]
    # Between headings that have little in common, as of a turn in a gap, a mean is no heading.
    turned = (poses[before, :3, 0] * poses[after, :3, 0]).sum(1) < SAME_HEADING
    nearer = np.where(part[:, 0] < 0.5, before, after)
    between[turned, :3, :3] = poses[nearer[turned], :3, :3]
    up = between[:, :3, 2] / np.linalg.norm(between[:, :3, 2], axis=1, keepdims=True)
    forward = between[:, :3, 0] - (between[:, :3, 0] * up).sum(1, keepdims=True) * up
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    cameras_m = mapper.state.camera_position_m[:, 2]
    points_m = mapper.state.points_m[mapper.triangulated]
    level_m = ground_level_m(points_m, poses, float(cameras_m.min()))
    camera_height_m = CAMERA_HEIGHT_M if level_m is None else float(cameras_m.mean()) - level_m
    if level_m is None:
        level_m = float(cameras_m.min()) - MAX_CAMERA_HEIGHT_M
    station = np.zeros(len(mapper.registered), dtype=np.int64)
    station[units] = np.clip(np.round(travelled_m / STEP_M).astype(np.int64), 0, len(stations_m) - 1)
    return GroundPath(
        ground_m=between[:, :3, 3] + level_m * up,
        up=up,
        forward=forward,
        step_m=STEP_M,
        station=station[mapper.motion.bands.unit],
        tolerance_m=TOLERANCE_M,
        camera_height_m=camera_height_m,
    )
