"""Moving the reconstruction to where the receiver says that it is."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.calibration import scale_of_baselines, scale_scene, scale_with_baselines
from mrasfm_engine.mapping.georeferencing import (
    BENDS,
    BENT,
    MOST,
    GnssAlignment,
    Refusal,
    align_with_gnss,
    assess_residuals,
    has_shape,
    similarity_motions,
)
from mrasfm_engine.mapping.lever_arm import LeverArm, lever_arm_findings
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.receiver_clock import ReceiverClock, clock_findings
from mrasfm_engine.mapping.receiver_findings import SCALE_DISAGREEMENT_SIGMAS, rig_scale_findings
from mrasfm_engine.mapping.receiver_fit import (
    MIN_POSITIONS,
    Placement,
    ReceiverErrors,
    antenna_places_m,
    clock_moves_m,
    lever_moves_m,
    most_likely_errors,
    receiver_errors,
    with_jumps,
    without_wrong_samples,
)
from mrasfm_engine.mapping.receiver_jumps import segment_of
from mrasfm_engine.types import Floats, Ints

KNOTS = 20  # in the correlation time of what wanders: less often than its filter lets a receiver change its mind
SCALE_ROUNDS = 3  # of fitting an arbitrary scale to the receiver
LONG_GAP = 3.0  # of a receiver's usual interval between samples
FOLLOWING_ROUNDS = 2  # of placing the scene by positions that follow it between samples, as it was placed before
# Sigma of the scale by images, relative, beyond which it does not bound their error, as the cost is no longer alike in
# the scale and in its inverse. Of a stereo pair it is a percent or less.
UNKNOWN_SIGMA_SCALE = 0.05


class _Known(NamedTuple):
    """Positions and sigmas (u, 3) of the receiver at the times of all units."""

    position_m: Floats
    sigma_m: Floats


def place_by_gnss(
    mapper: Mapper,
    gnss: GnssTrack,
    antenna_in_rig_m: Floats,
    *,
    sigma_scale: float = 0.0,
    rig_may_be_wrong: bool = False,
    thorough: bool = False,
    clock: ReceiverClock | None = None,
    lever: LeverArm | None = None,
) -> Placement:
    """Move the reconstruction into the receiver's frame, and make its positions a prior for the adjustment.

    The reconstruction keeps its scale, which comes from the rig; that of a single camera is the receiver's, and that of
    a scene whose images hardly compare it with the rig. See `reassess_positions` for `thorough`.

    Parameters
    ----------
    sigma_scale
        By how much the scale may be off beside what the baselines are, relative.
    rig_may_be_wrong
        Whether baselines may be wrong beyond what is known of them, by any factor: positions that have the scene's
        shape then give their scale to the scene and to the baselines, unless swapped ones would explain it.
    """
    known = _positions_m(mapper, gnss)
    units = np.flatnonzero(mapper.registered & np.isfinite(known.position_m[:, 0]))
    single = mapper.drive.has_single_camera
    sigma_rig_scale = float(np.hypot(scale_of_baselines(mapper)[1], sigma_scale))

    def align(to: _Known) -> GnssAlignment | Refusal:
        found = _align(mapper, units, antenna_in_rig_m, to, sigma_rig_scale)
        if rig_may_be_wrong and isinstance(found, GnssAlignment) and found.sigma_scale > UNKNOWN_SIGMA_SCALE:
            return Refusal(reason="the receiver's trajectory contradicts the rig's length, and hardly knows its own")
        return found

    if rig_may_be_wrong and _fits_swapped(mapper, units, gnss, antenna_in_rig_m, known, sigma_rig_scale):
        return Placement(
            reason="with latitude and longitude swapped the receiver's trajectory has the rig's length, as given not"
        )
    if len(units) > 1 and (single or rig_may_be_wrong or sigma_scale > UNKNOWN_SIGMA_SCALE):
        factor = _factor_on_extent(mapper, units, known)
        scale = scale_with_baselines if single or rig_may_be_wrong else scale_scene
        bound = np.inf if single or rig_may_be_wrong else sigma_rig_scale
        alignment = _with_receivers_scale(mapper, lambda: align(known), factor, scale, sigma_rig_scale=bound)
    else:
        alignment = align(known)
    if isinstance(alignment, Refusal):
        reason = alignment.reason + (_left_out(gnss) if len(units) < MIN_POSITIONS else "")
        return Placement(reason=reason, is_of_another_scale=alignment.is_of_scale, remedy=alignment.remedy)
    alignment, known = _moved(mapper, gnss, antenna_in_rig_m, alignment, known, align)
    placement = Placement(
        alignment=alignment,
        known_m=known.position_m,
        known_sigma_m=known.sigma_m,
        lever_arm_m=np.asarray(antenna_in_rig_m),
        units=units,
        inlier=alignment.inlier,
        off_m=antenna_places_m(mapper, units, antenna_in_rig_m) - known.position_m[units],
        interval_us=gnss.interval_us,
        noise_factor=alignment.noise_factor,
        track=gnss if mapper.config.bundle_adjustment.reassessment else None,
        clock=clock,
        lever=lever,
    )
    placement = with_prior(mapper, placement, thorough=thorough)
    if not single:
        placement = replace(placement, scale_of_rig=_scale_by_positions(mapper, placement))
    return placement


def _left_out(gnss: GnssTrack) -> str:
    """Words on the samples that take no part, as they are far from those around them; none where there are none."""
    wrong = int((~gnss.good).sum() - gnss.held.sum())
    if not wrong:
        return ""
    return f"; {wrong} of {len(gnss.good)} samples are left out, as they are far from those around them by their sigmas"


def _moved(
    mapper: Mapper,
    gnss: GnssTrack,
    antenna_in_rig_m: Floats,
    alignment: GnssAlignment,
    known: _Known,
    align: Callable[[_Known], GnssAlignment | Refusal],
) -> tuple[GnssAlignment, _Known]:
    """Move the scene by an alignment, and by those to positions that follow it between samples."""
    move(mapper, alignment.world_from_model)
    for _ in range(FOLLOWING_ROUNDS):
        following = _positions_m(mapper, gnss, antenna_in_rig_m)
        if np.array_equal(following.position_m, known.position_m, equal_nan=True):
            break  # the receiver has a position at every unit's time
        found = align(following)
        if isinstance(found, Refusal):
            break
        alignment, known = found, following
        move(mapper, alignment.world_from_model)
    return alignment, known


def _positions_m(mapper: Mapper, gnss: GnssTrack, antenna_in_rig_m: Floats | None = None) -> _Known:
    """Positions at the times of all units, see `GnssTrack.at`.

    With the lever arm they follow the scene between samples, which then lies where the receiver says, and samples that
    jump against it are left out. In a gap that is long for the receiver there are none: they would say what its ends
    say, as often as there are units, and by scattering about nothing look exact.
    """
    times_us, way_m = mapper.drive.timestamps_us, None
    max_gap_us = min(mapper.config.gnss.max_time_gap_s * 1e6, LONG_GAP * gnss.interval_us)
    if antenna_in_rig_m is not None:
        units = np.flatnonzero(mapper.registered)
        gnss = without_wrong_samples(mapper, gnss, units, antenna_in_rig_m)
        way_m = np.full((len(times_us), 3), np.nan)
        way_m[units] = antenna_places_m(mapper, units, antenna_in_rig_m)
    return _Known(*gnss.at(times_us, max_gap_us=round(max_gap_us), way_m=way_m))


def _with_receivers_scale(
    mapper: Mapper,
    align: Callable[[], GnssAlignment | Refusal],
    factor: float,
    scale: Callable[[Mapper, float], None],
    *,
    sigma_rig_scale: float,
) -> GnssAlignment | Refusal:
    """Scale the scene to the receiver, beginning with a factor, and align it; it stays as it is if that fails.

    A receiver that hardly knows how long its own trajectory is does not overrule what is known of the rig's scale:
    where both exclude one another, a scale between them would be neither.
    """
    begun = copy.deepcopy(mapper.state)
    scale(mapper, factor)
    alignment = align()
    for _ in range(SCALE_ROUNDS):
        if isinstance(alignment, GnssAlignment):
            scale(mapper, alignment.scale)
            factor, alignment = factor * alignment.scale, align()
    if isinstance(alignment, GnssAlignment) and alignment.sigma_scale > UNKNOWN_SIGMA_SCALE:
        known = float(np.hypot(sigma_rig_scale, factor * alignment.sigma_scale))  # of the rig's length
        if abs(factor - 1.0) > SCALE_DISAGREEMENT_SIGMAS * known:
            alignment = Refusal(
                reason=f"the receiver's trajectory is {factor:.3g} times as long as the rig's, and it hardly knows its "
                "own length",
                is_of_scale=True,
            )
    if isinstance(alignment, Refusal):
        scale(mapper, 1.0 / factor)  # also poses of single images, which are no part of the state,
        mapper.state = begun  # and without what that rounds
    return alignment


def reassess_positions(
    mapper: Mapper, placement: Placement, *, thorough: bool = False, clock_varies: bool = False
) -> Placement:
    """Judge the positions of all registered units by where the adjustment has put them.

    Those that were outliers of a bent trajectory come back, with the weight that they have by their sigmas. The sizes
    of their errors are those of `receiver_errors`, or, if `thorough`, of `most_likely_errors`.
    """
    before = placement
    if placement.track is not None:
        known = _positions_m(mapper, placement.track, placement.lever_arm_m)
        placement = replace(placement, known_m=known.position_m, known_sigma_m=known.sigma_m)
    units = np.flatnonzero(mapper.registered & np.isfinite(placement.known_m[:, 0]))
    off_m = antenna_places_m(mapper, units, placement.lever_arm_m) - placement.known_m[units]
    inlier, factor = assess_residuals(
        off_m,
        placement.known_sigma_m[units],
        ~np.isin(units, placement.units[~placement.inlier]),
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
    )
    if inlier.sum() < MIN_POSITIONS:
        return before
    placement = replace(placement, units=units, inlier=inlier, off_m=off_m, noise_factor=factor)
    return with_prior(mapper, placement, thorough=thorough, clock_varies=clock_varies)


def positions_fit(mapper: Mapper, placement: Placement, world_from_model: Floats | None = None) -> bool:
    """True where measured positions have the shape of the registered units' trajectory, and lie where that does.

    Parameters
    ----------
    placement
        Has the positions.
    world_from_model
        (4, 4) moves the trajectory to where it is judged; by default it stays.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(placement.known_m[:, 0]))
    if not len(units):
        return False
    antenna_m = antenna_places_m(mapper, units, placement.lever_arm_m)
    if world_from_model is not None:
        antenna_m = se3.apply(world_from_model, antenna_m)
    inlier, factor = assess_residuals(
        antenna_m - placement.known_m[units],
        placement.known_sigma_m[units],
        np.ones(len(units), dtype=np.bool_),
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
    )
    return bool(inlier.mean() >= MOST and factor <= BENT)


def positions_of_units(mapper: Mapper, placement: Placement, units: Ints) -> ReceiverPositions:
    """The term of the positions of some units, but for those that were outliers as they were assessed last."""
    units = units[np.isfinite(placement.known_m[units, 0])]
    units = units[~np.isin(units, placement.units[~placement.inlier])]
    return positions_with_errors(mapper, placement, units, placement.errors)


def positions_with_errors(
    mapper: Mapper, placement: Placement, units: Ints, errors: ReceiverErrors
) -> ReceiverPositions:
    """Positions of some units with errors of a certain size."""
    sigma_m, settings = placement.known_sigma_m[units], mapper.config.gnss
    segment = segment_of(units, placement.jumps)
    return ReceiverPositions.from_samples(
        unit=units,
        time_s=mapper.drive.timestamps_us[units] / 1e6,
        position_m=placement.known_m[units] + placement.level_m[segment],
        white_m=sigma_m * errors.white * np.sqrt(errors.positions_a_sample),
        wander_m=sigma_m * errors.wander,
        lever_arm_m=placement.lever_arm_m,
        wander_time_s=settings.wander_time_s,
        least_spacing_s=max(settings.correlation_time_s, settings.wander_time_s / KNOTS),
        segment=segment,
        clock_m=clock_moves_m(mapper, placement, units),
        lever_m=lever_moves_m(mapper, placement, units),
    )


def with_prior(
    mapper: Mapper, placement: Placement, *, thorough: bool = False, clock_varies: bool = False
) -> Placement:
    """The placement with its positions that are no outliers as a term of the adjustment."""
    placement = with_jumps(mapper, placement)
    if thorough:
        placement = replace(placement, errors=most_likely_errors(mapper, placement, clock_varies=clock_varies))
    else:
        placement = replace(placement, errors=receiver_errors(mapper, placement))
    return replace(placement, prior=positions_of_units(mapper, placement, placement.units[placement.inlier]))


def _align(
    mapper: Mapper, units: Ints, antenna_in_rig_m: Floats, known: _Known, sigma_rig_scale: float
) -> GnssAlignment | Refusal:
    rotation = mapper.state.unit_rotation[units]
    return align_with_gnss(
        antenna_places_m(mapper, units, antenna_in_rig_m),
        rotation[:, :, 2],
        rotation[:, :, 0],
        known.position_m[units],
        known.sigma_m[units],
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
        sigma_rig_scale=sigma_rig_scale,
        may_bend=mapper.config.bundle_adjustment.reassessment,
        rng=np.random.default_rng(mapper.config.seed),
    )


def _fits_swapped(
    mapper: Mapper,
    units: Ints,
    gnss: GnssTrack,
    antenna_in_rig_m: Floats,
    known: _Known,
    sigma_rig_scale: float,
) -> bool:
    """True where positions with latitude and longitude swapped have the trajectory's shape at the rig's scale."""
    if gnss.swapped_from_local is None:
        return False
    return has_shape(
        antenna_places_m(mapper, units, antenna_in_rig_m),
        mapper.state.unit_rotation[units][:, :, 2],
        known.position_m[units] @ gnss.swapped_from_local.T,
        known.sigma_m[units],
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
        sigma_rig_scale=sigma_rig_scale,
        rng=np.random.default_rng(mapper.config.seed),
    )


def factor_by_gnss(mapper: Mapper, gnss: GnssTrack) -> float:
    """Factor, about, by which the scene has to grow for its units to be as far apart as the receiver says."""
    known = _positions_m(mapper, gnss)
    units = np.flatnonzero(mapper.registered & np.isfinite(known.position_m[:, 0]))
    return _factor_on_extent(mapper, units, known) if len(units) > 1 else 1.0


def _factor_on_extent(mapper: Mapper, units: Ints, known: _Known) -> float:
    return extent_m(known.position_m[units]) / extent_m(mapper.state.unit_position_m[units])


def extent_m(position_m: Floats) -> float:
    """Median distance of positions from their median: a size that single wrong ones do not change."""
    return max(float(np.median(np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1))), 1e-9)


def move(mapper: Mapper, world_from_model: Floats) -> None:
    """Move the whole scene by a rigid transform (4, 4)."""
    state = mapper.state
    state.unit_rotation[:] = world_from_model[:3, :3] @ state.unit_rotation
    state.unit_position_m[:] = se3.apply(world_from_model, state.unit_position_m)
    state.points_m[:] = se3.apply(world_from_model, state.points_m)


def _scale_by_positions(mapper: Mapper, placement: Placement) -> float:
    """Factor on the lengths of the rig as given by which the scene fits positions best.

    Where the receiver's error jumps, an alignment of all positions does not tell it: the term does. Baselines may have
    taken the receiver's scale already.
    """
    alignment = placement.alignment
    assert alignment is not None
    growth = _growth_by_term(mapper, placement) if len(placement.jumps) else alignment.scale - 1.0
    return (1.0 + growth) / scale_of_baselines(mapper)[0]


def compare_with_rig(mapper: Mapper, placement: Placement, doubted: LeverArm | None = None) -> Placement:
    """Say by the refined scene what positions make of the rig's lengths as given, and find where they contradict it.

    The receiver's clock or antenna, which would explain another length, is a finding of its own. While cameras were
    where they were given, the scene had another scale by whatever was wrong of them: a rotation or the times of their
    images as much as a baseline. An adjustment puts that where images show it.
    """
    if placement.prior is None:
        return placement
    of_antenna = [
        *lever_arm_findings(placement.lever, is_taken=True), *lever_arm_findings(doubted, is_taken=False)
    ]  # fmt: skip
    placement = replace(placement, findings=[*placement.findings, *clock_findings(placement.clock), *of_antenna])
    if mapper.drive.has_single_camera:
        return placement
    scale = (1.0 + _growth_by_term(mapper, placement)) / scale_of_baselines(mapper)[0]
    placement = replace(placement, scale_of_rig=float(scale))
    return replace(placement, findings=[*placement.findings, *rig_scale_findings(mapper, placement)])


def beside_a_bent_scene(positions: ReceiverPositions, antenna_m: Floats) -> ReceiverPositions:
    """The positions with errors that wander by as much as a scene with the antenna at some places (n, 3) may bend."""
    return replace(positions, wander_m=np.hypot(positions.wander_m, BENDS[0] * extent_m(antenna_m)))


def _growth_by_term(mapper: Mapper, placement: Placement) -> float:
    """Growth of the scene, relative, that makes it fit positions best by what is known of their errors."""
    positions = placement.prior
    assert positions is not None
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    return growth_by_positions(positions, antenna_m, positions.position_m - antenna_m)


def growth_by_positions(positions: ReceiverPositions, antenna_m: Floats, off_m: Floats) -> float:
    """Growth, relative, that explains most of what positions are off (n, 3) the antenna's places (n, 3)."""
    known = positions.information(np.concatenate([similarity_motions(antenna_m), off_m[:, :, None]], axis=2))
    return float(np.linalg.lstsq(known[:-1, :-1], known[:-1, -1], rcond=1e-12)[0][-1])
