"""Moving the reconstruction to where the receiver, or rough poses, say that it is."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import RotationPrior
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.calibration import scale_of_baselines, scale_scene, scale_with_baselines
from mrasfm_engine.mapping.georeferencing import (
    BENT,
    MOST,
    GnssAlignment,
    Refusal,
    align_with_gnss,
    assess_residuals,
    clock_offset,
    has_shape,
    rigid_motions,
    similarity_motions,
)
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.receiver_fit import (
    MIN_POSITIONS,
    Placement,
    ReceiverErrors,
    antenna_places_m,
    most_likely_errors,
    receiver_errors,
    with_jumps,
    without_wrong_samples,
)
from mrasfm_engine.mapping.receiver_jumps import AROUND, segment_of
from mrasfm_engine.types import Floats, Ints
from schemas.findings import Finding, error, warning

MIN_CLOCK_OFFSET_S = 0.05
CLOCK_OFFSET_SIGMAS = 5.0
MAX_SCALE_DISAGREEMENT = 0.05  # rigs are better known, whatever the default prior says; and as many of the receiver's
SCALE_DISAGREEMENT_SIGMAS = 3.0
MIN_ROUGH_POSES = 2
KNOTS = 20  # in the correlation time of what wanders: less often than its filter lets a receiver change its mind
MIN_EXTENT_SIGMAS = 3.0  # of rough poses, to tell one camera's scale
SCALE_ROUNDS = 3  # of fitting an arbitrary scale to the receiver
FOLLOWING_ROUNDS = 2  # of placing the scene by positions that follow it between samples, as it was placed before
# Sigma of the scale by images, relative, beyond which it does not bound their error, as the cost is no longer alike in
# the scale and in its inverse. Of a stereo pair it is a percent or less.
UNKNOWN_SIGMA_SCALE = 0.05


def place_by_gnss(
    mapper: Mapper,
    gnss: GnssTrack,
    antenna_in_rig_m: Floats,
    *,
    sigma_scale: float = 0.0,
    rig_may_be_wrong: bool = False,
    thorough: bool = False,
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
    measured, sigma = _positions_m(mapper, gnss)
    units = np.flatnonzero(mapper.registered & np.isfinite(measured[:, 0]))
    single = mapper.drive.has_single_camera
    sigma_rig_scale = float(np.hypot(scale_of_baselines(mapper)[1], sigma_scale))

    def align() -> GnssAlignment | Refusal:
        found = _align(mapper, units, antenna_in_rig_m, measured, sigma, sigma_rig_scale)
        if rig_may_be_wrong and isinstance(found, GnssAlignment) and found.sigma_scale > UNKNOWN_SIGMA_SCALE:
            return Refusal(reason="the receiver's trajectory contradicts the rig's length, and hardly knows its own")
        return found

    takes_scale = single or rig_may_be_wrong or sigma_scale > UNKNOWN_SIGMA_SCALE
    if rig_may_be_wrong and _fits_swapped(mapper, units, gnss, antenna_in_rig_m, measured, sigma, sigma_rig_scale):
        return Placement(
            reason="with latitude and longitude swapped the receiver's trajectory has the rig's length, as given not"
        )
    if takes_scale and len(units) > 1:
        factor = _extent(measured[units]) / _extent(mapper.state.unit_position_m[units])
        scale = scale_with_baselines if single or rig_may_be_wrong else scale_scene
        bound = np.inf if single or rig_may_be_wrong else sigma_rig_scale
        alignment = _with_receivers_scale(mapper, align, factor, scale, sigma_rig_scale=bound)
    else:
        alignment = align()
    if isinstance(alignment, Refusal):
        return Placement(reason=alignment.reason, is_of_another_scale=alignment.is_of_scale)
    move(mapper, alignment.world_from_model)
    for _ in range(FOLLOWING_ROUNDS):
        begun, (measured, sigma) = (measured, sigma), _positions_m(mapper, gnss, antenna_in_rig_m)
        if np.array_equal(measured, begun[0], equal_nan=True):
            break  # the receiver has a position at every unit's time
        following = align()
        if isinstance(following, Refusal):
            measured, sigma = begun
            break
        alignment = following
        move(mapper, alignment.world_from_model)
    placement = Placement(
        alignment=alignment,
        known_m=measured,
        known_sigma_m=sigma,
        lever_arm_m=np.asarray(antenna_in_rig_m),
        units=units,
        inlier=alignment.inlier,
        off_m=antenna_places_m(mapper, units, antenna_in_rig_m) - measured[units],
        interval_us=gnss.interval_us,
        noise_factor=alignment.noise_factor,
        track=gnss if mapper.config.bundle_adjustment.reassessment else None,
    )
    placement = _with_prior(mapper, placement, thorough=thorough)
    if not single:
        placement = replace(placement, scale_of_rig=_scale_by_positions(mapper, placement))
        placement.findings = _findings(mapper, placement)
    return placement


def _positions_m(mapper: Mapper, gnss: GnssTrack, antenna_in_rig_m: Floats | None = None) -> tuple[Floats, Floats]:
    """Positions and sigmas (u, 3) at the times of all units, see `GnssTrack.at`.

    With the lever arm they follow the scene between samples, which then lies where the receiver says, and samples that
    jump against it are left out.
    """
    times_us, way_m = mapper.drive.timestamps_us, None
    if antenna_in_rig_m is not None:
        units = np.flatnonzero(mapper.registered)
        gnss = without_wrong_samples(mapper, gnss, units, antenna_in_rig_m)
        way_m = np.full((len(times_us), 3), np.nan)
        way_m[units] = antenna_places_m(mapper, units, antenna_in_rig_m)
    return gnss.at(times_us, max_gap_us=round(mapper.config.gnss.max_time_gap_s * 1e6), way_m=way_m)


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
        measured, sigma = _positions_m(mapper, placement.track, placement.lever_arm_m)
        placement = replace(placement, known_m=measured, known_sigma_m=sigma)
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
    return _with_prior(mapper, placement, thorough=thorough, clock_varies=clock_varies)


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
    return _as_term(mapper, placement, units, placement.errors)


def _as_term(mapper: Mapper, placement: Placement, units: Ints, errors: ReceiverErrors) -> ReceiverPositions:
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
    )


def _with_prior(
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
    mapper: Mapper, units: Ints, antenna_in_rig_m: Floats, measured: Floats, sigma: Floats, sigma_rig_scale: float
) -> GnssAlignment | Refusal:
    rotation = mapper.state.unit_rotation[units]
    return align_with_gnss(
        antenna_places_m(mapper, units, antenna_in_rig_m),
        rotation[:, :, 2],
        rotation[:, :, 0],
        measured[units],
        sigma[units],
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
    measured: Floats,
    sigma: Floats,
    sigma_rig_scale: float,
) -> bool:
    """True where positions with latitude and longitude swapped have the trajectory's shape at the rig's scale."""
    if gnss.swapped_from_local is None:
        return False
    return has_shape(
        antenna_places_m(mapper, units, antenna_in_rig_m),
        mapper.state.unit_rotation[units][:, :, 2],
        measured[units] @ gnss.swapped_from_local.T,
        sigma[units],
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
        sigma_rig_scale=sigma_rig_scale,
        rng=np.random.default_rng(mapper.config.seed),
    )


def place_by_rough_poses(mapper: Mapper, rough_world_from_rig: Floats, sigma_translation_m: float) -> bool:
    """Move the reconstruction into the frame of the rough poses (units, 4, 4; NaN where unknown).

    The units' rotations determine by how much it turns, their positions where it comes to lie; a single camera gets its
    scale from them, too. Returns whether there were enough poses.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(rough_world_from_rig[:, 0, 3]))
    if len(units) < MIN_ROUGH_POSES:
        return False
    rough = rough_world_from_rig[units]
    if mapper.drive.has_single_camera:
        if _extent(rough[:, :3, 3]) < MIN_EXTENT_SIGMAS * sigma_translation_m:
            return False
        scale_with_baselines(mapper, _extent(rough[:, :3, 3]) / _extent(mapper.state.unit_position_m[units]))
    move(mapper, between_poses(rough, mapper.state.world_from_rig[units]))
    return True


def between_poses(a_from_rig: Floats, b_from_rig: Floats) -> Floats:
    """Transform a_from_b (4, 4) by which poses (n, 4, 4) of the same units agree: rotations determine its rotation."""
    rotation = robust_mean_rotation(a_from_rig[:, :3, :3] @ np.swapaxes(b_from_rig[:, :3, :3], 1, 2))
    return se3.transform(rotation, geometric_median(a_from_rig[:, :3, 3] - b_from_rig[:, :3, 3] @ rotation.T))


def compare_rough_poses(
    mapper: Mapper,
    rough_world_from_rig: Floats,
    sigma_translation_m: float,
    sigma_rotation_rad: float,
    *,
    scene_stands_there: bool = False,
) -> tuple[Placement, RotationPrior] | None:
    """Rough poses (units, 4, 4; NaN where unknown), moved to where the scene lies, as terms of the adjustment.

    As of a receiver's positions, what they do not scatter by from pose to pose is an error that wanders. None where
    there are too few. A scene that stands where they say is in their world already.
    """
    units = np.flatnonzero(mapper.registered & np.isfinite(rough_world_from_rig[:, 0, 3]))
    if len(units) < MIN_POSITIONS:
        return None
    own, rough = mapper.state.world_from_rig[units], rough_world_from_rig[units]
    scene_from_rough = np.eye(4) if scene_stands_there else between_poses(own, rough)
    known = scene_from_rough @ rough_world_from_rig
    off_m = own[:, :3, 3] - known[units, :3, 3]
    sigma_m = np.full((len(known), 3), sigma_translation_m)
    inlier, factor = assess_residuals(
        off_m, sigma_m[units], np.ones(len(units), dtype=np.bool_), outlier_sigmas=mapper.config.gnss.outlier_sigmas
    )
    if inlier.sum() < MIN_POSITIONS:
        return None
    placement = Placement(
        known_m=known[:, :3, 3], known_sigma_m=sigma_m, units=units, inlier=inlier, off_m=off_m, noise_factor=factor
    )
    turn_rad = se3.log_so3(own[:, :3, :3] @ np.swapaxes(rough[:, :3, :3], 1, 2) @ scene_from_rough[:3, :3].T)
    scatter = np.median(np.abs(np.diff(turn_rad, axis=0))) / (0.6745 * np.sqrt(2.0) * sigma_rotation_rad)
    white = float(np.clip(scatter**2, 0.0, 1.0))
    # What does not scatter is one error of all: together they weigh no more than one rotation.
    sigma_rad = sigma_rotation_rad * np.sqrt(white + (1.0 - white) * len(units))
    rotations = RotationPrior(unit=units, rotation=known[units, :3, :3], sigma_rad=np.full(len(units), sigma_rad))
    return _with_prior(mapper, placement), rotations


def _extent(position_m: Floats) -> float:
    """Median distance of positions from their median: a size that single wrong ones do not change."""
    return max(float(np.median(np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1))), 1e-9)


def move(mapper: Mapper, world_from_model: Floats) -> None:
    """Move the whole scene by a rigid transform (4, 4)."""
    state = mapper.state
    state.unit_rotation[:] = world_from_model[:3, :3] @ state.unit_rotation
    state.unit_position_m[:] = se3.apply(world_from_model, state.unit_position_m)
    state.points_m[:] = se3.apply(world_from_model, state.points_m)


def refusal_findings(placement: Placement) -> list[Finding]:
    """The finding that the receiver's positions take no part, and why.

    Where they contradict the rig's lengths alone, one of both is wrong, and the scene has the rig's: an error.
    """
    if placement.prior is not None or not placement.reason:
        return []
    what = f"positions of the receiver are not used, and the scene is not georeferenced: {placement.reason}"
    if placement.is_of_another_scale:
        remedy = (
            "Check the units of rig.cameras (metres) and of gnss.samples (degrees, metres): all lengths of the scene "
            "are those of the rig, and as wrong as it is."
        )
        return [error("gnss-contradicts-rig", what, remedy)]
    remedy = "Check gnss.samples: their clock, the order of latitude and longitude, and the stated sigmas."
    return [warning("gnss-not-used", what, remedy)]


def jump_findings(mapper: Mapper, placement: Placement) -> list[Finding]:
    """The finding that the receiver's error jumps, with where it does so most."""
    if not len(placement.jumps):
        return []
    good = np.flatnonzero(placement.inlier)
    at = np.searchsorted(placement.units[good], placement.jumps)
    off_m = placement.off_m[good]
    sizes_m = [_step_m(off_m, k) for k in at.tolist()]
    largest = int(np.argmax(sizes_m))
    times_us = mapper.drive.timestamps_us[placement.jumps]
    return [
        warning(
            "gnss-error-jumps",
            f"positions of the receiver jump by about {sizes_m[largest]:.1f} m at {times_us[largest]} us and stay there"
            + (f"; there are {len(times_us)} such places" if len(times_us) > 1 else ""),
            "Nothing needs to be done: errors before and after it are taken as independent. Receivers that lose their "
            "fix do this; where the scene lies is less certain.",
        )
    ]


def _step_m(off_m: Floats, k: int) -> float:
    """Distance between the residuals (n, 3) before sample k and those from it on."""
    before, after = off_m[max(0, k - AROUND) : k], off_m[k : k + AROUND]
    return float(np.linalg.norm(np.median(after, axis=0) - np.median(before, axis=0))) if 0 < k < len(off_m) else 0.0


def _scale_by_positions(mapper: Mapper, placement: Placement) -> float:
    """Factor on the lengths of the rig as given by which the scene fits positions best.

    Where the receiver's error jumps, an alignment of all positions does not tell it: the term does. Baselines may have
    taken the receiver's scale already.
    """
    alignment, positions = placement.alignment, placement.prior
    assert alignment is not None
    assert positions is not None
    if not len(placement.jumps):
        return alignment.scale / scale_of_baselines(mapper)[0]
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    off_m = (positions.position_m - antenna_m)[:, :, None]
    known = positions.information(np.concatenate([similarity_motions(antenna_m), off_m], axis=2))
    growth = np.linalg.lstsq(known[:-1, :-1], known[:-1, -1], rcond=1e-12)[0][-1]
    return float((1.0 + growth) / scale_of_baselines(mapper)[0])


def _findings(mapper: Mapper, placement: Placement) -> list[Finding]:
    """A receiver's clock that is clearly off the images', and a rig whose scale the receiver contradicts."""
    findings, positions = [], placement.prior
    assert positions is not None
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    centred_m = antenna_m - antenna_m.mean(0)
    scale = placement.scale_of_rig * scale_of_baselines(mapper)[0]
    offset = clock_offset(antenna_m.mean(0) + scale * centred_m, positions)
    if offset is not None and abs(offset[0]) > max(MIN_CLOCK_OFFSET_S, CLOCK_OFFSET_SIGMAS * offset[1]):
        direction = "ahead of" if offset[0] > 0 else "behind"
        findings.append(
            warning(
                "gnss-clock-offset",
                f"by the shape of the way, gnss.samples are {abs(offset[0]):.2f} s {direction} the images "
                f"(sigma {offset[1]:.2f} s)",
                "Check that both have the same clock and time scale (GPS is 18 s ahead of UTC).",
            )
        )
    _, sigma_rig = scale_of_baselines(mapper)
    known = positions.information_given(centred_m, rigid_motions(centred_m))
    sigma = 1.0 / np.sqrt(max(known, 1e-12))
    if abs(placement.scale_of_rig - 1.0) > max(MAX_SCALE_DISAGREEMENT, SCALE_DISAGREEMENT_SIGMAS * sigma):
        findings.append(
            warning(
                "scale-disagreement",
                f"GNSS makes the way {placement.scale_of_rig:.3g} times as long as the rig as given does, whose "
                f"baselines are taken to be known to {sigma_rig:.1%}",
                "Check the baselines in rig.cameras (metres), and the receiver's positions (are latitude and longitude "
                "swapped?). Declare sigma_translation_m of the cameras.",
            )
        )
    return findings
