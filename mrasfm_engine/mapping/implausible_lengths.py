"""Lengths that no road vehicle has: its speed, and how high its cameras stand above the road.

Without positions, the scale of a scene rests on baselines of the rig and on what cameras see together. Where that is
little, and the rig is not as given, a scene may be many times too long and seem certain of it.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.road import RoadAssessment
from mrasfm_engine.mapping.vehicle_speed import MAX_SPEED_MPS, speeds_mps
from schemas.findings import Finding, warning

FAST = 0.9  # of the intervals between units are slower: a vehicle may stand for most of a drive
CAMERA_HEIGHT_M = 0.2, 6.0  # from a bumper's to above the roof of a lorry


def length_findings(mapper: Mapper, refinement: Refinement) -> list[Finding]:
    """Warn where lengths of a scene without positions are those of no road vehicle."""
    if refinement.georeferenced:
        return []
    signs = [sign for sign in (_speed(mapper), _camera_height(mapper, refinement)) if sign is not None]
    if not signs:
        return []
    return [
        warning(
            "implausible-lengths",
            f"lengths of the scene are hardly right, whatever their stated uncertainty: in it {' and '.join(signs)}",
            "Check frames' timestamps and the translations in rig.cameras, which are in metres; give GNSS positions, "
            "or a calibration that is known better.",
        )
    ]


def _speed(mapper: Mapper) -> str | None:
    speeds = speeds_mps(mapper)
    if not len(speeds):
        return None
    speed_mps = float(np.quantile(speeds, FAST))
    return f"the vehicle drives up to {speed_mps:.0f} m/s" if speed_mps > MAX_SPEED_MPS else None


def _camera_height(mapper: Mapper, refinement: Refinement) -> str | None:
    if not isinstance(refinement.road, RoadAssessment):
        return None
    height_m = refinement.road.road.rig_height_m + float(np.median(mapper.state.camera_position_m[:, 2]))
    low_m, high_m = CAMERA_HEIGHT_M
    return None if low_m <= height_m <= high_m else f"cameras stand {height_m:.1f} m above the road"
