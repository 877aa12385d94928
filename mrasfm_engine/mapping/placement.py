"""Moving the reconstruction to where the receiver, or rough poses, say that it is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import PositionPrior
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.calibration import scale_of_baselines, scale_with_baselines
from mrasfm_engine.mapping.georeferencing import GnssAlignment, align_with_gnss, assess_residuals, clock_offset
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Floats, Ints
from schemas.findings import Finding, warning

MIN_CLOCK_OFFSET_S = 0.05
CLOCK_OFFSET_SIGMAS = 5.0
MAX_SCALE_DISAGREEMENT = 0.05  # and as many sigmas of the rig's and the receiver's scale:
SCALE_DISAGREEMENT_SIGMAS = 3.0
MIN_ROUGH_POSES = 2
MIN_POSITIONS = 3
MOST_TIMES = 1000  # compared with one another
MIN_EXTENT_SIGMAS = 3.0  # of rough poses, to tell one camera's scale
SCALE_ROUNDS = 3  # of fitting one camera's arbitrary scale to the receiver


@dataclass(kw_only=True)
class Placement:
    """Fit of the reconstruction to the receiver's positions; without a prior it does not fit, for the reason given."""

    prior: PositionPrior | None = None
    reason: str = ""
    alignment: GnssAlignment | None = None
    units: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # that have a position
    measured_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) positions of these
    sigma_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3)
    inlier: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  # (n,)
    off_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) scene minus measured, as assessed last
    interval_us: float = 0.0  # of the receiver's samples
    noise_factor: float = 1.0  # by which residuals exceed their sigmas
    findings: list[Finding] = field(default_factory=list)  # what a user should look at


def place_by_gnss(mapper: Mapper, gnss: GnssTrack, antenna_in_rig_m: Floats) -> Placement:
    """Move the reconstruction into the receiver's frame, and make its positions a prior for the adjustment.

    The reconstruction keeps its scale, which comes from the rig; only that of a single camera is the receiver's.
    """
    settings, times = mapper.config.gnss, mapper.drive.timestamps_us
    measured, sigma = gnss.at(times, max_gap_us=round(settings.max_time_gap_s * 1e6))
    units = np.flatnonzero(mapper.registered & np.isfinite(measured[:, 0]))
    single = mapper.drive.has_single_camera
    if single and len(units) > 1:
        scale_with_baselines(mapper, _extent(measured[units]) / _extent(mapper.state.unit_position_m[units]))
    sigma_rig_scale = scale_of_baselines(mapper)[1]
    alignment = _align(mapper, units, antenna_in_rig_m, measured, sigma, sigma_rig_scale)
    for _ in range(SCALE_ROUNDS if single else 0):
        if isinstance(alignment, GnssAlignment):
            scale_with_baselines(mapper, alignment.scale)
            alignment = _align(mapper, units, antenna_in_rig_m, measured, sigma, sigma_rig_scale)
    if isinstance(alignment, str):
        return Placement(reason=alignment)
    _move(mapper, alignment.world_from_model)
    good = units[alignment.inlier]
    antenna_m = mapper.state.unit_position_m[units] + mapper.state.unit_rotation[units] @ antenna_in_rig_m
    placement = Placement(
        alignment=alignment,
        units=units,
        measured_m=measured[units],
        sigma_m=sigma[units],
        inlier=alignment.inlier,
        off_m=antenna_m - measured[units],
        interval_us=float(np.median(np.diff(gnss.timestamps_us[gnss.good]))) if gnss.good.sum() > 1 else 0.0,
        noise_factor=alignment.noise_factor,
    )
    if not single:
        inflation = receiver_errors(mapper, placement).factor
        found = _findings(mapper, alignment, measured[good], sigma[good], good, antenna_in_rig_m, inflation)
        placement = replace(placement, findings=found)
    return _with_prior(mapper, placement, np.asarray(antenna_in_rig_m))


def reassess_positions(mapper: Mapper, placement: Placement) -> Placement:
    """Judge all positions by where the adjustment has put their units.

    Those that were outliers of a bent trajectory come back, with the weight that they have by their sigmas.
    """
    assert placement.prior is not None
    units, arm_m = placement.units, placement.prior.lever_arm_m
    off_m = mapper.state.unit_position_m[units] + mapper.state.unit_rotation[units] @ arm_m - placement.measured_m
    outlier_sigmas = mapper.config.gnss.outlier_sigmas
    inlier, factor = assess_residuals(off_m, placement.sigma_m, placement.inlier, outlier_sigmas=outlier_sigmas)
    inlier &= mapper.registered[units]
    if inlier.sum() < MIN_POSITIONS:
        return placement
    return _with_prior(mapper, replace(placement, inlier=inlier, off_m=off_m, noise_factor=factor), arm_m)


def _with_prior(mapper: Mapper, placement: Placement, antenna_in_rig_m: Floats) -> Placement:
    """The placement with its positions that are no outliers as a term of the adjustment."""
    good = placement.inlier
    units = placement.units[good]
    prior = PositionPrior(
        unit=units,
        position_m=placement.measured_m[good],
        sigma_m=placement.sigma_m[good] * placement.noise_factor * receiver_errors(mapper, placement).factor,
        lever_arm_m=antenna_in_rig_m,
    )
    return replace(placement, prior=prior)


def _align(
    mapper: Mapper, units: Ints, antenna_in_rig_m: Floats, measured: Floats, sigma: Floats, sigma_rig_scale: float
) -> GnssAlignment | str:
    rotation = mapper.state.unit_rotation[units]
    return align_with_gnss(
        mapper.state.unit_position_m[units] + rotation @ antenna_in_rig_m,
        rotation[:, :, 2],
        rotation[:, :, 0],
        measured[units],
        sigma[units],
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
        sigma_rig_scale=sigma_rig_scale,
        may_bend=mapper.config.bundle_adjustment.reassessment,
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
    own = mapper.state.world_from_rig[units]
    rotation = robust_mean_rotation(rough[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2))
    _move(mapper, se3.transform(rotation, geometric_median(rough[:, :3, 3] - own[:, :3, 3] @ rotation.T)))
    return True


def _extent(position_m: Floats) -> float:
    """Median distance of positions from their median: a size that single wrong ones do not change."""
    return max(float(np.median(np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1))), 1e-9)


def _move(mapper: Mapper, world_from_model: Floats) -> None:
    state = mapper.state
    state.unit_rotation[:] = world_from_model[:3, :3] @ state.unit_rotation
    state.unit_position_m[:] = se3.apply(world_from_model, state.unit_position_m)
    state.points_m[:] = se3.apply(world_from_model, state.points_m)


@dataclass(frozen=True, kw_only=True)
class ReceiverErrors:
    """Errors of a receiver's positions, of which some scatter and some wander.

    Attributes
    ----------
    factor
        On the sigmas of positions: taken as independent, they then say no more of the trajectory's shape than they do.
    common
        Share of the declared sigmas that all positions have in common: it moves the scene, but does not bend it.
    """

    factor: float
    common: float


def receiver_errors(mapper: Mapper, placement: Placement) -> ReceiverErrors:
    """Tell white errors from wandering ones by how positions scatter about the scene from one to the next.

    The scatter q^2 of the declared variance is white, and averages out. The rest wanders as a Gauss-Markov process of
    `gnss.wander_time_s`, with correlations K = exp(-|t_i - t_j| / time) between samples. With times u from their mean a
    slope over n samples then has the variance of that over independent ones of

        q^2 + (1 - q^2) u' K u / u' u

    of theirs. Scatter that is not clearly less than declared is all of it. A receiver's filter holds the rest back for
    `gnss.correlation_time_s` at least, so that samples closer in time count once.
    """
    good = placement.inlier
    times_s = mapper.drive.timestamps_us[placement.units[good]] / 1e6
    if len(times_s) < MIN_POSITIONS:
        return ReceiverErrors(factor=1.0, common=1.0)
    # Positions between two samples are a blend of both.
    step_s = float(np.median(np.diff(times_s)))
    apart = max(1, round(placement.interval_us / 1e6 / step_s))
    whitened = placement.off_m[good] / (placement.sigma_m[good] * placement.noise_factor)
    steps = (whitened[apart:] - whitened[:-apart]).ravel() / np.sqrt(2.0)
    white = 0.0
    if len(steps):
        white = min(1.0, float((np.median(np.abs(steps)) / 0.6745) ** 2))
        # A variance from the median of n normal numbers is uncertain by 2.3 / sqrt(n) of itself; neighbouring steps
        # share a sample, which makes n half of them.
        if white > 1.0 - 2.0 * 2.3 / np.sqrt(0.5 * len(steps)):
            white = 1.0
    some = times_s[:: 1 + len(times_s) // MOST_TIMES]
    alike = np.exp(-np.abs(some[:, None] - some[None]) / mapper.config.gnss.wander_time_s)
    slope = some - some.mean()
    wander = float(slope @ alike @ slope / (slope @ slope)) * len(times_s) / len(some)
    wander = max(wander, mapper.config.gnss.correlation_time_s / step_s, 1.0)
    return ReceiverErrors(
        factor=float(np.sqrt(apart * white + wander * (1.0 - white))),
        common=float(np.sqrt((1.0 - white) * alike.mean())),
    )


def _findings(
    mapper: Mapper,
    alignment: GnssAlignment,
    measured_m: Floats,
    sigma_m: Floats,
    units: Ints,
    antenna_in_rig_m: Floats,
    inflation: float,
) -> list[Finding]:
    """A receiver's clock that is clearly off the images', and a rig whose scale the receiver contradicts."""
    findings = []
    antenna = mapper.state.unit_position_m[units] + mapper.state.unit_rotation[units] @ antenna_in_rig_m
    centre = antenna.mean(0)
    fitted = centre + alignment.scale * (antenna - centre)
    times = mapper.drive.timestamps_us[units]
    offset = clock_offset(fitted, measured_m, sigma_m * alignment.noise_factor, times)
    # Where the receiver's errors change slowly, its samples know less of the clock than independent ones would.
    if offset is not None and abs(offset[0]) > max(MIN_CLOCK_OFFSET_S, CLOCK_OFFSET_SIGMAS * inflation * offset[1]):
        direction = "ahead of" if offset[0] > 0 else "behind"
        findings.append(
            warning(
                "gnss-clock-offset",
                f"by the shape of the way, gnss.samples are {abs(offset[0]):.2f} s {direction} the images "
                f"(sigma {inflation * offset[1]:.2f} s)",
                "Check that both have the same clock and time scale (GPS is 18 s ahead of UTC).",
            )
        )
    _, sigma_rig = scale_of_baselines(mapper)
    sigma = float(np.hypot(sigma_rig, inflation * alignment.sigma_scale))
    if abs(alignment.scale - 1.0) > max(MAX_SCALE_DISAGREEMENT, SCALE_DISAGREEMENT_SIGMAS * sigma):
        findings.append(
            warning(
                "scale-disagreement",
                f"GNSS makes the way {alignment.scale:.3f} times as long as the rig does",
                "Check the baselines in rig.cameras (metres), and the receiver's positions.",
            )
        )
    return findings
