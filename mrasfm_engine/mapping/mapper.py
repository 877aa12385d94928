"""The scene while it grows: registered units, points of tracks, and the adjustments that act on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.bundle_adjustment.observation_sampling import thinned
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.mapping.rig_motion import RigMotion
from mrasfm_engine.mapping.visibility_pyramid import finest_cells, visibility_score
from mrasfm_engine.matching.motion_of_cameras import MotionEstimate, rig_by_motion
from mrasfm_engine.matching.simultaneous import rig_of_drive
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.scene.state import State
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks, count_members, inlier_members, matching_keypoints
from mrasfm_engine.triangulation.triangulate import Triangulator
from mrasfm_engine.types import Bools, Floats, Ints

_RESULTS = ("registered", "keyframe", "triangulated", "is_inlier", "missing", "rig_as_begun")
_STATE = (
    "unit_rotation", "unit_position_m", "camera_rotation", "camera_position_m", "camera_params",
    "camera_time_offset_s", "points_m", "band_rotation", "band_position_m",
)  # fmt: skip


class Mapper:
    """Registered units, tracks and their points. A track has at most one point.

    Attributes
    ----------
    state
        Poses and calibration; `state.points_m` has a row for every track, valid where `triangulated`.
    rig_as_begun
        (cameras, 4, 4) `rig_from_cam` before the first adjustment, see `correct_calibration`.
    registered
        (units,) which units have a pose.
    keyframe
        (units,) which units mapping uses, see `mapping.keyframes`.
    triangulated
        (tracks,) which tracks have a point.
    is_inlier
        (keypoints,) which keypoints are observations of their track's point.
    missing
        (images,) images without a pose although their unit has one: only where images are registered one by one.
    motion
        Where the rig is at the images' own times, and poses that images have apart from it.
    rejected
        (tracks,) which tracks were dropped for what they show: they get no point until all are tried again.
    track_class
        (tracks,) the class of most keypoints of a track, as `semantics.CLASS_CODES` numbers them.
    """

    def __init__(self, drive: Drive, keypoints: Keypoints, tracks: Tracks, config: EngineConfig) -> None:
        self.drive, self.keypoints, self.tracks, self.config = drive, keypoints, tracks, config
        self.camera_kind, params = pack_cameras(drive.cameras)
        self.image_size_px = np.array([[camera.width, camera.height] for camera in drive.cameras], dtype=np.float64)
        units = len(drive.manifest.frames)
        self.state = State(
            unit_rotation=np.tile(np.eye(3), (units, 1, 1)),
            unit_position_m=np.zeros((units, 3)),
            camera_rotation=np.ascontiguousarray(drive.rig_from_cam[:, :3, :3]),
            camera_position_m=np.ascontiguousarray(drive.rig_from_cam[:, :3, 3]),
            camera_params=params,
            points_m=np.zeros((len(tracks), 3)),
            camera_time_offset_s=np.zeros(len(drive.cameras)),
        )
        self.rig_as_begun = drive.rig_from_cam
        self.registered = np.zeros(units, dtype=np.bool_)
        self.keyframe = np.ones(units, dtype=np.bool_)
        self.triangulated = np.zeros(len(tracks), dtype=np.bool_)
        self.is_inlier = np.zeros(len(keypoints.image), dtype=np.bool_)
        self.missing = np.zeros(len(drive.images), dtype=np.bool_)
        self.rejected = np.zeros(len(tracks), dtype=np.bool_)
        self.track_class = tracks.classes(keypoints.classes)
        self.image_unit = np.array([image.unit for image in drive.images], dtype=np.int64)
        self.image_camera = np.array([image.camera for image in drive.images], dtype=np.int64)
        bands = RowBands.from_drive(drive, compensate=config.mapping.motion_compensation)
        self.motion = RigMotion(bands, drive.timestamps_us)
        if self.motion.needed:
            self.place_bands()
        self.triangulator = Triangulator(
            keypoints,
            bands.unit,
            bands.camera,
            self.camera_kind,
            max_error_px=config.mapping.max_error_px,
            min_angle_deg=config.mapping.min_angle_deg,
            threads=config.threads,
        )
        # Caches for registration: the number of points that every unit sees, and as of which points; keypoints
        # by unit, and the tracks they are in.
        self._visible, self._visible_of = np.zeros(units, dtype=np.int64), np.zeros(len(tracks), dtype=np.bool_)
        order = np.argsort(keypoints.unit, kind="stable")
        bounds = np.searchsorted(keypoints.unit[order], np.arange(units + 1))
        tracked = tracks.of_keypoint >= 0
        self.rows_of_unit = [rows[tracked[rows]] for rows in (order[lo:hi] for lo, hi in pairwise(bounds))]
        self._cell = finest_cells(keypoints.xy_px, keypoints.camera, self.image_size_px)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that mapping has found, for `from_arrays`."""
        has_own_pose, unit_from_image = self.motion.own_poses
        return {
            "of_keypoint": self.tracks.of_keypoint,
            "has_own_pose": has_own_pose,
            "unit_from_image": unit_from_image,
            **{name: getattr(self, name) for name in _RESULTS},
            **{name: getattr(self.state, name) for name in _STATE},
        }

    @staticmethod
    def from_arrays(
        drive: Drive,
        keypoints: Keypoints,
        config: EngineConfig,
        prior_world_from_rig: Floats | None,
        arrays: Mapping[str, NDArray[Any]],
    ) -> Mapper:
        """The mapper whose `to_arrays` these are; units without a pose move as the prior trajectory says."""
        mapper = Mapper(drive, keypoints, Tracks.from_labels(arrays["of_keypoint"]), config)
        for name in _RESULTS:
            setattr(mapper, name, arrays[name])
        mapper.state = replace(mapper.state, **{name: arrays[name] for name in _STATE})
        if prior_world_from_rig is not None:
            mapper.motion.follow_prior(prior_world_from_rig)
        for image in np.flatnonzero(arrays["has_own_pose"]):
            mapper.set_image_pose(int(image), arrays["unit_from_image"][image])
        return mapper

    def renew_rays(self) -> None:
        """Let the keypoints' viewing rays be those through the present lenses, from which points are triangulated."""
        self.keypoints = self.keypoints.seen_through(self.camera_kind, self.state.camera_params)
        self.triangulator = self.triangulator.with_keypoints(self.keypoints)

    def rays_of(self, pair: PairMatches) -> tuple[Floats, Floats]:
        """Viewing rays (n, 3) of all of a pair's matches in image_a and image_b."""
        first = self.keypoints.first
        a, b = first[pair.image_a] + pair.matches[:, 0], first[pair.image_b] + pair.matches[:, 1]
        return self.keypoints.rays[a], self.keypoints.rays[b]

    def correct_calibration(self, pairs: Sequence[PairMatches]) -> MotionEstimate:
        """Begin with the calibration as simultaneous images correct it, and then the cameras' motions.

        See `matching.simultaneous` and `matching.motion_of_cameras`, whose result this returns.
        """

        def inlier_rays_of(pair: PairMatches) -> tuple[Floats, Floats]:
            a, b = self.rays_of(pair)
            return a[pair.inliers], b[pair.inliers]

        rig = rig_of_drive(self.drive, pairs, inlier_rays_of, self.config.matching, self.config.bundle_adjustment)
        by_motion = rig_by_motion(
            self.drive, pairs, inlier_rays_of, rig, self.config.matching, self.config.bundle_adjustment
        )
        self.rig_as_begun = by_motion.rig_from_cam
        self.begin_anew(np.ones(len(self.camera_kind), dtype=np.bool_))
        return by_motion

    def begin_anew(self, cameras: Bools) -> None:
        """Put cameras (c,) back to where they were before the first adjustment."""
        begun, state = self.rig_as_begun, self.state
        self.state = replace(
            state,
            camera_rotation=np.where(cameras[:, None, None], begun[:, :3, :3], state.camera_rotation),
            camera_position_m=np.where(cameras[:, None], begun[:, :3, 3], state.camera_position_m),
        )

    def set_pose(self, unit: int, world_from_rig: Floats) -> None:
        """Give a unit a pose and count it as registered."""
        self.state.unit_rotation[unit] = world_from_rig[:3, :3]
        self.state.unit_position_m[unit] = world_from_rig[:3, 3]
        self.registered[unit] = True

    def set_image_pose(self, image: int, unit_from_image: Floats) -> None:
        """Give an image a pose (4, 4) apart from the rig's: where the rig would stand for it, relative to its unit.

        The image's camera then is at world_from_rig * unit_from_image * rig_from_cam, also after further adjustments.
        """
        self.set_image_poses(np.array([image]), unit_from_image[None])
        self.renew_motion(np.array([self.image_unit[image]]))

    def set_image_poses(self, images: Ints, unit_from_image: Floats) -> None:
        """As `set_image_pose` for images (n,) and poses (n, 4, 4); they take effect when the motion is renewed."""
        for image, pose in zip(images, unit_from_image, strict=True):
            self.motion.set_image_pose(int(image), pose)
        if self.state.simultaneous:
            self.place_bands()

    def place_bands(self) -> None:
        """Give the state row bands, all at their units: their motion counts from now on."""
        count = len(self.motion.bands)
        self.state = replace(
            self.state, band_rotation=np.tile(np.eye(3), (count, 1, 1)), band_position_m=np.zeros((count, 3))
        )

    def renew_motion(self, units: Ints | None = None) -> float:
        """Let the images follow the units' present trajectory (around some units); by how much in metres at most."""
        return self.motion.renew(self.state, self.registered, units)

    def drop_unsupported(self, min_observations: int) -> Ints:
        """Take the poses of units back that hardly observe a point any more; which ones."""
        counts = np.bincount(self.keypoints.unit[self.is_inlier], minlength=len(self.registered))
        lost = np.flatnonzero(self.registered & (counts < min_observations))
        self.forget(lost)
        return lost

    def forget(self, units: Ints) -> None:
        """Take the poses of units back, and what their images observe."""
        if not len(units):
            return
        self.registered[units] = False
        images = np.flatnonzero(np.isin(self.image_unit, units))
        self.missing[images] = False
        self.motion.forget_image_poses(images)
        self.is_inlier[np.isin(self.keypoints.unit, units)] = False

    def clear(self) -> None:
        """Forget all poses and points."""
        self.forget(np.arange(len(self.registered)))
        self.triangulated[:] = False

    def tracks_of_units(self, units: Ints) -> Ints:
        """Tracks seen by any of the units, ascending."""
        seen = np.zeros(len(self.tracks), dtype=np.bool_)
        for unit in units:
            seen[self.tracks.of_keypoint[self.rows_of_unit[int(unit)]]] = True
        return np.flatnonzero(seen)

    def matched_keypoints(self, pair: PairMatches, unit: int) -> tuple[Ints, Ints]:
        """Keypoints of a pair's verified matches: those in an image of `unit` first, then those of the other unit."""
        a, b = matching_keypoints(self.keypoints.first, [pair])[0].T
        return (a, b) if self.image_unit[pair.image_a] == unit else (b, a)

    def visible_counts(self) -> Ints:
        """Number of keypoints with a point in every unit (units,); not to be written to."""
        changed = np.flatnonzero(self.triangulated != self._visible_of)
        count_members(self.tracks, changed, self.triangulated, self.keypoints.unit, self._visible)
        self._visible_of[changed] = self.triangulated[changed]
        return self._visible

    def visibility_score(self, unit: int) -> int:
        """Score of how well the points that a unit sees cover its images, see `visibility_pyramid`."""
        rows, of_keypoint = self.rows_of_unit[unit], self.tracks.of_keypoint
        cameras = len(self.camera_kind)
        return visibility_score(rows, self._cell, self.keypoints.camera, of_keypoint, self.triangulated, cameras)

    @property
    def image_posed(self) -> Bools:
        """Images (i,) that have the pose of a registered unit."""
        result: Bools = self.registered[self.image_unit] & ~self.missing
        return result

    def triangulate(self, which: Ints | None = None) -> int:
        """Triangulate tracks (all by default) from registered units; how many of them have a point."""
        if which is None:
            which = np.arange(len(self.tracks), dtype=np.int64)
        self.triangulator.triangulate(
            self.state,
            self.tracks,
            self.image_posed[self.motion.bands.image],
            which=which,
            points_m=self.state.points_m,
            triangulated=self.triangulated,
            is_inlier=self.is_inlier,
        )
        return int(self.triangulated[which].sum())

    def extend(self, unit: int) -> None:
        """Let a newly registered unit observe the points of its tracks, and give its other tracks points."""
        rows = self.rows_of_unit[unit]
        rows = rows[~self.missing[self.keypoints.image[rows]]]
        tracks = self.tracks.of_keypoint[rows]
        has_point = self.triangulated[tracks]
        errors = self.triangulator.errors_px(self.state, rows[has_point], self.state.points_m, tracks[has_point])
        fits = errors < self.triangulator.max_error_px
        self.is_inlier[rows[has_point]] = fits
        # Also points that the new view contradicts: with it, another hypothesis may win.
        again = np.sort(np.concatenate([tracks[~has_point], tracks[has_point][~fits]]))
        again = again[np.diff(again, prepend=-1) > 0]
        self.triangulate(again[~self.rejected[again]])

    def complete(self, *, anew: bool = False) -> None:
        """Let every point have the observations that now fit it, and try again for tracks without a point.

        Points that fewer than two fit are sought `anew`: poses may have moved further than they could follow.
        """
        of_keypoint = self.tracks.of_keypoint
        rows = np.flatnonzero((of_keypoint >= 0) & self.registered[self.keypoints.unit])
        rows = rows[~self.missing[self.keypoints.image[rows]]]
        rows = rows[self.triangulated[of_keypoint[rows]]]
        errors = self.triangulator.errors_px(self.state, rows, self.state.points_m, of_keypoint[rows])
        fits = errors < self.triangulator.max_error_px
        self.is_inlier[:] = False
        self.is_inlier[rows] = fits
        if anew:
            self.triangulated &= np.bincount(of_keypoint[rows[fits]], minlength=len(self.tracks)) >= 2
        self.rejected[:] = False
        self.triangulate(np.flatnonzero(~self.triangulated))
        self.filter(self.triangulator.max_error_px)

    def drop(self, tracks: Ints) -> None:
        """Take the points of tracks away and reject them until `complete` or `readmit`."""
        self.triangulated[tracks] = False
        self.rejected[tracks] = True
        rows = np.flatnonzero(self.is_inlier)
        self.is_inlier[rows[self.rejected[self.tracks.of_keypoint[rows]]]] = False

    def readmit(self) -> None:
        """Triangulate rejected tracks again: poses have changed since."""
        tracks = np.flatnonzero(self.rejected)
        self.rejected[:] = False
        self.triangulate(tracks)

    def filter(self, max_error_px: float) -> tuple[int, int]:
        """Drop observations with larger errors, and points left with fewer than two or without an angle.

        Returns how many of both.
        """
        rows = np.flatnonzero(self.is_inlier)
        tracks = self.tracks.of_keypoint[rows]
        errors = self.triangulator.errors_px(self.state, rows, self.state.points_m, tracks)
        bad = ~(errors <= max_error_px)  # no number is no small error
        self.is_inlier[rows[bad]] = False
        left = np.bincount(tracks[~bad], minlength=len(self.tracks))
        lost = self.triangulated & (left < 2)
        reduced = np.flatnonzero(np.bincount(tracks[bad], minlength=len(self.tracks)))
        lost[reduced[~self.triangulator.has_angle(self.state, self.tracks, self.is_inlier, reduced)]] = True
        self.triangulated[lost] = False
        alone = np.flatnonzero(self.is_inlier)
        self.is_inlier[alone[lost[self.tracks.of_keypoint[alone]]]] = False
        return int(bad.sum()), int(lost.sum())

    def drop_contradicted(self) -> int:
        """Drop points of two observations that another one of their track contradicts; how many.

        Two observations on one another's epipolar line agree on a point whatever they show. Where a third is elsewhere,
        nothing tells which of the matches is wrong, or whether the thing moves.
        """
        posed = np.flatnonzero(self.image_posed[self.keypoints.image] & (self.tracks.of_keypoint >= 0))
        seen = np.bincount(self.tracks.of_keypoint[posed], minlength=len(self.tracks))
        agreeing = np.bincount(self.tracks.of_keypoint[self.is_inlier], minlength=len(self.tracks))
        contradicted = np.flatnonzero(self.triangulated & (agreeing == 2) & (seen > 2))
        self.drop(contradicted)
        return len(contradicted)

    def observation_rows(self, tracks: Ints | None = None) -> Ints:
        """Keypoints that are observations (of the given triangulated tracks, ascending), sorted by track."""
        if tracks is not None:
            return inlier_members(self.tracks, tracks, self.is_inlier)
        members = self.tracks.keypoints
        return members[self.is_inlier[members]]

    def observed(self, free_units: Bools, *, everything: bool = False) -> tuple[Ints, Ints, Ints]:
        """Observations of an adjustment of some units: keypoints that observe their points (or all points), sorted by
        point, the points' tracks, and the keypoints' points as rows of these.
        """
        everything = everything or bool((free_units | ~self.registered).all())
        seen = None if everything else self.tracks_of_units(np.flatnonzero(free_units))
        rows = self.observation_rows(None if seen is None else seen[self.triangulated[seen]])
        track = self.tracks.of_keypoint[rows]
        begins = np.diff(track, prepend=-1) > 0
        return rows, track[begins], np.cumsum(begins) - 1

    def problem(
        self,
        free_units: Bools,
        *,
        free_cameras: Bools | None = None,
        free_intrinsics: Bools | None = None,
        free_times: Bools | None = None,
        free_readouts: Bools | None = None,
        terms: Sequence[Term] = (),
        options: SolverOptions,
    ) -> tuple[Problem, Ints]:
        """The adjustment of some units (and cameras) with all points they see; also those points' tracks."""
        rows, tracks, point = self.observed(free_units, everything=free_cameras is not None)
        problem = Problem(
            state=replace(self.state, points_m=self.state.points_m.take(tracks, axis=0)),
            camera_kind=self.camera_kind,
            observations=thinned(
                Observations(
                    unit=self.keypoints.unit.take(rows),
                    camera=self.keypoints.camera.take(rows),
                    point=point,
                    xy_px=self.keypoints.xy_px.take(rows, axis=0),
                    num_points=len(tracks),
                    band=None if self.state.simultaneous else self.keypoints.band[rows],
                ),
                free_units & self.registered,
            ),
            layout=Layout.from_free(
                free_units & self.registered,
                np.zeros(len(self.camera_kind), dtype=np.bool_) if free_cameras is None else free_cameras,
                free_intrinsics=free_intrinsics,
                free_times=free_times,
                free_readouts=free_readouts,
            ),
            terms=terms,
            options=options,
            motion=None
            if self.state.simultaneous
            else self.motion.in_adjustment(self.state, self.registered, free_units),
        )
        return problem, tracks
