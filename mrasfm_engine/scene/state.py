"""Poses, calibration and points while they are being estimated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import PARAMETERS
from mrasfm_engine.types import Floats, Ints


@dataclass(frozen=True, kw_only=True)
class State:
    """A value of all variables, free or not, and the units' motion, which follows from them.

    The camera of a row band (see `scene.row_bands`) stands at world_from_rig * unit_from_band * rig_from_cam. Without
    row bands all images are taken at their unit's timestamp.
    """

    unit_rotation: Floats  # (u, 3, 3) of world_from_rig
    unit_position_m: Floats  # (u, 3)
    camera_rotation: Floats  # (c, 3, 3) of rig_from_cam
    camera_position_m: Floats  # (c, 3)
    camera_params: Floats  # (c, PARAMETERS), see geometry.camera_model
    points_m: Floats  # (p, 3)
    camera_time_offset_s: Floats  # (c,) by how much later than their timestamps a camera's images were taken
    band_rotation: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))  # (s, 3, 3) of unit_from_band
    band_position_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (s, 3)

    def __post_init__(self) -> None:
        if self.camera_params.shape[1:] != (PARAMETERS,):  # compiled functions would read beyond its end
            raise ValueError(f"camera_params {self.camera_params.shape} do not have {PARAMETERS} numbers a camera")

    @property
    def world_from_rig(self) -> Floats:
        """The units' poses (u, 4, 4)."""
        return se3.transform(self.unit_rotation, self.unit_position_m)

    def world_from_rig_of(self, units: Ints) -> Floats:
        """The poses (n, 4, 4) of some units, without those of all others."""
        return se3.transform(self.unit_rotation[units], self.unit_position_m[units])

    @property
    def rig_from_cam(self) -> Floats:
        """The cameras' poses (c, 4, 4)."""
        return se3.transform(self.camera_rotation, self.camera_position_m)

    @property
    def simultaneous(self) -> bool:
        """All images are taken at their unit's timestamp."""
        return len(self.band_rotation) == 0

    @property
    def unit_from_band(self) -> Floats:
        """The rig's poses at the row bands, relative to its pose at their unit's timestamp (s, 4, 4)."""
        return se3.transform(self.band_rotation, self.band_position_m)

    def with_cameras_of(self, other: State) -> State:
        """The state with copies of another one's calibration and time offsets of the cameras."""
        return replace(
            self,
            camera_rotation=other.camera_rotation.copy(),
            camera_position_m=other.camera_position_m.copy(),
            camera_params=other.camera_params.copy(),
            camera_time_offset_s=other.camera_time_offset_s.copy(),
        )
