"""Camera set registration: the pose of a rigid unit from the points that all of its cameras observe.

First refine the pose predicted by the motion model; if it does not explain the observations of every camera, run
generalised PnP over all cameras. If that fails, or a camera disagrees with it, register every camera alone, turn its
pose into one of the unit through `rig_from_cam`, and average these poses robustly (MRASfM, section 3(a), see
`per_camera_pnp`); cameras far from the average are voted out by name. All images of the unit get their pose from the
unit, also those with too few points to be registered alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pycolmap

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import unpack_camera
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.per_camera_pnp import Vote, agree, largest_agreement
from mrasfm_engine.mapping.resection import resect
from mrasfm_engine.types import Bools, Floats, Ints

MAX_ERROR_PX = 8.0  # of an inlier; wider than elsewhere, as calibration may be off until it is refined
MAX_CORRESPONDENCES = 1500  # more do not make a pose better, only slower
MIN_CAMERA_MATCHES = 30  # of a camera before its disagreement, or its vote, counts
MIN_CAMERA_INLIER_RATIO = 0.25
MIN_EXPECTED_INLIER_RATIO = 0.5  # with more, no pose elsewhere can have more points on its side
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
    return register_from_correspondences(
        mapper,
        unit,
        correspondences_of_unit(mapper, unit),
        min_inliers=mapper.config.mapping.min_pnp_inliers,
        expected=expected,
    )


def register_from_correspondences(
    mapper: Mapper,
    unit: int,
    matched: Correspondences2D3D,
    *,
    min_inliers: int,
    by_vote: bool = True,
    expected: Floats | None = None,
) -> Registration:
    """Find the pose of a unit from given correspondences.

    Parameters
    ----------
    by_vote
        Also by the cameras' own poses.
    expected
        Where the unit (4, 4) is by the motion of others, if they tell.
    """
    if len(matched.camera) < min_inliers:
        return failed(unit, matched, 0, f"it sees {len(matched.camera)} points of the scene, {min_inliers} are needed")
    sample = matched.select(_spread(len(matched.camera), MAX_CORRESPONDENCES))
    pose = None if expected is None else _as_expected(mapper, sample, expected)
    inlier = np.zeros(len(matched.camera), dtype=np.bool_)
    if pose is not None:
        inlier = _errors_px(mapper, pose, matched) < MAX_ERROR_PX
        if inlier.mean() < MIN_EXPECTED_INLIER_RATIO or _disagreeing(mapper, matched, inlier):
            pose = None
    if pose is None:
        pose = _joint_pose(mapper, sample)
        inlier[:] = False
        if pose is not None:
            inlier = _errors_px(mapper, pose, matched) < MAX_ERROR_PX
    disagreeing = _disagreeing(mapper, matched, inlier)
    method = "joint"
    votes: list[Vote] = []
    if by_vote and (pose is None or disagreeing or inlier.mean() < mapper.config.mapping.min_pnp_inlier_ratio):
        votes = camera_votes(mapper, sample)
        average = largest_agreement(votes)
        if average is not None:
            agreeing = _errors_px(mapper, average.world_from_rig, matched) < MAX_ERROR_PX
            if agreeing.sum() >= inlier.sum() * VOTE_BEATS_JOINT:
                pose, inlier, method = average.world_from_rig, agreeing, "vote"
    count = int(inlier.sum())
    if pose is None or count < min_inliers or count < mapper.config.mapping.min_pnp_inlier_ratio * len(inlier):
        return failed(unit, matched, count, f"only {count} of {len(inlier)} points agree with one pose")
    return Registration(
        unit=unit,
        world_from_rig=pose,
        correspondences=len(inlier),
        inliers=count,
        method=method,
        voted_out=_others(mapper, votes, pose),
        unclear=tuple(n for n in _disagreeing(mapper, matched, inlier) if n not in _names(mapper, votes)),
    )


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
    tracks = mapper.tracks.of_keypoint[rows]
    known = mapper.triangulated[tracks]
    rows, tracks = rows[known], tracks[known]
    return Correspondences2D3D(
        xy_px=mapper.keypoints.xy_px[rows],
        points_m=mapper.state.points_m[tracks],
        camera=mapper.keypoints.camera[rows],
        band=mapper.keypoints.band[rows],
    )


def _spread(count: int, limit: int) -> Ints:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.int64))


def cameras_of(mapper: Mapper) -> list[pycolmap.Camera]:
    """The cameras with their current intrinsics, as pycolmap takes them."""
    return [
        pycolmap.Camera(model=c.model, width=c.width, height=c.height, params=unpack_camera(c.model, params))
        for c, params in zip(mapper.drive.cameras, mapper.state.camera_params, strict=True)
    ]


def rigid3d(a_from_b: Floats) -> pycolmap.Rigid3d:
    """A transform as pycolmap takes it."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(a_from_b[:3, :3]), a_from_b[:3, 3])


def matrix_of(pose: pycolmap.Rigid3d) -> Floats:
    """A transform of pycolmap's as a matrix."""
    return se3.transform(pose.rotation.matrix(), pose.translation)


def _ransac(mapper: Mapper) -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR_PX
    options.min_num_trials, options.max_num_trials = 50, 10000
    options.min_inlier_ratio = mapper.config.mapping.min_pnp_inlier_ratio  # no longer search for less
    options.random_seed = mapper.config.seed
    return options


def _joint_pose(mapper: Mapper, matched: Correspondences2D3D) -> Floats | None:
    """world_from_rig by one generalised PnP over all cameras."""
    views, cameras = CameraViews.from_keypoints(mapper, matched.camera, matched.band), cameras_of(mapper)
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        matched.xy_px,
        matched.points_m,
        [int(i) for i in views.index],
        [rigid3d(m) for m in se3.inverse(views.rig_from_view)],
        [cameras[c] for c in views.camera],
        estimation_options=_ransac(mapper),
    )
    return None if result is None else se3.inverse(matrix_of(result["rig_from_world"]))


def _as_expected(mapper: Mapper, matched: Correspondences2D3D, expected: Floats) -> Floats | None:
    """world_from_rig near an expected pose."""
    views = CameraViews.from_keypoints(mapper, matched.camera, matched.band)
    return resect(
        expected,
        matched.xy_px,
        matched.points_m,
        views.index,
        views.rig_from_view,
        mapper.camera_kind[views.camera],
        mapper.state.camera_params[views.camera],
    )


def _errors_px(mapper: Mapper, world_from_rig: Floats, matched: Correspondences2D3D) -> Floats:
    """Reprojection errors (n,) under a pose of the unit; infinite behind a camera."""
    views = CameraViews.from_keypoints(mapper, matched.camera, matched.band)
    eye_from_world = se3.inverse(world_from_rig @ views.rig_from_view)
    errors = np.full(len(matched.camera), np.inf)
    for c, camera in enumerate(cameras_of(mapper)):
        rows = np.flatnonzero(matched.camera == c)
        if mapper.state.simultaneous:
            points = se3.apply(eye_from_world[c], matched.points_m[rows])
        else:
            points = se3.apply(eye_from_world[views.index[rows]], matched.points_m[rows, None])[:, 0]
        front = points[:, 2] > 1e-3
        pixels = camera.img_from_cam(points[front])
        errors[rows[front]] = np.linalg.norm(pixels - matched.xy_px[rows[front]], axis=1)
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
    same = agree(np.stack([vote.world_from_rig for vote in votes]), pose)
    return tuple(name for name, agrees in zip(_names(mapper, votes), same, strict=True) if not agrees)


def camera_votes(mapper: Mapper, matched: Correspondences2D3D) -> list[Vote]:
    """Poses of the unit, each from one camera's own PnP, of the cameras for which that succeeds."""
    votes = []
    rig_from_view = _rig_from_cameras(mapper, matched)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = _ransac(mapper)
    for c, camera in enumerate(cameras_of(mapper)):
        rows = matched.camera == c
        if rows.sum() < MIN_CAMERA_MATCHES:
            continue
        result = pycolmap.estimate_and_refine_absolute_pose(
            matched.xy_px[rows], matched.points_m[rows], camera, estimation_options=options
        )
        if result is None or result["num_inliers"] < MIN_CAMERA_INLIER_RATIO * rows.sum():
            continue
        world_from_cam = se3.inverse(matrix_of(result["cam_from_world"]))
        votes.append(
            Vote(
                camera=c,
                world_from_rig=world_from_cam @ se3.inverse(rig_from_view[c]),
                inliers=int(result["num_inliers"]),
            )
        )
    return votes
