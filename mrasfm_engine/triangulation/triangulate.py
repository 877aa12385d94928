"""Robust multi-view triangulation: points as a pure function of poses and tracks.

For every track the pairs of its rays are hypotheses. The best one, by truncated squared reprojection error over all
observations, is refined with a Cauchy loss; observations within the threshold are inliers. Nothing depends on the order
in which units were registered, so all points can be triangulated anew after poses have changed.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.scene.state import State
from mrasfm_engine.triangulation.kernels import (
    PosedKeypoints,
    reprojection_errors2,
    tracks_with_angle,
    triangulate_tracks,
)
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks
from mrasfm_engine.types import Bools, Floats, Ints

FEW_ERRORS = 4096  # take less time than to wake another thread
ALL_BANDS = 4096  # up to so many, the poses of all are computed at once; rolling shutters have hundreds a unit


def cam_from_world(state: State, units: Ints, cameras: Ints, bands: Ints | None = None) -> tuple[Floats, Floats]:
    """Rotations (n, 3, 3) and translations (n, 3) of images of the given units and cameras, at the given row bands."""
    rotation, centre = state.camera_rotation[cameras], state.camera_position_m[cameras]
    if bands is not None and not state.simultaneous:
        turn = state.band_rotation[bands]
        rotation = turn @ rotation
        centre = np.einsum("nij,nj->ni", turn, centre) + state.band_position_m[bands]
    world_from_cam = state.unit_rotation[units] @ rotation
    centre = np.einsum("nij,nj->ni", state.unit_rotation[units], centre) + state.unit_position_m[units]
    rotation = np.ascontiguousarray(np.swapaxes(world_from_cam, 1, 2))
    return rotation, -np.einsum("nij,nj->ni", rotation, centre)


class Triangulator:
    """Triangulates tracks of one drive; it keeps no result, only arrays that do not change."""

    def __init__(
        self,
        keypoints: Keypoints,
        band_unit: Ints,
        band_camera: Ints,
        camera_kind: Ints,
        *,
        max_error_px: float,
        min_angle_deg: float,
        threads: int = 1,
    ) -> None:
        self._keypoints, self._threads = keypoints, threads
        self._band_unit, self._band_camera, self._kind = band_unit, band_camera, camera_kind
        self._few_bands = len(band_unit) <= ALL_BANDS
        self.max_error_px = max_error_px
        self._cos_limit = math.cos(math.radians(min_angle_deg))

    def with_keypoints(self, keypoints: Keypoints) -> Triangulator:
        """The same for other keypoints of the drive."""
        result = copy.copy(self)
        result._keypoints = keypoints
        return result

    def _posed(self, state: State, keypoints: Ints | None) -> PosedKeypoints:
        """Everything that kernels know of keypoints; `keypoints` are those that they will ask for, None for all."""
        k, (r, t) = self._keypoints, self._cam_from_world(state, keypoints)
        return PosedKeypoints(k.band, k.camera, k.xy_px, k.rays, r, t, self._kind, state.camera_params)

    def _cam_from_world(self, state: State, keypoints: Ints | None) -> tuple[Floats, Floats]:
        """Poses of all row bands; where there are many, only those of some keypoints' row bands are filled in."""
        if self._few_bands or keypoints is None:
            every = None if state.simultaneous else np.arange(len(self._band_unit))
            return cam_from_world(state, self._band_unit, self._band_camera, every)
        needed = np.zeros(len(self._band_unit), dtype=np.bool_)
        needed[self._keypoints.band[keypoints]] = True
        bands = np.flatnonzero(needed)
        rotation, translation = np.empty((len(needed), 3, 3)), np.empty((len(needed), 3))
        rotation[bands], translation[bands] = cam_from_world(
            state, self._band_unit[bands], self._band_camera[bands], bands
        )
        return rotation, translation

    def triangulate(
        self,
        state: State,
        tracks: Tracks,
        usable: Bools,
        *,
        which: Ints,
        points_m: Floats,
        triangulated: Bools,
        is_inlier: Bools,
    ) -> None:
        """Triangulate the tracks `which` from their observations in usable row bands (s,), those that have a pose.

        Writes the points into points_m (tracks, 3), whether there is one into triangulated (tracks,), and which
        keypoints are its observations into is_inlier (keypoints,).
        """
        posed = self._posed(state, _members(tracks, which))
        in_ranges(
            self._threads,
            len(which),
            lambda lo, hi: triangulate_tracks(
                which[lo:hi], tracks.first, tracks.keypoints, posed, usable, self.max_error_px**2, self._cos_limit,
                points_m, triangulated, is_inlier,
            ),
        )  # fmt: skip

    def has_angle(self, state: State, tracks: Tracks, is_inlier: Bools, which: Ints) -> Bools:
        """Return which of the tracks `which` are still seen under an angle that gives depth by their inlier
        observations.
        """
        posed, out = self._posed(state, _members(tracks, which)), np.empty(len(which), dtype=np.bool_)
        in_ranges(
            self._threads,
            len(which),
            lambda lo, hi: tracks_with_angle(
                which[lo:hi], tracks.first, tracks.keypoints, posed, is_inlier, self._cos_limit, out[lo:hi]
            ),
        )
        return out

    def errors_px(self, state: State, rows: Ints, points_m: Floats, point: Ints) -> Floats:
        """Reprojection errors (n,) of keypoints `rows` (n,) against points `point` (n,) of points_m; 1e6 behind."""
        posed, out = self._posed(state, rows), np.empty(len(rows))
        in_ranges(
            1 if len(rows) < FEW_ERRORS else self._threads,
            len(rows),
            lambda lo, hi: reprojection_errors2(rows[lo:hi], point[lo:hi], posed, points_m, out[lo:hi]),
        )
        return np.sqrt(out)


def _members(tracks: Tracks, which: Ints) -> Ints | None:
    """Keypoints of some tracks; None for all, where asking costs more than it saves."""
    if 2 * len(which) > len(tracks):
        return None
    lengths = tracks.first[which + 1] - tracks.first[which]
    starts = np.repeat(tracks.first[which] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    result: Ints = tracks.keypoints[starts + np.arange(len(starts))]
    return result
