"""A receiver's clock and antenna, as the positions of a placement show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.mapping.calibration import scale_of_baselines
from mrasfm_engine.mapping.georeferencing import assess_residuals
from mrasfm_engine.mapping.lever_arm import LeverArm, lever_arm, ways_of_antenna
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import (
    beside_a_bent_scene,
    growth_by_positions,
    positions_with_errors,
    with_prior,
)
from mrasfm_engine.mapping.receiver_clock import MIN_POSITIONS_FOR_CLOCK, ReceiverClock, clock_offset
from mrasfm_engine.mapping.receiver_fit import Placement, antenna_places_m, most_likely_errors
from mrasfm_engine.types import Floats


def find_clock(mapper: Mapper, placement: Placement) -> ReceiverClock | None:
    """The receiver's clock, as positions with a prior show it; None where nothing tells it, or it is taken to be right.

    What a clock does must not pass for an error that wanders: sizes of errors are those that are most likely if it may
    be off. They take a while, and of a clock that is right no error at all that wanders would make a wrong one.
    """
    positions = placement.prior
    assert positions is not None
    if not mapper.config.bundle_adjustment.reassessment:
        return None
    if placement.clock is not None:
        found = _clock_offset(mapper, positions)
        return None if found is None else replace(found, offset_s=placement.clock.offset_s + found.offset_s)
    found = _clock_offset(mapper, replace(positions, wander_m=np.zeros_like(positions.wander_m)))
    if found is None or not found.is_wrong:
        return None
    unknown = ReceiverClock(offset_s=0.0, sigma_s=np.inf)
    positions = with_prior(mapper, replace(placement, clock=unknown), thorough=True).prior
    assert positions is not None
    return _clock_offset(mapper, positions)


def find_lever_arm(mapper: Mapper, placement: Placement, *, sigma_given_m: float, times_vary: bool) -> LeverArm | None:
    """The antenna's place, as positions with a prior show it; None where these are too few.

    What a wrong one does is among what the sizes of errors were told from: where positions say rather that it is
    wrong, these are those of what it leaves.

    Parameters
    ----------
    sigma_given_m
        Of the place that was given, along each axis; 0 if that is exact unless it is wrong.
    times_vary
        Whether all images may have been taken earlier or later.
    """
    if not mapper.config.bundle_adjustment.reassessment or placement.inlier.sum() < MIN_POSITIONS_FOR_CLOCK:
        return None
    units = placement.units
    antenna_m = antenna_places_m(mapper, units, placement.lever_arm_m)
    time_s = mapper.drive.timestamps_us[units] / 1e6
    ways = ways_of_antenna(antenna_m, mapper.state.unit_rotation[units], time_s, times_vary=times_vary)
    of_rig, sigma_rig = scale_of_baselines(mapper)

    def found(judged: Placement, off_m: Floats) -> tuple[LeverArm, Floats]:
        rows = np.flatnonzero(judged.inlier)
        positions = positions_with_errors(mapper, judged, units[rows], judged.errors)
        return lever_arm(
            off_m[rows],
            ways[rows],
            beside_a_bent_scene(positions, antenna_m),
            assumed_m=np.zeros(3) if placement.lever is None else placement.lever.offset_m,
            sigma_given_m=sigma_given_m,
            factor=1.0 / of_rig,
            sigma_factor=np.inf if mapper.drive.has_single_camera else sigma_rig,
        )

    off_m = -placement.residuals_m
    result, sizes = found(placement, off_m)
    is_known = placement.lever is not None and placement.lever.is_wrong
    if is_known or not result.may_be_wrong:
        return result
    left_m = ways @ sizes - off_m
    inlier, factor = assess_residuals(
        left_m, placement.known_sigma_m[units], placement.inlier, outlier_sigmas=mapper.config.gnss.outlier_sigmas
    )
    if inlier.sum() < MIN_POSITIONS_FOR_CLOCK:
        return result
    judged = replace(placement, lever=LeverArm.unknown(), off_m=left_m, inlier=inlier, noise_factor=factor)
    judged = replace(judged, errors=most_likely_errors(mapper, judged, clock_varies=times_vary))
    return found(judged, off_m)[0]


def with_length(mapper: Mapper, placement: Placement, lever: LeverArm) -> LeverArm:
    """The lever arm with what it makes of the length of a scene that lies as positions say."""
    positions = placement.prior
    assert positions is not None
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    moved_m = mapper.state.unit_rotation[positions.unit] @ lever.offset_m
    return replace(lever, longer=growth_by_positions(positions, antenna_m, -moved_m))


def _clock_offset(mapper: Mapper, positions: ReceiverPositions) -> ReceiverClock | None:
    """The clock's offset by positions that stand beside a scene which may bend."""
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    of_rig, sigma_rig = scale_of_baselines(mapper)
    return clock_offset(
        antenna_m,
        beside_a_bent_scene(positions, antenna_m),
        factor=1.0 / of_rig,
        sigma_factor=np.inf if mapper.drive.has_single_camera else sigma_rig,
    )
