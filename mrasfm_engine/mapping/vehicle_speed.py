"""Speeds of vehicles that map roads, where images do not tell how far the vehicle has gone."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.matching.motion_of_cameras import USUAL_SPEED_MPS
from mrasfm_engine.types import Floats

MAX_SPEED_MPS = 70.0  # 250 km/h: cars that map roads drive no faster


def speeds_mps(mapper: Mapper) -> Floats:
    """Speeds (registered - 1,) between registered units that follow one another."""
    units = np.flatnonzero(mapper.registered)
    elapsed_s = np.diff(mapper.drive.timestamps_us[units]) / 1e6
    result: Floats = np.linalg.norm(np.diff(mapper.state.unit_position_m[units], axis=0), axis=1) / elapsed_s
    return result


def usual_distance_m(mapper: Mapper, u: int, v: int) -> float:
    """Metres between two units at a usual speed."""
    elapsed_us = mapper.drive.timestamps_us[v] - mapper.drive.timestamps_us[u]
    return USUAL_SPEED_MPS * abs(float(elapsed_us)) / 1e6
