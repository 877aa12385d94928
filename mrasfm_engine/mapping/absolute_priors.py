"""Priors of the units' absolute poses in every adjustment: positions of a receiver, rough poses and gravity.

They stand in local and global adjustments from the first units on that show how they lie to the scene, and are judged
again by the scene after every global adjustment: each position against those that are near in time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import RotationPrior, Term, UprightPrior
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.calibration import scale_of_baselines, scale_with_baselines
from mrasfm_engine.mapping.clock_leap import ClockLeap, find_clock_leap
from mrasfm_engine.mapping.georeferencing import SIGMA_PITCH_RAD, SIGMA_ROLL_RAD
from mrasfm_engine.mapping.lever_arm import LeverArm
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import (
    factor_by_gnss,
    place_by_gnss,
    positions_of_units,
    reassess_positions,
)
from mrasfm_engine.mapping.receiver_clock import ReceiverClock
from mrasfm_engine.mapping.receiver_faults import find_clock, find_lever_arm, with_length
from mrasfm_engine.mapping.receiver_fit import Placement, ReceiverErrors
from mrasfm_engine.mapping.rough_placement import compare_rough_poses, place_by_rough_poses, shape_fault
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.types import Bools, Floats, Ints

RECEIVER_ROUNDS = 4  # of finding the receiver's clock and antenna, as positions show them along tangents of the way
LOCAL_POSITIONS = 40  # measured positions, nearest to the units of a local adjustment, that take part in it


@dataclass(kw_only=True)
class AbsolutePriors:
    """Knowledge of the units' poses in the world, and its fit to the scene.

    Attributes
    ----------
    gnss, antenna_in_rig_m
        The receiver's track in the local frame and the lever arm (3,), or None.
    sigma_antenna_m
        Standard deviation of the lever arm as it was given, along each axis; 0 where it is taken to be exact.
    rough_world_from_rig
        Rough poses (units, 4, 4) in their own world, NaN where unknown, or None.
    placement
        Fit of the receiver's positions, once it was asked for.
    rough
        Fit of the rough poses' positions.
    rough_rotations
        Their rotations as a term.
    rough_fault
        Why rough poses take no part in the finished scene; empty where they do.
    """

    gnss: GnssTrack | None = None
    antenna_in_rig_m: Floats | None = None
    sigma_antenna_m: float = 0.0
    rough_world_from_rig: Floats | None = None
    placement: Placement | None = None
    rough: Placement | None = None
    rough_rotations: RotationPrior | None = None
    rough_fault: str = ""
    placed_by_rough_poses: bool = False
    clock: ReceiverClock | None = None  # the receiver's, at which the track has its times; None where it is right
    lever: LeverArm | None = None  # where the lever arm is estimated: by how much it is another one than was given
    doubted_lever: LeverArm | None = None  # where it is not: what it more probably is
    clock_was_let_go: bool = False  # after positions had its times
    clock_leap: ClockLeap | None = None  # of that clock, behind or before which positions take no part
    clock_varies: bool = False  # whether the adjustment varies when all images were taken

    @staticmethod
    def from_trajectory(known: PriorTrajectory) -> AbsolutePriors:
        """Absolute poses that the manifest knows; nothing is compared with them yet."""
        return AbsolutePriors(
            gnss=known.gnss,
            antenna_in_rig_m=known.antenna_in_rig_m,
            sigma_antenna_m=known.sigma_antenna_m,
            rough_world_from_rig=known.rough_world_from_rig,
        )

    @property
    def positions(self) -> ReceiverPositions | None:
        """The receiver's positions as a term, where they fit the scene."""
        return None if self.placement is None else self.placement.prior

    @property
    def errors(self) -> list[ReceiverErrors]:
        """Sizes of the errors of positions and of rough poses that take part."""
        return [fit.errors for fit in (self.placement, self.rough) if fit is not None and fit.prior is not None]

    @property
    def hold_the_frame(self) -> bool:
        """True where they say how the scene lies, so that no unit has to be held."""
        return self.positions is not None or self.rough is not None

    @property
    def positions_are_refused(self) -> bool:
        """True where the receiver's positions take no part, for the reason that the placement has."""
        return self.placement is not None and self.placement.prior is None

    def place(self, mapper: Mapper, *, sigma_scale: float = 0.0, rig_may_be_wrong: bool = False) -> None:
        """Move the scene to where positions, or else rough poses, say that it is; both become terms.

        What they say of its scale is compared with the rig as given: positions may have changed it while it grew.
        `sigma_scale`, relative, is what the images leave open of it. See `place_by_gnss` for `rig_may_be_wrong`.
        """
        settings = mapper.config.bundle_adjustment
        self.placed_by_rough_poses, self.doubted_lever = False, None
        if settings.priors and settings.reassessment and not mapper.drive.has_single_camera:
            scale_with_baselines(mapper, scale_of_baselines(mapper)[0])
        self._place_by_gnss(mapper, sigma_scale=sigma_scale, rig_may_be_wrong=rig_may_be_wrong)
        self._place_by_rough_poses(mapper)
        self._renew_rough(mapper)

    def _place_by_gnss(self, mapper: Mapper, *, sigma_scale: float = 0.0, rig_may_be_wrong: bool = False) -> None:
        """Move the scene to where positions say, by the clock and the antenna that they show once it is there."""
        if self.gnss is None or self.antenna_in_rig_m is None:
            return
        rounds = RECEIVER_ROUNDS
        while rounds:
            self.placement = place_by_gnss(
                mapper,
                self.gnss,
                self.antenna_in_rig_m,
                sigma_scale=sigma_scale,
                rig_may_be_wrong=rig_may_be_wrong,
                thorough=True,
                clock=self.clock,
                lever=self.lever,
            )
            leap = self.clock_leap
            if not self._set_receiver(mapper):
                break
            rounds = rounds - 1 if self.clock_leap is leap else RECEIVER_ROUNDS

    def _place_by_rough_poses(self, mapper: Mapper) -> None:
        """Move the scene to where rough poses say, if positions do not and if they have its shape."""
        sigma = mapper.drive.manifest.rough_poses
        if self.rough_world_from_rig is None or sigma is None:
            return
        self.rough_fault = ""
        if mapper.config.bundle_adjustment.reassessment:
            self.rough_fault = shape_fault(mapper, self.rough_world_from_rig, sigma.sigma_translation_m)
        if self.positions is None and not self.rough_fault:
            self.placed_by_rough_poses = place_by_rough_poses(
                mapper, self.rough_world_from_rig, sigma.sigma_translation_m
            )

    def factor_by_positions(self, mapper: Mapper) -> float:
        """Factor, about, by which the scene has to grow to be as long as the receiver says; 1 without a receiver."""
        return 1.0 if self.gnss is None else factor_by_gnss(mapper, self.gnss)

    def doubt_the_rig(self, mapper: Mapper) -> None:
        """Take the scale of positions that contradict nothing but the rig's baselines, where these may vary."""
        settings, refused = mapper.config.bundle_adjustment, self.placement
        may_vary = (
            settings.refine_calibration
            and settings.camera_set_adjustment
            and settings.priors
            and settings.reassessment
            and not mapper.drive.has_single_camera
        )
        if refused is None or not refused.is_of_another_scale or not may_vary:
            return
        self.place(mapper, rig_may_be_wrong=True)
        if self.positions_are_refused:
            self.placement = refused

    def renew(self, mapper: Mapper) -> None:
        """Judge them by the scene as it is now, and place the scene if that is not done yet.

        Positions that contradict a scene take no part in it until it has grown, be it their fault or the calibration's.
        """
        settings = mapper.config.bundle_adjustment
        if not (settings.priors and settings.reassessment):
            return
        if self.positions is not None:
            self.reassess(mapper, thorough=False)
        elif self.gnss is not None and self.antenna_in_rig_m is not None:
            self.placement = place_by_gnss(mapper, self.gnss, self.antenna_in_rig_m, clock=self.clock, lever=self.lever)
        if self.placement is not None and self.placement.is_contradicted:
            self.placement = None
        self._renew_rough(mapper)
        if self.rough is not None and self.rough.is_contradicted:
            self.rough = self.rough_rotations = None

    def reassess(self, mapper: Mapper, *, thorough: bool = True) -> None:
        """Judge positions and rough poses by the adjusted scene."""
        if self.placement is not None and self.placement.prior is not None:
            self.placement = reassess_positions(
                mapper, self.placement, thorough=thorough, clock_varies=self.clock_varies
            )
            if thorough and self._set_receiver(mapper):
                self._place_by_gnss(mapper)
        if self.rough is not None:
            self._renew_rough(mapper)

    def _set_receiver(self, mapper: Mapper) -> bool:
        """Give samples the times that positions show, and the antenna the place; whether these are others than before.

        Where the manifest does not leave the antenna's place open, that it is more probably another is noted.
        """
        if self.placement is None or self.placement.prior is None or self.gnss is None:
            return False
        clock = None if self.clock_varies or self.clock_was_let_go else find_clock(mapper, self.placement)
        clock = clock if clock is not None and clock.is_wrong else None
        lever = find_lever_arm(mapper, self.placement, sigma_given_m=self.sigma_antenna_m, times_vary=self.clock_varies)
        is_other = False if self.clock_varies else self._take_clock(clock)
        if self.sigma_antenna_m > 0.0:
            is_other |= self._take_lever_arm(lever)
        elif lever is not None and lever.is_wrong and clock is None:  # a clock that is off looks much the same
            self.doubted_lever = with_length(mapper, self.placement, lever)
        return is_other or (clock is not None and self._leave_a_side_of_a_leap(mapper))

    def _take_clock(self, found: ReceiverClock | None) -> bool:
        """Give samples the times of a clock, None for that of the images; whether these are others than before."""
        assert self.gnss is not None
        assert self.placement is not None
        before = self.clock
        if found is before or (found is not None and before is not None and found.is_as(before)):
            return False
        # Positions that show a clock until they have its times do not show one: a place of the antenna looks alike.
        self.clock_was_let_go |= before is not None and found is None
        offset_s, before_s = (0.0 if clock is None else clock.offset_s for clock in (found, before))
        self.gnss, self.clock = self.gnss.later_by(offset_s - before_s), found
        self.placement = replace(self.placement, track=self.gnss, clock=found)
        return True

    def _take_lever_arm(self, found: LeverArm | None) -> bool:
        """Put the antenna where positions show it, None for where it was given; whether it is elsewhere than before."""
        assert self.antenna_in_rig_m is not None
        assert self.placement is not None
        before = self.lever
        if found is before or (found is not None and before is not None and found.is_as(before)):
            return False
        offset_m, before_m = (np.zeros(3) if lever is None else lever.offset_m for lever in (found, before))
        self.antenna_in_rig_m, self.lever = self.antenna_in_rig_m + offset_m - before_m, found
        self.placement = replace(self.placement, lever_arm_m=self.antenna_in_rig_m, lever=found)
        return True

    def _leave_a_side_of_a_leap(self, mapper: Mapper) -> bool:
        """Do without the positions on one side of a leap of the clock, where one offset does not explain all of them.

        The other side's clock may be right: it is judged anew.
        """
        assert self.gnss is not None
        assert self.placement is not None
        if self.clock_leap is not None:
            return False
        self.clock_leap = find_clock_leap(mapper, self.placement)
        if self.clock_leap is None:
            return False
        used = self.clock_leap.used(self.gnss)
        self.gnss, self.clock = used.later_by(0.0 if self.clock is None else -self.clock.offset_s), None
        self.placement = replace(self.placement, track=self.gnss, clock=None)
        return True

    def _renew_rough(self, mapper: Mapper) -> None:
        self.rough, self.rough_rotations = None, None
        sigma = mapper.drive.manifest.rough_poses
        has_priors = mapper.config.bundle_adjustment.priors
        if self.rough_world_from_rig is None or sigma is None or self.rough_fault or not has_priors:
            return
        found = compare_rough_poses(
            mapper,
            self.rough_world_from_rig,
            sigma.sigma_translation_m,
            np.radians(sigma.sigma_rotation_deg),
            scene_stands_there=self.placed_by_rough_poses,
        )
        if found is not None:
            self.rough, self.rough_rotations = found

    def terms(self, mapper: Mapper) -> list[Term]:
        """All of them as terms of an adjustment of all units."""
        return self._terms_of(mapper, np.flatnonzero(mapper.registered), mapper.registered)

    def local_terms(self, mapper: Mapper, free_units: Bools) -> list[Term]:
        """Terms of an adjustment of some units (u,): their own, and positions near them that show the errors there."""
        free = np.flatnonzero(free_units & mapper.registered)
        return self._terms_of(mapper, _nearest(np.flatnonzero(mapper.registered), free), free_units)

    def _terms_of(self, mapper: Mapper, units: Ints, free_units: Bools) -> list[Term]:
        """Terms of the positions of some registered units (n,), and of the attitude of free ones (u,)."""
        terms: list[Term] = [
            positions_of_units(mapper, placement, units)
            for placement in (self.placement, self.rough)
            if placement is not None and placement.prior is not None
        ]
        if self.positions is not None:
            terms.append(upright_prior(mapper, free_units))
        turns = self.rough_rotations
        if turns is not None:
            rows = np.flatnonzero((free_units & mapper.registered)[turns.unit])
            terms.append(
                replace(turns, unit=turns.unit[rows], rotation=turns.rotation[rows], sigma_rad=turns.sigma_rad[rows])
            )
        return terms


def upright_prior(mapper: Mapper, units: Bools) -> UprightPrior:
    """Gravity as a term on some of the registered units (u,), with the weight that they have among all."""
    chosen = np.flatnonzero(units & mapper.registered)
    share = np.sqrt(mapper.registered.sum() / max(len(chosen), 1))
    return UprightPrior(
        unit=chosen, sigma_roll_rad=float(SIGMA_ROLL_RAD * share), sigma_pitch_rad=float(SIGMA_PITCH_RAD * share)
    )


def _nearest(units: Ints, free: Ints) -> Ints:
    """Units, ascending, at most `LOCAL_POSITIONS` besides the free ones, that are nearest to one of these in time."""
    after = np.searchsorted(free, units)
    before, behind = free[np.maximum(after - 1, 0)], free[np.minimum(after, len(free) - 1)]
    apart = np.minimum(np.abs(units - before), np.abs(units - behind))
    return np.sort(units[np.argsort(apart, kind="stable")[: len(free) + LOCAL_POSITIONS]])
