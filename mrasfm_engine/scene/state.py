"""Poses, calibration and points while they are being estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.geometry import se3

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class State:
    """A value of all variables, free or not."""

    unit_rotation: Floats  # (u, 3, 3) of world_from_rig
    unit_position_m: Floats  # (u, 3)
    camera_rotation: Floats  # (c, 3, 3) of rig_from_cam
    camera_position_m: Floats  # (c, 3)
    camera_params: Floats  # (c, 8), see geometry.camera_model
    points_m: Floats  # (p, 3)

    @property
    def world_from_rig(self) -> Floats:
        """The units' poses (u, 4, 4)."""
        return se3.transform(self.unit_rotation, self.unit_position_m)

    @property
    def rig_from_cam(self) -> Floats:
        """The cameras' poses (c, 4, 4)."""
        return se3.transform(self.camera_rotation, self.camera_position_m)
