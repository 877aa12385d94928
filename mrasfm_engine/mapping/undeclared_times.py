"""Cameras whose images were taken at another time than those that the manifest says were taken with them.

Where all images of a frame have one timestamp, cameras have no time offsets in the adjustment. One that is late comes
out as mounted elsewhere along the way, or hardly fits, and bends the trajectory. Where one does, one Gauss-Newton step
from the adjusted scene, in which offsets vary beside everything else, says which would leave zero [a score test: Rao,
Mathematical Proceedings of the Cambridge Philosophical Society 1948]. Where one would by more than clocks err, a copy
of the scene is adjusted with the offsets, and says how late the camera is, and how certain that is: its residuals no
longer have what the offset makes of them.

The scene itself stays as it is: that a clock may be off the manifest has to say.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import MAX_UNKNOWNS_FOR_COVARIANCE, covariances
from mrasfm_engine.bundle_adjustment.priors import ReadoutPrior, Term, TimePrior
from mrasfm_engine.bundle_adjustment.problem import TIME, UNIT_DOF
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions
from mrasfm_engine.mapping.calibration import calibration_prior, has_few_units
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.time_offsets import (
    BEYOND_PRIOR_SIGMAS,
    SIGMA_READOUT_S,
    assess_times,
    interpolation_error_s,
    times_can_be_told,
    undeclared_readouts,
)
from mrasfm_engine.mapping.vehicle_speed import speeds_mps
from mrasfm_engine.types import Bools, Cancel, Floats
from schemas.findings import Finding, warning

# Least signs of a late camera: half of the way by which it seems to be displaced, two sigmas of its place's prior, or
# half of the share of keypoints that fits of the others.
PART, HELD = 0.5, 2.0


def undeclared_time_findings(
    mapper: Mapper, *, free_units: Bools, terms: Sequence[Term], options: SolverOptions, cancel: Cancel | None = None
) -> list[Finding]:
    """Cameras that are late or early although the manifest says that all images of a frame are taken at once.

    Parameters
    ----------
    free_units, terms, options
        Of an adjustment with all cameras free; the offsets' prior is added.
    """
    usual_s = mapper.config.bundle_adjustment.sigma_time_offset_us / 1e6
    if len(mapper.camera_kind) == 2:
        usual_s /= np.sqrt(2.0)  # of half of what both are apart
    if not (_is_open(mapper) and _may_be_late(mapper, BEYOND_PRIOR_SIGMAS * usual_s)):
        return []
    scene = _LateImages.from_adjusted(mapper, free_units, terms, options)
    first_s = scene.first_step_s()
    if first_s is None or not _is_beyond(first_s, np.full(len(first_s), usual_s)).any():
        return []
    found = scene.adjusted(cancel)
    if found is None:
        return []
    offset_s, sigma_s = found
    is_late, off_s = _is_beyond(offset_s, np.maximum(sigma_s, usual_s)), _among_others(offset_s)
    names = [camera.name for camera in mapper.drive.cameras]
    if len(names) == 2:
        return [_pair_finding(names, float(np.ptp(offset_s)), 2.0 * float(sigma_s[0]))] if is_late.any() else []
    late: Sequence[int] = np.flatnonzero(is_late).tolist()
    return [_finding(names[c], float(off_s[c]), float(sigma_s[c]), interval_s=_interval_s(mapper)) for c in late]


def _is_open(mapper: Mapper) -> bool:
    """True where nothing lets offsets vary, although settings and drive would allow to tell them."""
    return (
        times_can_be_told(mapper)
        and mapper.config.mapping.motion_compensation
        and mapper.state.simultaneous
        and not has_few_units(mapper)
    )


def _may_be_late(mapper: Mapper, least_s: float) -> bool:
    """True where a camera has moved along the way as a late one would, by part of that or until its prior held it; or
    where its observations do not fit the others' poses.

    It takes next to no time, and spares most drives the rest.
    """
    rigs = mapper.state.world_from_rig[mapper.registered]
    step_m = np.einsum("nji,nj->ni", rigs[:-1, :3, :3], np.diff(rigs[:, :3, 3], axis=0))
    way = step_m.sum(0) / max(float(np.linalg.norm(step_m.sum(0))), 1e-9)
    prior = calibration_prior(mapper)
    along_m = np.abs(_among_others(prior.corrections(mapper.state)[:, 3:] @ way))
    least_m = np.minimum(PART * np.median(speeds_mps(mapper)) * least_s, HELD * prior.sigma_translation_m)
    share = _share_that_fits(mapper)
    return bool((along_m > least_m).any() or (share < PART * np.median(share)).any())


def _share_that_fits(mapper: Mapper) -> Floats:
    """Share (c,) of each camera's keypoints on tracks that observe a point; one of those without any."""
    cameras = len(mapper.camera_kind)
    tracked = (mapper.tracks.of_keypoint >= 0) & mapper.registered[mapper.keypoints.unit]
    seen, fits = (
        np.bincount(mapper.keypoints.camera[which], minlength=cameras) for which in (tracked, mapper.is_inlier)
    )
    return np.where(seen > 0, fits / np.maximum(seen, 1), 1.0)


def _interval_s(mapper: Mapper) -> float:
    """Time between units, as a rule."""
    return float(np.median(np.diff(mapper.drive.timestamps_us[mapper.registered]))) / 1e6


def _among_others(offset: Floats) -> Floats:
    """Offsets (c,) from that of most cameras; of two each is half of what they are apart."""
    result: Floats = offset - np.median(offset)
    return result


def _is_beyond(offset_s: Floats, sigma_s: Floats) -> Bools:
    return np.asarray(np.abs(_among_others(offset_s)) > BEYOND_PRIOR_SIGMAS * sigma_s)


@dataclass(frozen=True, kw_only=True)
class _LateImages:
    """A copy of an adjusted scene in which the cameras' times may vary."""

    mapper: Mapper
    free_units: Bools
    terms: Sequence[Term]
    options: SolverOptions
    prior: TimePrior

    @staticmethod
    def from_adjusted(mapper: Mapper, free_units: Bools, terms: Sequence[Term], options: SolverOptions) -> _LateImages:
        """Images may be late by about the time between units, more would be those of other ones."""
        own = copy.copy(mapper)
        own.state = replace(mapper.state, points_m=mapper.state.points_m.copy())
        own.place_bands()
        cameras = len(mapper.camera_kind)
        prior = TimePrior(
            sigma_s=np.full(cameras, _interval_s(mapper)),
            held=np.zeros(cameras, dtype=np.bool_),
            gauge_weights=np.ones(cameras),
        )
        return _LateImages(mapper=own, free_units=free_units, terms=[*terms, prior], options=options, prior=prior)

    @property
    def _every(self) -> Bools:
        return np.ones(len(self.mapper.camera_kind), dtype=np.bool_)

    def _problem(self, *, with_readouts: bool) -> Problem:
        more = [ReadoutPrior(sigma_s=SIGMA_READOUT_S)] if with_readouts else []
        return self.mapper.problem(
            self.free_units,
            free_cameras=self._every,
            free_times=self._every,
            free_readouts=undeclared_readouts(self.mapper) & with_readouts,
            terms=[*self.terms, *more],
            options=self.options,
        )[0]

    def first_step_s(self) -> Floats | None:
        """Offsets (c,) after one step from zero; None where not everything is determined."""
        problem = self._problem(with_readouts=False)
        step = problem.step(problem.state, problem.normal_equations(problem.state, 0.0), 0.0)
        if step is None or not np.isfinite(step).all():
            return None
        of_cameras = step[UNIT_DOF * problem.layout.num_units :].reshape(-1, problem.layout.camera_dof)
        result: Floats = of_cameras[:, TIME]
        return result

    def adjusted(self, cancel: Cancel | None) -> tuple[Floats, Floats] | None:
        """Offsets (c,) that the drive wants, and their standard deviations; None where these are not known."""
        adjust_poses(
            self.mapper,
            self.free_units,
            free_cameras=self._every,
            free_times=self._every,
            terms=self.terms,
            options=self.options,
            an_image=self.mapper.config.mapping.pose_observations,
            cancel=cancel,
        )
        problem, offset_s = self._problem(with_readouts=True), self.mapper.state.camera_time_offset_s
        if problem.layout.size > MAX_UNKNOWNS_FOR_COVARIANCE:
            return None
        certainty = covariances(problem, problem.state)
        found = assess_times(self.prior, certainty, interpolation_error_s(self.mapper), offset_s)
        return None if found is None else (offset_s, found.sigma_s)


def _finding(name: str, late_s: float, sigma_s: float, *, interval_s: float) -> Finding:
    frames = round(abs(late_s) / interval_s)
    where = f"{frames} frame{'s' if frames > 1 else ''} {'later' if late_s > 0 else 'earlier'}"
    elsewhere = f" It may be that they belong {where}." if frames else ""
    return warning(
        "time-offset-undeclared",
        f"images of camera {name} were taken {1e3 * late_s:+.1f} ms from those of the other cameras (sigma "
        f"{1e3 * sigma_s:.1f} ms), and have the same timestamps: the scene is bent by it",
        "Declare sigma_time_offset_us of the camera, and its offset is estimated with the scene; or give its images "
        f"their own timestamp_us.{elsewhere}",
    )


def _pair_finding(names: Sequence[str], apart_s: float, sigma_s: float) -> Finding:
    return warning(
        "time-offset-undeclared",
        f"images of cameras {names[0]} and {names[1]} were taken {1e3 * apart_s:.1f} ms apart (sigma "
        f"{1e3 * sigma_s:.1f} ms), and have the same timestamps: the scene is bent by it",
        "Declare sigma_time_offset_us of both cameras, and their offsets are estimated with the scene; or give images "
        "their own timestamp_us.",
    )
