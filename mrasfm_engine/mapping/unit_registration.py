"""Camera set registration: the pose of a rigid unit from the points that all of its cameras observe.

First refine the pose predicted by the motion model; if it does not explain the observations of every camera, run
generalised PnP over all cameras. If that fails, or a camera disagrees with it, register every camera alone, turn its
pose into one of the unit through `rig_from_cam`, and average these poses robustly (MRASfM, section 3(a), see
`per_camera_pnp`); cameras far from the average are voted out by name. All images of the unit get their pose from the
unit, also those with too few points to be registered alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pycolmap

from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project_points
from mrasfm_engine.geometry.colmap_cameras import SolverCameras
from mrasfm_engine.mapping.inlier_gates import gates_px, observation_gate_px, robust_sigma, widest_gates_px
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.per_camera_pnp import (
    Expectation,
    Vote,
    agree,
    calibration_covariance,
    largest_agreement,
)
from mrasfm_engine.mapping.resection import pose_information, resect
from mrasfm_engine.matching.simultaneous import INDEPENDENT_MATCHES, MIN_SIGMA_PX, calibration_sigmas
from mrasfm_engine.types import Bools, Floats, Ints

MAX_CORRESPONDENCES = 1500  # more do not make a pose better, only slower
MIN_PNP_POINTS = 3  # that determine a pose; COLMAP's solver does not survive none
MIN_CAMERA_MATCHES = 30  # of a camera before its disagreement, or its vote, counts
MIN_CAMERA_INLIER_RATIO = 0.25
PREDICTION_RAD = 0.05  # by which images turn from where constant velocity predicts them, on bends and bumps
MIN_EXPECTED_INLIER_RATIO = 0.5  # with more, no pose elsewhere can have more points on its side
NO_INFORMATION = 1e-9  # of all directions together: what a direction has that no point tells
VOTE_BEATS_JOINT = 0.9  # of the joint pose's inliers: what the vote loses on a wrong camera it may lose


@dataclass(frozen=True, kw_only=True)
class Registration:
    """Registration of a unit, or the reason for its failure."""

    unit: int
    world_from_rig: Floats | None
    correspondences: int
    inliers: int
    method: str  # "joint", "vote" or "none"
    voted_out: tuple[str, ...] = ()  # cameras with a well supported pose of their own that is another one
    unclear: tuple[str, ...] = ()  # cameras that see enough points, but no pose fits these: they had no vote
    reason: str = ""
    # Where images are registered one by one: poses of cameras that are apart from the unit's, and cameras without any.
    own_poses: dict[int, Floats] = field(default_factory=dict)
    missing: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Correspondences2D3D:
    """Image points of a unit and the scene's points they show."""

    xy_px: Floats  # (n, 2)
    points_m: Floats  # (n, 3)
    camera: Ints  # (n,)
    band: Ints  # (n,)

    def select(self, rows: Ints) -> Correspondences2D3D:
        """Select some of them."""
        return Correspondences2D3D(
            xy_px=self.xy_px[rows], points_m=self.points_m[rows], camera=self.camera[rows], band=self.band[rows]
        )


@dataclass(frozen=True, kw_only=True)
class CameraViews:
    """Views of a generalised camera: the rig's cameras, or, where these are not simultaneous, cameras at row bands."""

    index: Ints  # (n,) which of them each image point is seen by
    rig_from_view: Floats  # (e, 4, 4)
    camera: Ints  # (e,)

    @staticmethod
    def from_keypoints(mapper: Mapper, camera: Ints, band: Ints) -> CameraViews:
        """The eyes of image points of given cameras (n,) and row bands (n,)."""
        if mapper.state.simultaneous:
            return CameraViews(
                index=camera, rig_from_view=mapper.state.rig_from_cam, camera=np.arange(len(mapper.camera_kind))
            )
        bands, index = np.unique(band, return_inverse=True)
        camera_of_band = mapper.motion.bands.camera[bands]
        return CameraViews(
            index=index.astype(np.int64),
            rig_from_view=mapper.state.unit_from_band[bands] @ mapper.state.rig_from_cam[camera_of_band],
            camera=camera_of_band,
        )


def register_unit(mapper: Mapper, unit: int) -> Registration:
    """Find the pose of a unit from the points of its tracks."""
    expected = mapper.motion.expected_pose(mapper.state, mapper.registered, unit)
    sigma_m = None if expected is None else mapper.motion.expected_sigma_m(mapper.registered, unit)
    return register_from_correspondences(
        mapper,
        unit,
        correspondences_of_unit(mapper, unit),
        min_inliers=mapper.config.mapping.min_pnp_inliers,
        expected=expected,
        expected_sigma_m=sigma_m,
    )


def register_from_correspondences(
    mapper: Mapper,
    unit: int,
    matched: Correspondences2D3D,
    *,
    min_inliers: int,
    by_vote: bool = True,
    expected: Floats | None = None,
    expected_sigma_m: float | None = None,
) -> Registration:
    """Find the pose of a unit from given correspondences.

    Parameters
    ----------
    by_vote
        Also by the cameras' own poses.
    expected
        Where the unit (4, 4) is by the motion of others, if they tell.
    expected_sigma_m
        Standard deviation of each axis of that place; with it, the motion decides between cameras without a majority.
    """
    if len(matched.camera) < min_inliers:
        return failed(unit, matched, 0, f"it sees {len(matched.camera)} points of the scene, {min_inliers} are needed")
    sample = matched.select(even_choice(len(matched.camera), MAX_CORRESPONDENCES))
    fit = _joint_fit(mapper, matched, sample, expected)
    method, votes = "joint", list[Vote]()
    required = mapper.config.mapping.min_pnp_inlier_ratio
    if by_vote and (fit.inlier.mean() < required or _disagreeing(mapper, matched, fit.inlier)):
        votes = camera_votes(mapper, sample)
        average = largest_agreement(votes, _expectation(expected, expected_sigma_m))
        by_votes = _Fit.to(mapper, None if average is None else average.world_from_rig, matched)
        if average is not None and (average.by_motion or by_votes.holds_against(fit, matched.camera)):
            fit, method = by_votes, "vote"
    count = int(fit.inlier.sum())
    if fit.world_from_rig is None or count < min_inliers or count < required * len(fit.inlier):
        needed = max(min_inliers, math.ceil(required * len(fit.inlier)))
        reason = f"only {count} of {len(fit.inlier)} points agree with one pose, {needed} are needed"
        return failed(unit, matched, count, reason)
    return Registration(
        unit=unit,
        world_from_rig=fit.world_from_rig,
        correspondences=len(fit.inlier),
        inliers=count,
        method=method,
        voted_out=_others(mapper, votes, fit.world_from_rig),
        unclear=tuple(n for n in _disagreeing(mapper, matched, fit.inlier) if n not in _names(mapper, votes)),
    )


def _expectation(expected: Floats | None, sigma_m: float | None) -> Expectation | None:
    if expected is None or sigma_m is None:
        return None
    return Expectation(
        world_from_rig=expected, covariance=np.diag(np.repeat([PREDICTION_RAD, sigma_m], 3).astype(np.float64) ** 2)
    )


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """A pose of the unit, and how correspondences fit it."""

    world_from_rig: Floats | None
    errors_px: Floats  # (n,)
    gates_px: Floats  # (cameras,)
    inlier: Bools  # (n,)

    @staticmethod
    def to(mapper: Mapper, world_from_rig: Floats | None, matched: Correspondences2D3D) -> _Fit:
        if world_from_rig is None:
            errors_px = np.full(len(matched.camera), np.inf)
        else:
            errors_px = _errors_px(mapper, world_from_rig, matched)
        gates = gates_px(mapper, errors_px, matched.camera)
        return _Fit(
            world_from_rig=world_from_rig,
            errors_px=errors_px,
            gates_px=gates,
            inlier=errors_px < gates[matched.camera],
        )

    def holds_against(self, together: _Fit, camera: Ints) -> bool:
        """The pose of a vote has as many inliers as the joint one by the narrower gates: a compromise has wide ones."""
        gates = np.minimum(self.gates_px, together.gates_px)[camera]
        own, other = (np.count_nonzero(fit.errors_px < gates) for fit in (self, together))
        return bool(own >= other * VOTE_BEATS_JOINT)


def _joint_fit(
    mapper: Mapper, matched: Correspondences2D3D, sample: Correspondences2D3D, expected: Floats | None
) -> _Fit:
    """The pose near an expected one; where there is none, or points or a camera disagree with it, by a search."""
    if expected is not None:
        fit = _Fit.to(mapper, _as_expected(mapper, sample, expected), matched)
        if fit.inlier.mean() >= MIN_EXPECTED_INLIER_RATIO and not _disagreeing(mapper, matched, fit.inlier):
            return fit
    return _Fit.to(mapper, _joint_pose(mapper, sample), matched)


def inliers_of(mapper: Mapper, world_from_rig: Floats, matched: Correspondences2D3D) -> Ints:
    """Correspondences that agree with a pose (4, 4) of the unit."""
    return np.flatnonzero(_Fit.to(mapper, world_from_rig, matched).inlier)


def failed(unit: int, matched: Correspondences2D3D, inliers: int, reason: str) -> Registration:
    """A unit without a pose, and why."""
    return Registration(
        unit=unit,
        world_from_rig=None,
        correspondences=len(matched.camera),
        inliers=inliers,
        method="none",
        reason=reason,
    )


def correspondences_of_unit(mapper: Mapper, unit: int) -> Correspondences2D3D:
    """Keypoints of a unit whose tracks have a point, and these points."""
    rows = mapper.rows_of_unit[unit]
    tracks = mapper.tracks.of_keypoint.take(rows)
    known = np.flatnonzero(mapper.triangulated.take(tracks))
    rows, tracks = rows.take(known), tracks.take(known)
    return Correspondences2D3D(
        xy_px=mapper.keypoints.xy_px.take(rows, axis=0),
        points_m=mapper.state.points_m.take(tracks, axis=0),
        camera=mapper.keypoints.camera.take(rows),
        band=mapper.keypoints.band.take(rows),
    )


def cameras_of(mapper: Mapper) -> SolverCameras:
    """The cameras with their current intrinsics, for COLMAP's solvers."""
    return SolverCameras.from_cameras(mapper.drive.cameras, mapper.camera_kind, mapper.state.camera_params)


def rigid3d(a_from_b: Floats) -> pycolmap.Rigid3d:
    """A transform as pycolmap takes it."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(a_from_b[:3, :3]), a_from_b[:3, 3])


def matrix_of(pose: pycolmap.Rigid3d) -> Floats:
    """A transform of pycolmap's as a matrix."""
    return se3.transform(pose.rotation.matrix(), pose.translation)


def _ransac(mapper: Mapper, max_error_px: float) -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()
    options.max_error = max_error_px
    options.min_num_trials, options.max_num_trials = 50, 10000
    options.min_inlier_ratio = mapper.config.mapping.min_pnp_inlier_ratio  # no longer search for less
    options.random_seed = mapper.config.seed
    return options


def _joint_pose(mapper: Mapper, matched: Correspondences2D3D) -> Floats | None:
    """world_from_rig by one generalised PnP over all cameras."""
    views, cameras = CameraViews.from_keypoints(mapper, matched.camera, matched.band), cameras_of(mapper)
    xy_px, usable = cameras.pixels(matched.camera, matched.xy_px)
    if usable.sum() < MIN_PNP_POINTS:
        return None
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        xy_px[usable],
        matched.points_m[usable],
        [int(i) for i in views.index[usable]],
        [rigid3d(m) for m in se3.inverse(views.rig_from_view)],
        [cameras.cameras[c] for c in views.camera],
        estimation_options=_ransac(mapper, float(widest_gates_px(mapper)[matched.camera].mean())),
    )
    return None if result is None else se3.inverse(matrix_of(result["rig_from_world"]))


def _as_expected(mapper: Mapper, matched: Correspondences2D3D, expected: Floats) -> Floats | None:
    """world_from_rig near an expected pose."""
    views = CameraViews.from_keypoints(mapper, matched.camera, matched.band)
    predicted_px = PREDICTION_RAD * float(mapper.state.camera_params[:, :2].mean())
    widest_px, noise_px = float(widest_gates_px(mapper)[matched.camera].mean()), observation_gate_px(mapper)
    return resect(
        expected,
        matched.xy_px,
        matched.points_m,
        views.index,
        views.rig_from_view,
        mapper.camera_kind[views.camera],
        mapper.state.camera_params[views.camera],
        sigmas_px=(predicted_px, widest_px, noise_px / 2.0),
    )


def _errors_px(mapper: Mapper, world_from_rig: Floats, matched: Correspondences2D3D) -> Floats:
    """Reprojection errors (n,) under a pose of the unit; infinite where a camera shows nothing."""
    views = CameraViews.from_keypoints(mapper, matched.camera, matched.band)
    eye_from_world = se3.inverse(world_from_rig @ views.rig_from_view)
    errors = np.full(len(matched.camera), np.inf)
    for c, (kind, params) in enumerate(zip(mapper.camera_kind, mapper.state.camera_params, strict=True)):
        rows = np.flatnonzero(matched.camera == c)
        if mapper.state.simultaneous:
            points = se3.apply(eye_from_world[c], matched.points_m[rows])
        else:
            points = se3.apply(eye_from_world[views.index[rows]], matched.points_m[rows, None])[:, 0]
        errors[rows] = np.linalg.norm(project_points(int(kind), params, points) - matched.xy_px[rows], axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def _disagreeing(mapper: Mapper, matched: Correspondences2D3D, inlier: Bools) -> tuple[str, ...]:
    """Cameras that see enough points but whose points don't fit the joint pose."""
    return tuple(
        camera.name
        for c, camera in enumerate(mapper.drive.cameras)
        if (matched.camera == c).sum() >= MIN_CAMERA_MATCHES
        and inlier[matched.camera == c].mean() < MIN_CAMERA_INLIER_RATIO
    )


def _rig_from_cameras(mapper: Mapper, matched: Correspondences2D3D) -> Floats:
    """The cameras (c, 4, 4) in the middle of their images, which one PnP over all rows finds."""
    result = mapper.state.rig_from_cam
    if not mapper.state.simultaneous:
        bands = mapper.motion.bands
        middle = np.unique(bands.middle_of_image[bands.image[matched.band]])
        result[bands.camera[middle]] = mapper.state.unit_from_band[middle] @ result[bands.camera[middle]]
    return result


def _names(mapper: Mapper, votes: list[Vote]) -> list[str]:
    return [mapper.drive.cameras[vote.camera].name for vote in votes]


def _others(mapper: Mapper, votes: list[Vote], pose: Floats) -> tuple[str, ...]:
    """Names of the cameras that voted for another pose."""
    if not votes:
        return ()
    same = agree(votes, pose)
    return tuple(name for name, agrees in zip(_names(mapper, votes), same, strict=True) if not agrees)


def camera_votes(mapper: Mapper, matched: Correspondences2D3D) -> list[Vote]:
    """Poses of the unit, each from one camera's own PnP, of the cameras for which that succeeds."""
    votes = []
    rig_from_view = _rig_from_cameras(mapper, matched)
    gates_px, options = widest_gates_px(mapper), pycolmap.AbsolutePoseEstimationOptions()
    cameras = cameras_of(mapper)
    xy_px, usable = cameras.pixels(matched.camera, matched.xy_px)
    for c, camera in enumerate(cameras.cameras):
        rows = np.flatnonzero((matched.camera == c) & usable)
        if len(rows) < MIN_CAMERA_MATCHES:
            continue
        options.ransac = _ransac(mapper, float(gates_px[c]))
        result = pycolmap.estimate_and_refine_absolute_pose(
            xy_px[rows], matched.points_m[rows], camera, estimation_options=options
        )
        if result is None or result["num_inliers"] < MIN_CAMERA_INLIER_RATIO * len(rows):
            continue
        world_from_rig = se3.inverse(matrix_of(result["cam_from_world"])) @ se3.inverse(rig_from_view[c])
        votes.append(_vote(mapper, c, world_from_rig, matched.select(rows[result["inlier_mask"]])))
    return votes


def _vote(mapper: Mapper, camera: int, world_from_rig: Floats, seen: Correspondences2D3D) -> Vote:
    """The vote of a camera for a pose that fits what it has seen."""
    sigma_rotation_rad, sigma_translation_m = calibration_sigmas(mapper.drive, mapper.config.bundle_adjustment)
    return Vote(
        camera=camera,
        world_from_rig=world_from_rig,
        inliers=len(seen.camera),
        pnp_covariance=pose_covariance(mapper, world_from_rig, seen),
        calibration_covariance=calibration_covariance(
            world_from_rig,
            mapper.state.camera_position_m[camera],
            sigma_rotation_rad=float(sigma_rotation_rad[camera]),
            sigma_translation_m=float(sigma_translation_m[camera]),
        ),
    )


def pose_covariance(mapper: Mapper, world_from_rig: Floats, seen: Correspondences2D3D) -> Floats:
    """Covariance (6, 6) of a unit's pose by its inliers, of steps [omega, tau] in world axes.

    Errors are as large as each camera's residuals say. Lens models and points err alike all over an image, so one image
    says no more than `INDEPENDENT_MATCHES` independent observations, however many it has.
    """
    views = CameraViews.from_keypoints(mapper, seen.camera, seen.band)
    errors_px = _errors_px(mapper, world_from_rig, seen)
    information = np.zeros((6, 6))
    for c in np.unique(seen.camera):
        rows = np.flatnonzero((seen.camera == c) & np.isfinite(errors_px))
        if not len(rows):
            continue
        own = pose_information(
            world_from_rig,
            seen.xy_px[rows],
            seen.points_m[rows],
            views.index[rows],
            views.rig_from_view,
            mapper.camera_kind[views.camera],
            mapper.state.camera_params[views.camera],
        )
        variance_px2 = max(MIN_SIGMA_PX, robust_sigma(errors_px[rows])) ** 2
        information += own * min(1.0, INDEPENDENT_MATCHES / len(rows)) / variance_px2
    # Without points that tell a direction, it is as uncertain as this leaves it.
    weakest = NO_INFORMATION * np.trace(information) + np.finfo(np.float64).tiny
    result: Floats = np.linalg.inv(information + weakest * np.eye(6))
    return result
