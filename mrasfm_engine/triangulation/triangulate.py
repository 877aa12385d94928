"""Robust multi-view triangulation: points as a pure function of poses and tracks.

For every track the pairs of its rays are hypotheses. The best one, by truncated squared reprojection error over all
observations, is refined with a Cauchy loss; observations within the threshold are inliers. Nothing depends on the order
in which units were registered, so all points can be triangulated anew after poses have changed.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np

from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.scene.state import State
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks
from mrasfm_engine.types import Bools, Floats, Ints

MAX_HYPOTHESES = 24  # pairs of rays tried a track
MAX_OBSERVATIONS = 256  # of a track that are looked at
MIN_DISTANCE_M = 0.05
ALL_SHOTS = 4096  # up to so many, the poses of all are computed at once; rolling shutters have hundreds a unit


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _error2(r: Any, t: Any, kind: int, params: Any, x: Any, xy: Any, cam: Any, work: Any, proj: Any) -> Any:
    """Squared reprojection error of x under cam_from_world (r, t); huge where it is not seen."""
    for i in range(3):
        cam[i] = r[i, 0] * x[0] + r[i, 1] * x[1] + r[i, 2] * x[2] + t[i]
    if cam[0] * cam[0] + cam[1] * cam[1] + cam[2] * cam[2] < MIN_DISTANCE_M * MIN_DISTANCE_M:
        return 1e12
    if not project(kind, params, cam[0], cam[1], cam[2], work, proj):
        return 1e12
    return (proj[0] - xy[0]) ** 2 + (proj[1] - xy[1]) ** 2


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _refine(
    count: int, use: Any, members: Any, band: Any, camera: Any, xy: Any, cfw_r: Any, cfw_t: Any, kind: Any,
    params: Any, x: Any, scale2: float, cam: Any, work: Any, proj: Any, h: Any, g: Any,
) -> None:  # fmt: skip
    """A few Gauss-Newton steps on a point with Cauchy weights over the observations in use."""
    for _ in range(4):
        h[:] = 0.0
        g[:] = 0.0
        for m in range(count):
            if not use[m]:
                continue
            k = members[m]
            r = cfw_r[band[k]]
            c = camera[k]
            e2 = _error2(r, cfw_t[band[k]], kind[c], params[c], x, xy[k], cam, work, proj)
            if e2 > 1e11:
                continue
            w = 1.0 / (1.0 + e2 / scale2)
            for i in range(2):
                e = proj[i] - xy[k, i]
                j0 = proj[2 + 3 * i] * r[0, 0] + proj[3 + 3 * i] * r[1, 0] + proj[4 + 3 * i] * r[2, 0]
                j1 = proj[2 + 3 * i] * r[0, 1] + proj[3 + 3 * i] * r[1, 1] + proj[4 + 3 * i] * r[2, 1]
                j2 = proj[2 + 3 * i] * r[0, 2] + proj[3 + 3 * i] * r[1, 2] + proj[4 + 3 * i] * r[2, 2]
                h[0] += w * j0 * j0
                h[1] += w * j0 * j1
                h[2] += w * j0 * j2
                h[3] += w * j1 * j1
                h[4] += w * j1 * j2
                h[5] += w * j2 * j2
                g[0] += w * j0 * e
                g[1] += w * j1 * e
                g[2] += w * j2 * e
        h0, h3, h5 = h[0] * 1.0001, h[3] * 1.0001, h[5] * 1.0001
        c0, c1, c2 = h3 * h5 - h[4] * h[4], h[2] * h[4] - h[1] * h5, h[1] * h[4] - h[2] * h3
        det = h0 * c0 + h[1] * c1 + h[2] * c2
        if not det > 0.0:
            return
        d0 = (c0 * g[0] + c1 * g[1] + c2 * g[2]) / det
        d1 = (c1 * g[0] + (h0 * h5 - h[2] * h[2]) * g[1] + (h[1] * h[2] - h0 * h[4]) * g[2]) / det
        d2 = (c2 * g[0] + (h[1] * h[2] - h0 * h[4]) * g[1] + (h0 * h3 - h[1] * h[1]) * g[2]) / det
        x[0] -= d0
        x[1] -= d1
        x[2] -= d2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _triangulate(
    which: Any, first: Any, track_keypoints: Any, band: Any, camera: Any, xy: Any, rays: Any, usable: Any,
    cfw_r: Any, cfw_t: Any, kind: Any, params: Any, max_error2: float, min_angle: float,
    points: Any, triangulated: Any, is_inlier: Any,
) -> None:  # fmt: skip
    members, use = np.empty(MAX_OBSERVATIONS, np.int64), np.empty(MAX_OBSERVATIONS, np.bool_)
    origin, direction = np.empty((MAX_OBSERVATIONS, 3)), np.empty((MAX_OBSERVATIONS, 3))
    cam, work, proj, h, g = np.empty(3), np.empty(6), np.empty(8), np.empty(6), np.empty(3)
    x, best = np.empty(3), np.empty(3)
    cos_limit = math.cos(min_angle)
    for n in range(len(which)):
        track = which[n]
        triangulated[track] = False
        count: Any = np.int64(0)  # a literal has the kernels that it is given to compiled once more
        for s in range(first[track], first[track + 1]):
            k = track_keypoints[s]
            is_inlier[k] = False
            if count < MAX_OBSERVATIONS and usable[band[k]]:
                r, t = cfw_r[band[k]], cfw_t[band[k]]
                for i in range(3):
                    origin[count, i] = -(r[0, i] * t[0] + r[1, i] * t[1] + r[2, i] * t[2])
                    direction[count, i] = r[0, i] * rays[k, 0] + r[1, i] * rays[k, 1] + r[2, i] * rays[k, 2]
                members[count] = k
                count += 1
        if count < 2:
            continue
        best_score, tried = 0.0, 0
        total = count * (count - 1) // 2
        stride = max(1, total // MAX_HYPOTHESES)
        if stride > 1 and stride % 2 == 0:
            stride += 1  # an odd stride does not fall into step with the images of a unit
        flat = 0
        for i in range(count):
            for j in range(i + 1, count):
                flat += 1
                if flat % stride != 0 and total > MAX_HYPOTHESES:
                    continue
                c = (
                    direction[i, 0] * direction[j, 0]
                    + direction[i, 1] * direction[j, 1]
                    + direction[i, 2] * direction[j, 2]
                )
                if c > cos_limit:
                    continue
                w0, w1, w2 = origin[j, 0] - origin[i, 0], origin[j, 1] - origin[i, 1], origin[j, 2] - origin[i, 2]
                pi = w0 * direction[i, 0] + w1 * direction[i, 1] + w2 * direction[i, 2]
                pj = w0 * direction[j, 0] + w1 * direction[j, 1] + w2 * direction[j, 2]
                det = 1.0 - c * c
                if det < 1e-12:
                    continue
                si, sj = (pi - c * pj) / det, (c * pi - pj) / det
                if si < MIN_DISTANCE_M or sj < MIN_DISTANCE_M:
                    continue
                for q in range(3):
                    x[q] = 0.5 * (origin[i, q] + si * direction[i, q] + origin[j, q] + sj * direction[j, q])
                tried += 1
                score = 0.0
                for m in range(count):
                    k = members[m]
                    e2 = _error2(
                        cfw_r[band[k]], cfw_t[band[k]], kind[camera[k]], params[camera[k]], x, xy[k], cam, work, proj
                    )
                    if e2 < max_error2:
                        score += max_error2 - e2
                if score > best_score:
                    best_score = score
                    best[:] = x
        if best_score <= 0.0:
            continue
        x[:] = best
        for _ in range(2):
            inliers = 0
            for m in range(count):
                k = members[m]
                e2 = _error2(
                    cfw_r[band[k]], cfw_t[band[k]], kind[camera[k]], params[camera[k]], x, xy[k], cam, work, proj
                )
                use[m] = e2 < max_error2
                inliers += use[m]
            if inliers < 2:
                break
            _refine(
                count,
                use,
                members,
                band,
                camera,
                xy,
                cfw_r,
                cfw_t,
                kind,
                params,
                x,
                0.25 * max_error2,
                cam,
                work,
                proj,
                h,
                g,
            )
        inliers = 0
        for m in range(count):
            k = members[m]
            e2 = _error2(cfw_r[band[k]], cfw_t[band[k]], kind[camera[k]], params[camera[k]], x, xy[k], cam, work, proj)
            use[m] = e2 < max_error2
            inliers += use[m]
        if inliers < 2:
            continue
        wide = False
        for i in range(count):
            if wide:
                break
            if use[i]:
                for j in range(i + 1, count):
                    if use[j]:
                        c = (
                            direction[i, 0] * direction[j, 0]
                            + direction[i, 1] * direction[j, 1]
                            + direction[i, 2] * direction[j, 2]
                        )
                        if c < cos_limit:
                            wide = True
                            break
        if not wide:
            continue
        triangulated[track] = True
        for i in range(3):
            points[track, i] = x[i]
        for m in range(count):
            if use[m]:
                is_inlier[members[m]] = True


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _errors(
    rows: Any,
    point: Any,
    band: Any,
    camera: Any,
    xy: Any,
    cfw_r: Any,
    cfw_t: Any,
    kind: Any,
    params: Any,
    points: Any,
    out: Any,
) -> None:
    cam, work, proj = np.empty(3), np.empty(6), np.empty(8)
    for n in range(len(rows)):
        k = rows[n]
        c = camera[k]
        out[n] = _error2(cfw_r[band[k]], cfw_t[band[k]], kind[c], params[c], points[point[n]], xy[k], cam, work, proj)


@njit(cache=True, nogil=True, error_model="numpy")
def _has_angle(
    which: Any,
    first: Any,
    track_keypoints: Any,
    is_inlier: Any,
    band: Any,
    rays: Any,
    cfw_r: Any,
    cos_limit: float,
    out: Any,
) -> None:
    """Return whether two observations of a point are seen under at least the limit's angle."""
    direction = np.empty((MAX_OBSERVATIONS, 3))
    for n in range(len(which)):
        count = 0
        out[n] = False
        for s in range(first[which[n]], first[which[n] + 1]):
            k = track_keypoints[s]
            if is_inlier[k] and count < MAX_OBSERVATIONS and not out[n]:
                r = cfw_r[band[k]]
                for i in range(3):
                    direction[count, i] = r[0, i] * rays[k, 0] + r[1, i] * rays[k, 1] + r[2, i] * rays[k, 2]
                for m in range(count):
                    c = 0.0
                    for i in range(3):
                        c += direction[count, i] * direction[m, i]
                    if c < cos_limit:
                        out[n] = True
                count += 1


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
        self._few_bands = len(band_unit) <= ALL_SHOTS
        self.max_error_px = max_error_px
        self._min_angle = math.radians(min_angle_deg)

    def with_keypoints(self, keypoints: Keypoints) -> Triangulator:
        """The same for other keypoints of the drive."""
        result = copy.copy(self)
        result._keypoints = keypoints
        return result

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

        Writes the points into points_m (tracks, 3), whether there is one into solved (tracks,), and which keypoints are
        its observations into kept (keypoints,).
        """
        r, t = self._cam_from_world(state, _members(tracks, which))
        k = self._keypoints
        in_ranges(
            self._threads,
            len(which),
            lambda lo, hi: _triangulate(
                which[lo:hi], tracks.first, tracks.keypoints, k.band, k.camera, k.xy_px, k.rays, usable, r, t,
                self._kind, state.camera_params, self.max_error_px**2, self._min_angle, points_m, triangulated,
                is_inlier,
            ),
        )  # fmt: skip

    def has_angle(self, state: State, tracks: Tracks, is_inlier: Bools, which: Ints) -> Bools:
        """Return which of the tracks `which` are still seen under an angle that gives depth by their inlier
        observations.
        """
        r, _ = self._cam_from_world(state, _members(tracks, which))
        out, k = np.empty(len(which), dtype=np.bool_), self._keypoints
        in_ranges(
            self._threads,
            len(which),
            lambda lo, hi: _has_angle(
                which[lo:hi], tracks.first, tracks.keypoints, is_inlier, k.band, k.rays, r, math.cos(self._min_angle),
                out[lo:hi],
            ),
        )  # fmt: skip
        return out

    def errors_px(self, state: State, rows: Ints, points_m: Floats, point: Ints) -> Floats:
        """Reprojection errors (n,) of keypoints `rows` (n,) against points `point` (n,) of points_m; 1e6 behind."""
        r, t = self._cam_from_world(state, rows)
        out, k = np.empty(len(rows)), self._keypoints
        in_ranges(
            self._threads,
            len(rows),
            lambda lo, hi: _errors(
                rows[lo:hi], point[lo:hi], k.band, k.camera, k.xy_px, r, t, self._kind, state.camera_params, points_m,
                out[lo:hi],
            ),
        )  # fmt: skip
        return np.sqrt(out)


def _members(tracks: Tracks, which: Ints) -> Ints | None:
    """Keypoints of some tracks; None for all, where asking costs more than it saves."""
    if 2 * len(which) > len(tracks):
        return None
    lengths = tracks.first[which + 1] - tracks.first[which]
    starts = np.repeat(tracks.first[which] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    result: Ints = tracks.keypoints[starts + np.arange(len(starts))]
    return result
