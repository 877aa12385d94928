"""Dynamic objects that move along with the vehicle: a lorry in the next lane, the own bonnet, a car ahead.

They hardly move in the image, so they match best, and no single image pair contradicts them: a static keypoint looks
like a point at infinity, or in a curve like a point at the curve's centre. The poses from the other cameras resolve
this. A viewing ray below the horizon meets the ground after some metres; its keypoint must therefore move by a known
least amount between two units. Keypoints that move by less are on dynamic objects.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.parallel import mapped
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import matching_keypoints
from mrasfm_engine.types import Bools, Floats, Ints

NEAREST_M = 1.0  # nearer things than this are not expected
FARTHEST_M = 1000.0
MAX_CAMERA_HEIGHT_M = 4.0  # of any camera above the ground
MAX_GRADE = 0.1  # by which the ground may fall away from the vehicle
DEPTHS = 24  # tried between nearest and farthest, evenly in inverse depth
MIN_FLOW_PX = 6.0  # what the world must move by before standing still means something
STILL_SHARE = 0.5  # of the least flow of anything in the world: what moves by less moves along
STILL_PX = 2.0  # in a covered image, what moves by less says nothing of the world
MIN_KEYPOINTS = 30  # that move along, before an image is called covered
TELLING_SHARE = 0.5  # of the keypoints with a measure, in a covered image
COVERED_SHARE = 0.75  # of all matched ones
BATCH = 64  # pairs that a thread looks at together


@dataclass(frozen=True, kw_only=True)
class MovingAlong:
    """Keypoints that move along with the vehicle, and the images that they cover."""

    keypoint: Bools  # (keypoints,) no part of the world; set only where images are covered
    share: Floats  # (images,) of an image's matched keypoints that do not move as the world does
    covered: Bools  # (images,)

    @property
    def any(self) -> bool:
        """An image is covered."""
        return bool(self.covered.any())


def find_moving_along(mapper: Mapper, pairs: Sequence[PairMatches]) -> MovingAlong:
    """Keypoints and images that contradict the motion of their units, from matches of one camera at two instants.

    Parameters
    ----------
    mapper
        With poses; units without one take no part. Where the vehicle hardly moves nothing is said.
    pairs
        Verified matches.
    """
    keypoints, images = mapper.keypoints, len(mapper.drive.images)
    along = np.zeros(len(keypoints.image), dtype=np.int64)  # matches for and against
    seen, moves = np.zeros((2, len(keypoints.image)), dtype=np.bool_)
    for a, b, least_px, moved_px in _flows(mapper, pairs):
        _vote(a, b, least_px, moved_px, along, seen, moves)
    # A static keypoint above the horizon of a straight street may be far away. It counts as moving along only where
    # most of the keypoints below the horizon do.
    with_it, still = along > 0, seen & (along == 0) & ~moves
    count, counter, total, quiet = (
        np.bincount(keypoints.image[which], minlength=images) for which in (with_it, along < 0, seen, still)
    )
    share = (count + quiet) / np.maximum(total, 1)
    covered = (count >= MIN_KEYPOINTS) & (count >= TELLING_SHARE * (count + counter)) & (share >= COVERED_SHARE)
    no_world = (with_it | (covered[keypoints.image] & still)) if covered.any() else np.zeros_like(with_it)
    return MovingAlong(keypoint=no_world, share=share, covered=covered)


def units_to_doubt(mapper: Mapper, moving: MovingAlong, known: Bools) -> Ints:
    """Units whose pose has to be found anew, as covered images may have outvoted the others.

    Not those from whose covered images most of what moves along had been taken out before: `known` (keypoints,).
    """
    image, units = mapper.keypoints.image, len(mapper.registered)
    missed = np.bincount(image[moving.keypoint & ~known], minlength=len(moving.covered))
    found = np.bincount(image[moving.keypoint & known], minlength=len(moving.covered))
    misled = moving.covered & (missed > found)
    doubt = mapper.registered & (np.bincount(mapper.image_unit[misled], minlength=units) > 0)
    # A scene of two units is the least to register others against.
    return np.flatnonzero(doubt) if (mapper.registered & ~doubt).sum() >= 2 else np.zeros(0, dtype=np.int64)


def without_keypoints(pairs: Sequence[PairMatches], first: Ints, removed: Bools) -> list[PairMatches]:
    """The pairs without the matches of some keypoints, and without pairs of which nothing is left.

    `first` (images + 1,) is as in `Keypoints`.
    """
    result = []
    for pair in pairs:
        gone = removed[first[pair.image_a] + pair.matches[:, 0]] | removed[first[pair.image_b] + pair.matches[:, 1]]
        left = pair.inliers & ~gone
        if left.any():
            result.append(replace(pair, inliers=left) if gone.any() else pair)
    return result


def _flows(mapper: Mapper, pairs: Sequence[PairMatches]) -> Iterator[tuple[Ints, Ints, Floats, Floats]]:
    """Expected and measured motion, in pixels, of the keypoints of every pair of one camera's images."""
    posed, keypoints = mapper.image_posed, mapper.keypoints
    world_from_cam = mapper.state.world_from_rig[mapper.image_unit] @ mapper.motion.unit_from_image(mapper.state)
    world_from_cam = world_from_cam @ mapper.state.rig_from_cam[mapper.image_camera]
    of_camera: dict[int, list[PairMatches]] = {}
    for pair in pairs:
        a, b = pair.image_a, pair.image_b
        along = mapper.image_unit[a] != mapper.image_unit[b] and mapper.image_camera[a] == mapper.image_camera[b]
        if along and posed[a] and posed[b]:
            of_camera.setdefault(int(mapper.image_camera[a]), []).append(pair)

    def flow(some: tuple[int, list[PairMatches]]) -> tuple[Ints, Ints, Floats, Floats]:
        camera, together = some
        edges, counts = matching_keypoints(keypoints.first, together)
        a, b = np.ascontiguousarray(edges.T)
        image_a, image_b = np.array([(pair.image_a, pair.image_b) for pair in together]).T
        xy_px, least_px = keypoints.xy_px.take(a, axis=0), np.empty(len(a))
        _least_flows_px(
            int(mapper.camera_kind[camera]),
            mapper.state.camera_params[camera],
            np.ascontiguousarray(mapper.state.rig_from_cam[camera, 2, :3]),
            keypoints.rays.take(a, axis=0),
            xy_px,
            np.repeat(np.arange(len(counts)), counts),
            se3.inverse(world_from_cam[image_b]) @ world_from_cam[image_a],
            least_px,
        )
        return a, b, least_px, np.hypot(*(keypoints.xy_px.take(b, axis=0) - xy_px).T)

    batches = [(camera, own[at : at + BATCH]) for camera, own in of_camera.items() for at in range(0, len(own), BATCH)]
    yield from mapped(mapper.config.threads, flow, batches)


@njit(cache=True, nogil=True)
def _vote(a: Any, b: Any, least_px: Any, moved_px: Any, along: Any, seen: Any, moves: Any) -> None:
    """Count a pair's matches of keypoints a and b (n,) for and against moving along, for both."""
    for n in range(len(a)):
        vote = 0
        if least_px[n] > MIN_FLOW_PX:
            vote = 1 if moved_px[n] < STILL_SHARE * least_px[n] else -1
        for k in (a[n], b[n]):
            along[k] += vote
            seen[k] = True
            if moved_px[n] > STILL_PX:
                moves[k] = True


@njit(cache=True, nogil=True)
def _least_flows_px(
    kind: int, params: Any, up: Any, rays: Any, xy_px: Any, of_pair: Any, b_from_a: Any, out: Any
) -> None:
    """Least motions (n,) of points of a static world between the images of their pairs, at whatever depth they are.

    Rays (n, 3) and pixels (n, 2) are of image a, `b_from_a` (pairs, 4, 4) of one camera at both instants. `up` (3,) is
    the rig's up direction in camera axes: it bounds the depth of rays that point down. The way from the deepest point
    to the nearest is followed in straight steps between DEPTHS knots, until it is as near as `MIN_FLOW_PX`; knots that
    the camera does not show are left out. Infinite where a point of the world could not be in front of camera b.
    """
    _follow_paths(kind, params, up, rays, xy_px, of_pair, b_from_a, out, np.empty(6), np.empty(8))


@uncounted()
def _follow_paths(
    kind: int, params: Any, up: Any, rays: Any, xy_px: Any, of_pair: Any, b_from_a: Any, out: Any, work: Any, proj: Any
) -> None:
    for i in range(len(rays)):
        m, d0, d1, d2 = b_from_a[of_pair[i]], rays[i, 0], rays[i, 1], rays[i, 2]
        falling, deepest = -(d0 * up[0] + d1 * up[1] + d2 * up[2]) - MAX_GRADE, FARTHEST_M
        if falling * FARTHEST_M > MAX_CAMERA_HEIGHT_M:
            deepest = max(MAX_CAMERA_HEIGHT_M / falling, NEAREST_M)
        t0 = m[0, 0] * d0 + m[0, 1] * d1 + m[0, 2] * d2
        t1 = m[1, 0] * d0 + m[1, 1] * d1 + m[1, 2] * d2
        t2 = m[2, 0] * d0 + m[2, 1] * d1 + m[2, 2] * d2
        best, before = np.inf, False
        u0, v0 = 0.0, 0.0
        for s in range(DEPTHS):
            part = s / (DEPTHS - 1)
            inverse = (1.0 - part) / deepest + part / NEAREST_M
            x, y, z = t0 / inverse + m[0, 3], t1 / inverse + m[1, 3], t2 / inverse + m[2, 3]
            if not project(kind, params, x, y, z, work, proj):
                before = False
                continue
            u, v = proj[0] - xy_px[i, 0], proj[1] - xy_px[i, 1]
            best = min(best, u * u + v * v)
            if before:
                du, dv = u - u0, v - v0
                at = -(u0 * du + v0 * dv) / max(du * du + dv * dv, 1e-12)
                if 0.0 < at < 1.0:
                    best = min(best, (u0 + at * du) ** 2 + (v0 + at * dv) ** 2)
            if best <= MIN_FLOW_PX * MIN_FLOW_PX:
                break
            u0, v0, before = u, v, True
        out[i] = math.sqrt(best)
