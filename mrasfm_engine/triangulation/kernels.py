"""The compiled triangulation of tracks, and reprojection errors of their points; see `triangulate`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Floats, Ints

MAX_HYPOTHESES = 24  # pairs of rays tried a track
MAX_OBSERVATIONS = 256  # of a track that are looked at
MIN_DISTANCE_M = 0.05
PARALLEL = 1e-12  # sine squared of the angle between two rays that meet nowhere
REFINEMENTS = 2  # of a point, each on the inliers that the one before has left
STEPS = 4  # of each
NOT_SEEN_PX2 = 1e12


class PosedKeypoints(NamedTuple):
    """Row band (k,), camera (k,), pixel (k, 2) and ray (k, 3) of every keypoint; cam_from_world of every row band as
    (s, 3, 3) and (s, 3); the cameras' kinds (c,) and parameters (c, PARAMETERS)."""

    band: Ints
    camera: Ints
    xy: Floats
    rays: Floats
    r: Floats
    t: Floats
    kind: Ints
    params: Floats


class TrackRays(NamedTuple):
    """Observations of the track at hand, the first of up to MAX_OBSERVATIONS: keypoint, whether it is an inlier, and
    its ray's origin and direction (n, 3) in the world."""

    keypoint: Ints
    is_inlier: Bools
    origin: Floats
    direction: Floats


class Work(NamedTuple):
    """Memory that kernels would else ask for with every point."""

    cam: Floats
    distorted: Floats
    projected: Floats
    h: Floats
    g: Floats
    hypothesis: Floats


@njit(cache=True)
def _room_for_rays() -> TrackRays:
    n = MAX_OBSERVATIONS
    return TrackRays(np.empty(n, np.int64), np.empty(n, np.bool_), np.empty((n, 3)), np.empty((n, 3)))


@njit(cache=True)
def _room_for_work() -> Work:
    return Work(np.empty(3), np.empty(6), np.empty(8), np.empty(6), np.empty(3), np.empty(3))


@uncounted()
def _error2(r: Any, t: Any, kind: int, params: Any, x: Any, xy: Any, cam: Any, distorted: Any, projected: Any) -> float:
    """Squared reprojection error of x under cam_from_world (r, t); huge where it is not seen."""
    for i in range(3):
        cam[i] = r[i, 0] * x[0] + r[i, 1] * x[1] + r[i, 2] * x[2] + t[i]
    if cam[0] * cam[0] + cam[1] * cam[1] + cam[2] * cam[2] < MIN_DISTANCE_M * MIN_DISTANCE_M:
        return NOT_SEEN_PX2
    if not project(kind, params, cam[0], cam[1], cam[2], distorted, projected):
        return NOT_SEEN_PX2
    return float((projected[0] - xy[0]) ** 2 + (projected[1] - xy[1]) ** 2)


@uncounted(forceinline=True)
def _ray_in_world(r: Any, t: Any, ray: Any, origin: Any, direction: Any) -> None:
    """Write a ray of a camera into the world's axes: its origin and its direction."""
    for i in range(3):
        origin[i] = -(r[0, i] * t[0] + r[1, i] * t[1] + r[2, i] * t[2])
        direction[i] = r[0, i] * ray[0] + r[1, i] * ray[1] + r[2, i] * ray[2]


@uncounted(forceinline=True)
def _cosine(direction: Any, i: int, j: int) -> float:
    """Cosine of the angle between two rays of a track."""
    c = direction[i, 0] * direction[j, 0] + direction[i, 1] * direction[j, 1] + direction[i, 2] * direction[j, 2]
    return float(c)


@uncounted(forceinline=True)
def _meet(origin: Any, direction: Any, i: int, j: int, c: float, x: Any) -> bool:
    """Write the point midway between two rays, the cosine of whose angle is c, into x; False where it is behind."""
    w0, w1, w2 = origin[j, 0] - origin[i, 0], origin[j, 1] - origin[i, 1], origin[j, 2] - origin[i, 2]
    along_i = w0 * direction[i, 0] + w1 * direction[i, 1] + w2 * direction[i, 2]
    along_j = w0 * direction[j, 0] + w1 * direction[j, 1] + w2 * direction[j, 2]
    det = 1.0 - c * c
    if det < PARALLEL:
        return False
    si, sj = (along_i - c * along_j) / det, (c * along_i - along_j) / det
    if si < MIN_DISTANCE_M or sj < MIN_DISTANCE_M:
        return False
    for q in range(3):
        x[q] = 0.5 * (origin[i, q] + si * direction[i, q] + origin[j, q] + sj * direction[j, q])
    return True


@uncounted(forceinline=True)
def _best_hypothesis(
    posed: PosedKeypoints, track_rays: TrackRays, count: int, max_error2: float, cos_limit: float, best: Any, work: Work
) -> bool:
    """Write the point of two rays on which most observations agree into `best`; False where no two rays give one."""
    band, camera, xy, _, r, t, kind, params = posed
    keypoint, _, origin, direction = track_rays
    cam, distorted, projected, _, _, x = work
    best_score = 0.0
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
            c = _cosine(direction, i, j)
            if c > cos_limit or not _meet(origin, direction, i, j, c, x):
                continue
            score = 0.0
            for m in range(count):
                k = keypoint[m]
                b, of = band[k], camera[k]
                e2 = _error2(r[b], t[b], kind[of], params[of], x, xy[k], cam, distorted, projected)
                if e2 < max_error2:
                    score += max_error2 - e2
            if score > best_score:
                best_score = score
                for q in range(3):
                    best[q] = x[q]
    return best_score > 0.0


@uncounted(forceinline=True)
def _mark_inliers(
    posed: PosedKeypoints, track_rays: TrackRays, count: int, max_error2: float, x: Any, work: Work
) -> int:
    """Say which observations agree with x, and how many do."""
    band, camera, xy, _, r, t, kind, params = posed
    keypoint, is_inlier, _, _ = track_rays
    cam, distorted, projected, _, _, _ = work
    inliers = 0
    for m in range(count):
        k = keypoint[m]
        b, of = band[k], camera[k]
        e2 = _error2(r[b], t[b], kind[of], params[of], x, xy[k], cam, distorted, projected)
        is_inlier[m] = e2 < max_error2
        inliers += is_inlier[m]
    return inliers


@uncounted(forceinline=True)
def _refine(posed: PosedKeypoints, track_rays: TrackRays, count: int, scale2: float, x: Any, work: Work) -> None:
    """Move x by Gauss-Newton steps with Cauchy weights over the inliers."""
    band, camera, xy, _, rotation, t, kind, params = posed
    keypoint, is_inlier, _, _ = track_rays
    cam, distorted, proj, h, g, _ = work
    for _ in range(STEPS):
        h[:] = 0.0
        g[:] = 0.0
        for m in range(count):
            if not is_inlier[m]:
                continue
            k = keypoint[m]
            r, of = rotation[band[k]], camera[k]
            e2 = _error2(r, t[band[k]], kind[of], params[of], x, xy[k], cam, distorted, proj)
            if e2 == NOT_SEEN_PX2:
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


@uncounted(forceinline=True)
def _is_wide(is_inlier: Any, direction: Any, count: int, cos_limit: float) -> bool:
    """Return whether the rays of two inliers are at least as far apart as the limit's angle."""
    for i in range(count):
        if is_inlier[i]:
            for j in range(i + 1, count):
                if is_inlier[j] and _cosine(direction, i, j) < cos_limit:
                    return True
    return False


@njit(cache=True, nogil=True)
def triangulate_tracks(
    which: Any, first: Any, track_keypoints: Any, posed: PosedKeypoints, usable: Any, max_error2: float,
    cos_limit: float, points: Any, triangulated: Any, is_inlier: Any,
) -> None:  # fmt: skip
    """Triangulate the tracks `which`; see `Triangulator.triangulate` for what is written."""
    _triangulate_tracks(
        which, first, track_keypoints, posed, usable, max_error2, cos_limit, points, triangulated, is_inlier,
        _room_for_rays(), _room_for_work(), np.empty(3),
    )  # fmt: skip


@uncounted()
def _triangulate_tracks(
    which: Any, first: Any, track_keypoints: Any, posed: PosedKeypoints, usable: Any, max_error2: float,
    cos_limit: float, points: Any, triangulated: Any, is_inlier: Any, track_rays: TrackRays, work: Work, x: Any,
) -> None:  # fmt: skip
    band, _, _, rays, r, t, _, _ = posed
    keypoint, use, origin, direction = track_rays
    for n in range(len(which)):
        track = which[n]
        triangulated[track] = False
        count: Any = np.int64(0)  # a literal has the kernels that it is given to compiled once more
        for s in range(first[track], first[track + 1]):
            k = track_keypoints[s]
            is_inlier[k] = False
            if count < MAX_OBSERVATIONS and usable[band[k]]:
                _ray_in_world(r[band[k]], t[band[k]], rays[k], origin[count], direction[count])
                keypoint[count] = k
                count += 1
        if count < 2 or not _best_hypothesis(posed, track_rays, count, max_error2, cos_limit, x, work):
            continue
        for _ in range(REFINEMENTS):
            if _mark_inliers(posed, track_rays, count, max_error2, x, work) >= 2:
                _refine(posed, track_rays, count, 0.25 * max_error2, x, work)
        if _mark_inliers(posed, track_rays, count, max_error2, x, work) < 2 or not _is_wide(
            use, direction, count, cos_limit
        ):
            continue
        triangulated[track] = True
        for i in range(3):
            points[track, i] = x[i]
        for m in range(count):
            if use[m]:
                is_inlier[keypoint[m]] = True


@njit(cache=True, nogil=True)
def reprojection_errors2(rows: Any, point: Any, posed: PosedKeypoints, points: Any, out: Any) -> None:
    """Write squared reprojection errors (n,) of keypoints `rows` (n,) against points `point` (n,) into `out`."""
    _reprojection_errors2(rows, point, posed, points, out, _room_for_work())


@uncounted()
def _reprojection_errors2(rows: Any, point: Any, posed: PosedKeypoints, points: Any, out: Any, work: Work) -> None:
    band, camera, xy, _, r, t, kind, params = posed
    cam, distorted, projected, _, _, _ = work
    for n in range(len(rows)):
        k = rows[n]
        b, of = band[k], camera[k]
        out[n] = _error2(r[b], t[b], kind[of], params[of], points[point[n]], xy[k], cam, distorted, projected)


@njit(cache=True, nogil=True)
def tracks_with_angle(
    which: Any, first: Any, track_keypoints: Any, posed: PosedKeypoints, is_inlier: Any, cos_limit: float, out: Any
) -> None:
    """Write into `out` (n,) whether two inliers of a track are seen under at least the limit's angle."""
    _tracks_with_angle(which, first, track_keypoints, posed, is_inlier, cos_limit, out, _room_for_rays())


@uncounted()
def _tracks_with_angle(
    which: Any, first: Any, track_keypoints: Any, posed: PosedKeypoints, is_inlier: Any, cos_limit: float, out: Any,
    track_rays: TrackRays,
) -> None:  # fmt: skip
    band, _, _, rays, r, t, _, _ = posed
    _, use, origin, direction = track_rays
    use[:] = True
    for n in range(len(which)):
        count: Any = np.int64(0)
        for s in range(first[which[n]], first[which[n] + 1]):
            k = track_keypoints[s]
            if is_inlier[k] and count < MAX_OBSERVATIONS:
                _ray_in_world(r[band[k]], t[band[k]], rays[k], origin[count], direction[count])
                count += 1
        out[n] = _is_wide(use, direction, count, cos_limit)
