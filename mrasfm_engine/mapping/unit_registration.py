"""Camera set registration: the pose of a rigid unit from points its cameras see, as one.

First the pose that the vehicle's motion lets expect is refined; where that does not explain what all cameras see, one
generalised PnP over all cameras is asked. Where that fails, or a camera disagrees with it, every camera is registered
alone, its pose turned into one of the unit through `rig_from_cam`, and the unit's pose is their robust average (MRASfM,
section 3(a), see `camera_vote`); cameras far from it are voted out by name. Either way all images of the unit get their
pose from the unit, also those that see too little to be registered alone, or nothing but what covers them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pycolmap

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import unpack_camera
from mrasfm_engine.mapping.mapper import Model
from mrasfm_engine.mapping.per_camera_pnp import Vote, agree, consensus
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
    """How a unit was registered, or why not."""

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
class Seen:
    """Image points of a unit and the scene's points they show."""

    xy_px: Floats  # (n, 2)
    points_m: Floats  # (n, 3)
    camera: Ints  # (n,)
    shot: Ints  # (n,)

    def of(self, rows: Ints) -> Seen:
        """Some of them."""
        return Seen(
            xy_px=self.xy_px[rows], points_m=self.points_m[rows], camera=self.camera[rows], shot=self.shot[rows]
        )


@dataclass(frozen=True, kw_only=True)
class Eyes:
    """What looks out of a rig: its cameras, or, where these are not simultaneous, its cameras at their shots."""

    index: Ints  # (n,) which of them each image point is seen by
    rig_from_eye: Floats  # (e, 4, 4)
    camera: Ints  # (e,)

    @staticmethod
    def of(model: Model, camera: Ints, shot: Ints) -> Eyes:
        """The eyes of image points of given cameras (n,) and shots (n,)."""
        if model.state.simultaneous:
            return Eyes(index=camera, rig_from_eye=model.state.rig_from_cam, camera=np.arange(len(model.camera_kind)))
        shots, index = np.unique(shot, return_inverse=True)
        camera_of_shot = model.motion.shots.camera[shots]
        return Eyes(
            index=index.astype(np.int64),
            rig_from_eye=model.state.unit_from_shot[shots] @ model.state.rig_from_cam[camera_of_shot],
            camera=camera_of_shot,
        )


def register_unit(model: Model, unit: int) -> Registration:
    """Find the pose of a unit from the points of its tracks."""
    expected = model.motion.expected_pose(model.state, model.registered, unit)
    return register_seen(
        model, unit, points_seen(model, unit), min_inliers=model.config.mapping.min_pnp_inliers, expected=expected
    )


def register_seen(
    model: Model,
    unit: int,
    seen: Seen,
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
    if len(seen.camera) < min_inliers:
        return failed(unit, seen, 0, f"it sees {len(seen.camera)} points of the scene, {min_inliers} are needed")
    sample = seen.of(_spread(len(seen.camera), MAX_CORRESPONDENCES))
    pose = None if expected is None else _as_expected(model, sample, expected)
    inlier = np.zeros(len(seen.camera), dtype=np.bool_)
    if pose is not None:
        inlier = _errors_px(model, pose, seen) < MAX_ERROR_PX
        if inlier.mean() < MIN_EXPECTED_INLIER_RATIO or _disagreeing(model, seen, inlier):
            pose = None
    if pose is None:
        pose = _joint_pose(model, sample)
        inlier[:] = False
        if pose is not None:
            inlier = _errors_px(model, pose, seen) < MAX_ERROR_PX
    disagreeing = _disagreeing(model, seen, inlier)
    method = "joint"
    votes: list[Vote] = []
    if by_vote and (pose is None or disagreeing or inlier.mean() < model.config.mapping.min_pnp_inlier_ratio):
        votes = camera_votes(model, sample)
        average = consensus(votes)
        if average is not None:
            agreeing = _errors_px(model, average.world_from_rig, seen) < MAX_ERROR_PX
            if agreeing.sum() >= inlier.sum() * VOTE_BEATS_JOINT:
                pose, inlier, method = average.world_from_rig, agreeing, "vote"
    count = int(inlier.sum())
    if pose is None or count < min_inliers or count < model.config.mapping.min_pnp_inlier_ratio * len(inlier):
        return failed(unit, seen, count, f"only {count} of {len(inlier)} points agree with one pose")
    return Registration(
        unit=unit,
        world_from_rig=pose,
        correspondences=len(inlier),
        inliers=count,
        method=method,
        voted_out=_others(model, votes, pose),
        unclear=tuple(n for n in _disagreeing(model, seen, inlier) if n not in _names(model, votes)),
    )


def failed(unit: int, seen: Seen, inliers: int, reason: str) -> Registration:
    """A unit without a pose, and why."""
    return Registration(
        unit=unit,
        world_from_rig=None,
        correspondences=len(seen.camera),
        inliers=inliers,
        method="none",
        reason=reason,
    )


def points_seen(model: Model, unit: int) -> Seen:
    """Keypoints of a unit whose tracks have a point, and these points."""
    rows = model.rows_of_unit[unit]
    tracks = model.tracks.of_keypoint[rows]
    known = model.solved[tracks]
    rows, tracks = rows[known], tracks[known]
    return Seen(
        xy_px=model.keypoints.xy_px[rows],
        points_m=model.state.points_m[tracks],
        camera=model.keypoints.camera[rows],
        shot=model.keypoints.shot[rows],
    )


def _spread(count: int, limit: int) -> Ints:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.int64))


def cameras_of(model: Model) -> list[pycolmap.Camera]:
    """The cameras with their current intrinsics, as pycolmap takes them."""
    return [
        pycolmap.Camera(model=c.model, width=c.width, height=c.height, params=unpack_camera(c.model, params))
        for c, params in zip(model.drive.cameras, model.state.camera_params, strict=True)
    ]


def rigid3d(a_from_b: Floats) -> pycolmap.Rigid3d:
    """A transform as pycolmap takes it."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(a_from_b[:3, :3]), a_from_b[:3, 3])


def matrix_of(pose: pycolmap.Rigid3d) -> Floats:
    """A transform of pycolmap's as a matrix."""
    return se3.transform(pose.rotation.matrix(), pose.translation)


def _ransac(model: Model) -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR_PX
    options.min_num_trials, options.max_num_trials = 50, 10000
    options.min_inlier_ratio = model.config.mapping.min_pnp_inlier_ratio  # no longer search for less
    options.random_seed = model.config.seed
    return options


def _joint_pose(model: Model, seen: Seen) -> Floats | None:
    """world_from_rig by one generalised PnP over all cameras."""
    eyes, cameras = Eyes.of(model, seen.camera, seen.shot), cameras_of(model)
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        seen.xy_px,
        seen.points_m,
        [int(i) for i in eyes.index],
        [rigid3d(m) for m in se3.inverse(eyes.rig_from_eye)],
        [cameras[c] for c in eyes.camera],
        estimation_options=_ransac(model),
    )
    return None if result is None else se3.inverse(matrix_of(result["rig_from_world"]))


def _as_expected(model: Model, seen: Seen, expected: Floats) -> Floats | None:
    """world_from_rig near an expected pose."""
    eyes = Eyes.of(model, seen.camera, seen.shot)
    return resect(
        expected,
        seen.xy_px,
        seen.points_m,
        eyes.index,
        eyes.rig_from_eye,
        model.camera_kind[eyes.camera],
        model.state.camera_params[eyes.camera],
    )


def _errors_px(model: Model, world_from_rig: Floats, seen: Seen) -> Floats:
    """Reprojection errors (n,) under a pose of the unit; infinite behind a camera."""
    eyes = Eyes.of(model, seen.camera, seen.shot)
    eye_from_world = se3.inverse(world_from_rig @ eyes.rig_from_eye)
    errors = np.full(len(seen.camera), np.inf)
    for c, camera in enumerate(cameras_of(model)):
        rows = np.flatnonzero(seen.camera == c)
        if model.state.simultaneous:
            points = se3.apply(eye_from_world[c], seen.points_m[rows])
        else:
            points = se3.apply(eye_from_world[eyes.index[rows]], seen.points_m[rows, None])[:, 0]
        front = points[:, 2] > 1e-3
        pixels = camera.img_from_cam(points[front])
        errors[rows[front]] = np.linalg.norm(pixels - seen.xy_px[rows[front]], axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def _disagreeing(model: Model, seen: Seen, inlier: Bools) -> tuple[str, ...]:
    """Cameras that see enough points but whose points don't fit the joint pose."""
    return tuple(
        camera.name
        for c, camera in enumerate(model.drive.cameras)
        if (seen.camera == c).sum() >= MIN_CAMERA_MATCHES and inlier[seen.camera == c].mean() < MIN_CAMERA_INLIER_RATIO
    )


def _rig_from_cameras(model: Model, seen: Seen) -> Floats:
    """The cameras (c, 4, 4) in the middle of their images, which one PnP over all rows finds."""
    result = model.state.rig_from_cam
    if not model.state.simultaneous:
        shots = model.motion.shots
        middle = np.unique(shots.middle_of_image[shots.image[seen.shot]])
        result[shots.camera[middle]] = model.state.unit_from_shot[middle] @ result[shots.camera[middle]]
    return result


def _names(model: Model, votes: list[Vote]) -> list[str]:
    return [model.drive.cameras[vote.camera].name for vote in votes]


def _others(model: Model, votes: list[Vote], pose: Floats) -> tuple[str, ...]:
    """Names of the cameras that voted for another pose."""
    if not votes:
        return ()
    same = agree(np.stack([vote.world_from_rig for vote in votes]), pose)
    return tuple(name for name, agrees in zip(_names(model, votes), same, strict=True) if not agrees)


def camera_votes(model: Model, seen: Seen) -> list[Vote]:
    """Poses of the unit, each from one camera's own PnP, of the cameras for which that succeeds."""
    votes = []
    rig_from_eye = _rig_from_cameras(model, seen)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = _ransac(model)
    for c, camera in enumerate(cameras_of(model)):
        rows = seen.camera == c
        if rows.sum() < MIN_CAMERA_MATCHES:
            continue
        result = pycolmap.estimate_and_refine_absolute_pose(
            seen.xy_px[rows], seen.points_m[rows], camera, estimation_options=options
        )
        if result is None or result["num_inliers"] < MIN_CAMERA_INLIER_RATIO * rows.sum():
            continue
        world_from_cam = se3.inverse(matrix_of(result["cam_from_world"]))
        votes.append(
            Vote(
                camera=c,
                world_from_rig=world_from_cam @ se3.inverse(rig_from_eye[c]),
                inliers=int(result["num_inliers"]),
            )
        )
    return votes
