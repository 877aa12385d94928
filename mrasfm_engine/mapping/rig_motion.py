"""Motion of the rig within a unit: its pose at the time of each image, relative to the unit's timestamp.

`State.unit_from_band` comes from the units' own trajectory: the motion around a unit is interpolated from the
registered units before and after it. It follows these units during their adjustment. If it were held, baselines between
cameras that are not simultaneous would preserve the present scale, and alternating between adjustment and interpolation
need not converge. The same array holds the poses of images that are apart from the rig.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.problem import RowBandMotion
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import ACCELERATION_SIGMA_MPS2
from mrasfm_engine.geometry.local_motion import (
    MAX_GAP_S,
    LocalMotion,
    local_motion,
    moved,
    smoothed_velocity,
    third_differences,
)
from mrasfm_engine.scene.row_bands import MAX_BAND_S, RowBands
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints
from schemas.findings import Finding, warning

PRIOR_WINDOW_S = 1.0  # over which the velocity of noisy prior poses is averaged


@dataclass(frozen=True, kw_only=True)
class LargestMotion:
    """The most that row bands are apart from their unit, over the registered units."""

    translation_m: float
    rotation_deg: float


class RigMotion:
    """The motion within units. It changes a state's `unit_from_band` in place and keeps no poses of units itself.

    Parameters
    ----------
    bands
        When every image (or band of its rows) was taken.
    timestamps_us
        The units' times (u,).
    """

    def __init__(self, bands: RowBands, timestamps_us: Ints) -> None:
        self.bands = bands
        self._time_s = (timestamps_us - timestamps_us[0]) / 1e6
        self._own = np.zeros(len(bands.middle_of_image), dtype=np.bool_)
        self._unit_from_image = np.tile(np.eye(4), (len(self._own), 1, 1))
        self._band_range = np.searchsorted(bands.unit, np.arange(len(timestamps_us) + 1))
        # Of units without registered neighbours; zero where it is not known.
        self._prior_velocity = np.zeros((len(timestamps_us), 6))
        self._prior_known = np.zeros(len(timestamps_us), dtype=np.bool_)

    def follow_prior(self, world_from_rig: Floats) -> None:
        """Take the motion from prior poses (u, 4, 4) where no registered unit shows it; NaN where unknown."""
        if not self.bands.simultaneous:
            velocity = smoothed_velocity(world_from_rig, self._time_s, window_s=PRIOR_WINDOW_S)
            self._prior_known[:] = np.isfinite(velocity).all(axis=1)
            self._prior_velocity = np.nan_to_num(velocity)

    def set_image_pose(self, image: int, unit_from_image: Floats) -> None:
        """Give an image a pose (4, 4) of its own: the rig's, relative to its unit's, at the image's timestamp.

        From now on it stays as it is; rows of a rolling shutter still move about it.
        """
        self._own[image], self._unit_from_image[image] = True, unit_from_image

    def forget_image_poses(self, images: Ints) -> None:
        """Let images stand where their unit's motion says again."""
        self._own[images] = False
        self._unit_from_image[images] = np.eye(4)

    @property
    def own_poses(self) -> tuple[Bools, Floats]:
        """Images (i,) with a pose of their own, and the poses (i, 4, 4) as `set_image_pose` takes them."""
        return self._own, self._unit_from_image

    @property
    def needed(self) -> bool:
        """An image is apart from its unit."""
        return bool(self._own.any()) or not self.bands.simultaneous

    def renew(self, state: State, registered: Bools, units: Ints | None = None) -> float:
        """Compute `unit_from_band` anew from the registered units' poses; also says how far it moved, in metres.

        Parameters
        ----------
        units
            Only of these units and their neighbours, whose motion depends on them.
        """
        if state.simultaneous:
            return 0.0
        motion = self._motion(state, registered)
        chosen = np.flatnonzero(registered) if units is None else _with_neighbours(units, registered)
        return self._apply(state, motion, self._bands_of(chosen))

    def _motion(self, state: State, registered: Bools) -> LocalMotion:
        motion = local_motion(state.world_from_rig, self._time_s, registered)
        motion.velocity[~motion.known] = self._prior_velocity[~motion.known]
        gap = np.where(motion.known, 0.0, np.inf)  # nothing bounds a prior's motion but the images' own times
        motion.earliest_s[:] -= gap
        motion.latest_s[:] += gap
        return motion

    def in_adjustment(self, state: State, registered: Bools, free_units: Bools) -> RowBandMotion | None:
        """Motion of row bands with the free units while these are adjusted; images with poses of their own stay."""
        if state.simultaneous:
            return None
        rows = self._bands_of(_with_neighbours(np.flatnonzero(free_units & registered), registered))
        motion = self._motion(state, registered)
        moving = rows[~self._own[self.bands.image[rows]]]
        held = RowBandMotion.held(self.bands.unit, self.bands.readout)
        held.support[moving] = motion.support[self.bands.unit[moving]]
        unit, offset_s = self.bands.unit[moving], self._offset_s(state, moving)
        held.weight[moving] = motion.weights(unit, offset_s)
        held.velocity[moving] = motion.velocity_at(unit, offset_s)

        def place_bands(after: State) -> State:
            after = replace(
                after, band_rotation=after.band_rotation.copy(), band_position_m=after.band_position_m.copy()
            )
            self._apply(after, self._motion(after, registered), rows)
            return after

        return replace(held, place_bands=place_bands)

    def predict(self, state: State, registered: Bools, unit: int) -> None:
        """Set `unit_from_band` of a unit that has no pose yet: it moves as its registered neighbours do."""
        if state.simultaneous:
            return
        velocity = self._prior_velocity[unit]
        known = np.flatnonzero(registered)
        nearest = known[np.argsort(np.abs(self._time_s[known] - self._time_s[unit]), kind="stable")[:2]]
        if len(nearest) == 2:
            pair = np.sort(nearest)
            around = local_motion(state.world_from_rig_of(pair), self._time_s[pair], np.ones(2, dtype=np.bool_))
            if around.known.all():
                velocity = around.velocity[0]
        rows = self._bands_of(np.array([unit]))
        at_band = moved(self._offset_s(state, rows)[:, None] * velocity)
        self._write(state, rows, at_band, moved(self._offset_of_image_s(state, rows)[:, None] * velocity))

    def expected_pose(self, state: State, registered: Bools, unit: int) -> Floats | None:
        """Predict the pose (4, 4) of a unit from the two registered units nearest in time; None where these are far."""
        nearest = self._nearest_two(registered, unit)
        if len(nearest) < 2:
            return None
        pair = np.sort(nearest)
        around = local_motion(state.world_from_rig_of(pair), self._time_s[pair], np.ones(2, dtype=np.bool_))
        near = int(np.argmin(np.abs(self._time_s[pair] - self._time_s[unit])))
        elapsed_s = self._time_s[unit] - self._time_s[pair[near]]
        if not around.known.all() or abs(elapsed_s) > MAX_GAP_S:
            return None
        result: Floats = state.world_from_rig_of(pair)[near] @ moved(elapsed_s * around.velocity[near : near + 1])[0]
        return result

    def expected_sigma_m(self, registered: Bools, unit: int) -> float:
        """Standard deviation of each axis of that pose's position, by accelerations of which the hardest is two sigmas.

        A line through two places of a path is off by half the acceleration times the product of the times to both.
        """
        to_both_s = self._time_s[self._nearest_two(registered, unit)] - self._time_s[unit]
        return 0.5 * ACCELERATION_SIGMA_MPS2 * float(np.abs(to_both_s).prod())

    def _nearest_two(self, registered: Bools, unit: int) -> Ints:
        """The two other registered units that are nearest in time; fewer where there are fewer."""
        known = np.flatnonzero(registered)
        known = known[known != unit]
        result: Ints = known[np.argsort(np.abs(self._time_s[known] - self._time_s[unit]), kind="stable")[:2]]
        return result

    def left_out(self, state: State, registered: Bools) -> tuple[Floats, Floats]:
        """Velocities (images, 6) of the images' units, and how far a parabola leaves the rig from where images are.

        Both are rotation (rad) and translation (m), a second, in the unit's axes; of images of units that are not
        registered, or at the ends of the drive, the second is zero.
        """
        motion, rows = self._motion(state, registered), self.bands.middle_of_image
        unit, t = self.bands.unit[rows], self._offset_s(state, rows)[:, None]
        a, b = np.nan_to_num(motion.support_s[unit]).T[:, :, None]
        jerk = third_differences(state.world_from_rig, self._time_s, motion)
        return motion.velocity[unit], t * (t - a) * (t - b) * jerk[unit]

    def velocity_mps(self, state: State, registered: Bools) -> Floats:
        """Velocities (u, 3) of the rig's origin at the units, in the world's axes; zero where not known."""
        velocity = self._motion(state, registered).velocity[:, 3:]
        result: Floats = (state.unit_rotation @ velocity[:, :, None])[..., 0]
        return result

    def unit_from_image(self, state: State) -> Floats:
        """The rig's poses (images, 4, 4) at the images' own timestamps, relative to their units'."""
        if state.simultaneous:
            return np.tile(np.eye(4), (len(self._own), 1, 1))
        return state.unit_from_band[self.bands.middle_of_image]

    def scale(self, state: State, factor: float, mean_camera_m: Floats) -> None:
        """Follow a scaling of units and points, and of the cameras about their mean place in the rig (3,).

        Shots keep their images: with the rig's origin moved by (factor - 1) mean, b becomes
        factor b + (factor - 1) (A - I) mean.
        """
        if state.simultaneous:
            return
        turned = state.band_rotation @ mean_camera_m - mean_camera_m
        state.band_position_m[:] = factor * state.band_position_m + (factor - 1.0) * turned
        own = np.flatnonzero(self._own)
        self._unit_from_image[own] = self.unit_from_image(state)[own]

    def largest(self, state: State, registered: Bools) -> LargestMotion:
        """Largest distance between an image and its unit."""
        rows = np.flatnonzero(registered[self.bands.unit])
        if state.simultaneous or not len(rows):
            return LargestMotion(translation_m=0.0, rotation_deg=0.0)
        return LargestMotion(
            translation_m=float(np.linalg.norm(state.band_position_m[rows], axis=1).max()),
            rotation_deg=float(se3.rotation_angle_deg(state.band_rotation[rows]).max()),
        )

    def not_compensated(self, state: State, registered: Bools) -> Ints:
        """Registered units whose row bands are apart in time although nothing says how the vehicle moved meanwhile.

        Their row bands stand where the unit does, as if all had been taken at once.
        """
        # Where an image has a pose of its own, only its rows are apart from it.
        own, every = self._own[self.bands.image], np.arange(len(self.bands))
        apart_s = self._offset_s(state, every) - np.where(own, self._offset_of_image_s(state, every), 0.0)
        unknown = ~local_motion(state.world_from_rig, self._time_s, registered).known & ~self._prior_known
        return np.intersect1d(self.bands.unit[np.abs(apart_s) > MAX_BAND_S], np.flatnonzero(registered & unknown))

    def _bands_of(self, units: Ints) -> Ints:
        first, last = self._band_range[units], self._band_range[units + 1]
        rows = [np.arange(lo, hi) for lo, hi in zip(first, last, strict=True)]
        return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)

    def _offset_s(self, state: State, rows: Ints) -> Floats:
        """Times (seconds) at which row bands were taken, from their units' timestamps on."""
        result: Floats = self.bands.time_offset_s[rows] + state.camera_time_offset_s[self.bands.camera[rows]]
        return result

    def _offset_of_image_s(self, state: State, rows: Ints) -> Floats:
        """The same of the images that row bands belong to."""
        return self._offset_s(state, self.bands.middle_of_image[self.bands.image[rows]])

    def _apply(self, state: State, motion: LocalMotion, rows: Ints) -> float:
        unit, before = self.bands.unit[rows], state.band_position_m[rows]
        at_band = motion.at(unit, self._offset_s(state, rows))
        at_image = motion.at(unit, self._offset_of_image_s(state, rows)) if self._own.any() else None
        self._write(state, rows, at_band, at_image)
        return float(np.linalg.norm(state.band_position_m[rows] - before, axis=1).max(initial=0.0))

    def _write(self, state: State, rows: Ints, at_band: Floats, at_image: Floats | None) -> None:
        own = self._own[self.bands.image[rows]]
        if at_image is not None and own.any():
            at_band = at_band.copy()
            own_pose = self._unit_from_image[self.bands.image[rows[own]]]
            at_band[own] = own_pose @ se3.inverse(at_image[own]) @ at_band[own]
        state.band_rotation[rows], state.band_position_m[rows] = at_band[:, :3, :3], at_band[:, :3, 3]


def finding(not_compensated: int, units: int) -> Finding:
    """Finding on units whose motion is unknown, by their number and that of all registered ones."""
    return warning(
        "motion-not-compensated",
        f"{not_compensated} of {units} registered units have no other one within {MAX_GAP_S:g} s: how the vehicle "
        "moved between the times of their images is not known, and these count as taken at once",
        "Give frames that are closer in time, or frames whose images were taken at once.",
    )


def _with_neighbours(units: Ints, registered: Bools) -> Ints:
    """Units, and the registered ones next to them."""
    known = np.flatnonzero(registered)
    if not len(known):
        return units
    before = known[np.maximum(np.searchsorted(known, units) - 1, 0)]
    after = known[np.minimum(np.searchsorted(known, units, side="right"), len(known) - 1)]
    return np.unique(np.concatenate([units, before, after]))
