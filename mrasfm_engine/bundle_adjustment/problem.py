"""Variables and observations of camera set bundle adjustment.

Variables are the poses of rigid units, `rig_from_cam`, the intrinsics and the time offset of every camera, and points.
A pose is stored as rotation and position of the moving frame in the fixed one (`world_from_rig`, `rig_from_cam`), so
that a step

    R <- exp(omega) R,   t <- t + tau

has its rotation vector omega and translation tau in the axes of the fixed frame. All steps of all free units and
cameras, in this order, make up the reduced vector of unknowns:

    unit slot u:    [omega (3, rad), tau (3, m)]            at 6 u
    camera slot c:  [omega (3, rad), tau (3, m), phi, delta (s), rho (s), alpha, cx, cy, d0, d1, d2, d3]    at 6 U + d c

Of a camera's intrinsics phi is a factor of both focal lengths, alpha of fy alone: fx <- fx exp(phi),
fy <- fy exp(phi + alpha); the others are those of `geometry.camera_model`, in pixels and as they are. By delta its
images were taken later than their timestamps say: their row bands move along the trajectory. By rho the time from the
first row to the last is longer than declared; no step is taken there, but it is asked what it would do to the others.
Where no more than phi varies, the vector has no other and d is 7; it is 9 where times vary as well, else 16.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import ADJUSTED
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints

UNIT_DOF = 6
INTRINSICS = ADJUSTED  # phi, alpha, cx, cy, d0, d1, d2, d3
DISTORTION = 4  # place of d0 among them
CAMERA_DOF = 16
# Places of a camera's step: phi, delta, rho, and from here on the rest of the intrinsics.
FOCAL, TIME, READOUT, LENS = 6, 7, 8, 9
PLACES_OF_INTRINSICS = np.array([FOCAL, *range(LENS, CAMERA_DOF)])


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Image observations of points, sorted by point."""

    unit: Ints  # (n,) indices into the units
    camera: Ints  # (n,)
    point: Ints  # (n,) ascending
    xy_px: Floats  # (n, 2)
    first_of_point: Ints = field(init=False)  # (p + 1,) observations of point i: first[i]:first[i + 1]
    num_points: int
    band: Ints | None = None  # (n,) indices into the state's row bands; without, all are at their unit's timestamp
    fixed: Bools | None = None  # (p,) points that stay where they are; without, none does

    def __post_init__(self) -> None:
        first = np.searchsorted(self.point, np.arange(self.num_points + 1))
        if self.fixed is None:
            object.__setattr__(self, "fixed", np.zeros(self.num_points, dtype=np.bool_))
        object.__setattr__(self, "first_of_point", first.astype(np.int64))

    @property
    def num_free_points(self) -> int:
        """Number of points that may move."""
        return self.num_points if self.fixed is None else self.num_points - int(self.fixed.sum())


@dataclass(frozen=True, kw_only=True)
class RowBandMotion:
    """Motion of row bands with the trajectory of the units that are adjusted."""

    support: Ints  # (s, 3) units whose steps move a row band; -1 where weight is 0
    weight: Floats  # (s, 3) by how much; (1, 0, 0) where it is held to its unit
    velocity: Floats  # (s, 6) of the rig at a row band, in its own axes there: turn (rad/s), motion (m/s)
    readout: Floats  # (c, 3) of the cameras, see `row_bands.readout_share`
    place_bands: Callable[[State], State]  # the state with its row bands computed anew from its units

    @staticmethod
    def held(band_unit: Ints, readout: Floats) -> RowBandMotion:
        """Row bands (s,) that stay where they are relative to their units, and the readout (c, 3) of the cameras."""
        support = np.full((len(band_unit), 3), -1, dtype=np.int64)
        support[:, 0] = band_unit
        return RowBandMotion(
            support=support,
            weight=np.tile([1.0, 0.0, 0.0], (len(support), 1)),
            velocity=np.zeros((len(support), 6)),
            readout=readout,
            place_bands=lambda s: s,
        )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Free variables, and the places of their steps in the reduced vector."""

    unit_slot: Ints  # (u,) -1 where fixed
    camera_slot: Ints  # (c,) -1 where fixed
    num_units: int
    num_cameras: int
    free_intrinsics: Bools  # (cameras, INTRINSICS) of the free cameras by slot: which of them vary
    free_times: Bools  # (cameras,) the same of their time offsets,
    free_readouts: Bools  # (cameras,) and of their readouts

    @staticmethod
    def from_free(
        free_units: Bools,
        free_cameras: Bools,
        *,
        free_intrinsics: Bools | None = None,
        free_times: Bools | None = None,
        free_readouts: Bools | None = None,
    ) -> Layout:
        """The layout with the marked units and cameras free, and of these the marked intrinsics and times.

        Parameters
        ----------
        free_intrinsics, free_times, free_readouts
            (c, INTRINSICS), (c,) and (c,); without, all are held.
        """
        if free_intrinsics is None:
            free_intrinsics = np.zeros((len(free_cameras), INTRINSICS), dtype=np.bool_)
        none = np.zeros(len(free_cameras), dtype=np.bool_)
        return Layout(
            unit_slot=np.where(free_units, np.cumsum(free_units) - 1, -1).astype(np.int64),
            camera_slot=np.where(free_cameras, np.cumsum(free_cameras) - 1, -1).astype(np.int64),
            num_units=int(free_units.sum()),
            num_cameras=int(free_cameras.sum()),
            free_intrinsics=free_intrinsics[free_cameras],
            free_times=(none if free_times is None else free_times)[free_cameras],
            free_readouts=(none if free_readouts is None else free_readouts)[free_cameras],
        )

    @property
    def camera_dof(self) -> int:
        """Number of a camera's places in the reduced vector."""
        if self.free_intrinsics[:, 1:].any():
            return CAMERA_DOF
        return LENS if self.free_times.any() or self.free_readouts.any() else TIME

    @property
    def size(self) -> int:
        """Length of the reduced vector."""
        return UNIT_DOF * self.num_units + self.camera_dof * self.num_cameras

    def held(self) -> Ints:
        """Positions of the reduced vector that have a slot but may not move (intrinsics and times that are held)."""
        places = np.zeros((self.num_cameras, CAMERA_DOF), dtype=np.bool_)
        places[:, PLACES_OF_INTRINSICS] = ~self.free_intrinsics
        places[:, TIME], places[:, READOUT] = ~self.free_times, ~self.free_readouts
        result: Ints = UNIT_DOF * self.num_units + np.flatnonzero(places[:, : self.camera_dof])
        return result


def retract(state: State, layout: Layout, step: Floats, points_m: Floats) -> State:
    """The state after a step of the reduced vector, with new points."""
    units = np.flatnonzero(layout.unit_slot >= 0)
    cameras = np.flatnonzero(layout.camera_slot >= 0)
    d_unit = step[: UNIT_DOF * layout.num_units].reshape(-1, UNIT_DOF)
    d_camera = step[UNIT_DOF * layout.num_units :].reshape(-1, layout.camera_dof)
    unit_rotation, unit_position = state.unit_rotation.copy(), state.unit_position_m.copy()
    unit_rotation[units] = se3.exp_so3(d_unit[:, :3]) @ unit_rotation[units]
    unit_position[units] += d_unit[:, 3:]
    camera_rotation, camera_position = state.camera_rotation.copy(), state.camera_position_m.copy()
    camera_rotation[cameras] = se3.exp_so3(d_camera[:, :3]) @ camera_rotation[cameras]
    camera_position[cameras] += d_camera[:, 3:6]
    camera_params = state.camera_params.copy()
    camera_params[cameras, :2] *= np.exp(d_camera[:, FOCAL, None])
    camera_time_offset_s = state.camera_time_offset_s
    if layout.camera_dof > TIME:
        camera_time_offset_s = camera_time_offset_s.copy()
        camera_time_offset_s[cameras] += d_camera[:, TIME]
    if layout.camera_dof > LENS:
        camera_params[cameras, 1] *= np.exp(d_camera[:, LENS])
        camera_params[cameras, 2:ADJUSTED] += d_camera[:, LENS + 1 :]
    return replace(
        state,
        unit_rotation=unit_rotation,
        unit_position_m=unit_position,
        camera_rotation=camera_rotation,
        camera_position_m=camera_position,
        camera_params=camera_params,
        camera_time_offset_s=camera_time_offset_s,
        points_m=points_m,
    )
