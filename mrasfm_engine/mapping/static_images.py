"""Static images while the vehicle moves, found from matches alone, before there are poses.

A lorry that fills an image and drives along has more and better matches than the static world, and it reaches into the
neighbouring views. It can win every vote on a unit's pose, and the unit then stands where the one before stood. So
cameras are compared first: where most of them have matches that show motion between two units, a camera whose ground is
static shows something else. The result only keeps such images from misleading the first poses; `dynamic_objects`
decides with poses, and names images.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints, matching_keypoints
from mrasfm_engine.types import Bools, Floats, Ints

STILL_PX = 2.0
MOVING_PX = 20.0  # that most of the matches that move exceed in a camera that shows motion; less does not tell
MIN_MATCHES = 30  # of a camera, before it says anything
MOVING_SHARE = 0.2  # of them, in a camera that shows motion
MIN_FALL = 0.14  # how steeply (sine) a ray must point down to meet the ground near by: 8 degrees
MIN_GROUND = 10  # matches on such rays
STILL_SHARE = 0.5  # of these
BATCH = 256  # pairs that are looked at together


def find_still_keypoints(
    keypoints: Keypoints, image_unit: Ints, image_camera: Ints, rig_from_cam: Floats, pairs: Sequence[PairMatches]
) -> Bools:
    """Keypoints (n,) that stand still in images whose ground stands still, while most cameras show motion.

    Parameters
    ----------
    image_unit, image_camera
        Of every image (i,).
    rig_from_cam
        Cameras (c, 4, 4); their horizons have to be right to some degrees only.
    pairs
        Verified matches; those of one camera at two instants tell.
    """
    result = np.zeros(len(keypoints.image), dtype=np.bool_)
    same = [p for p in pairs if image_camera[p.image_a] == image_camera[p.image_b]]
    if not same:
        return result
    shown = np.concatenate(
        [
            _shown(keypoints, image_camera, rig_from_cam, same[begin : begin + BATCH])
            for begin in range(0, len(same), BATCH)
        ]
    )
    count, moves, far, ground, ground_moves = shown.T
    tells = count >= MIN_MATCHES
    stands = tells & (moves < MOVING_SHARE * count)
    shows_motion = tells & ~stands & (moves >= MIN_MATCHES) & (far > 0.5 * moves)
    is_quiet = tells & (ground >= MIN_GROUND) & (ground_moves < STILL_SHARE * ground)
    # A standing car that others drive past looks alike: then the cameras that show no motion are more.
    units = np.sort(image_unit[[(pair.image_a, pair.image_b) for pair in same]], axis=1)
    of_units = np.unique(units, axis=0, return_inverse=True)[1].ravel()
    moving, standing = np.bincount(of_units, shows_motion), np.bincount(of_units, stands)
    for n in np.flatnonzero(is_quiet & (moving >= np.maximum(standing, 1))[of_units]).tolist():
        edges, _ = matching_keypoints(keypoints.first, [same[n]])
        result[edges[_flow_px(keypoints, edges) <= STILL_PX]] = True
    return result


def _shown(keypoints: Keypoints, image_camera: Ints, rig_from_cam: Floats, pairs: Sequence[PairMatches]) -> Ints:
    """Numbers (pairs, 5) of matches: all, those that move, those that move far, on the ground, and those there that
    move.
    """
    edges, counts = matching_keypoints(keypoints.first, pairs)
    of_pair, flow_px = np.repeat(np.arange(len(pairs)), counts), _flow_px(keypoints, edges)
    up = rig_from_cam[image_camera[[pair.image_a for pair in pairs]], 2, :3]
    ground = np.einsum("ni,ni->n", keypoints.rays.take(edges[:, 0], axis=0), up.take(of_pair, axis=0)) < -MIN_FALL
    moves = flow_px > STILL_PX
    kinds = (moves, flow_px > MOVING_PX, ground, ground & moves)
    return np.stack([counts, *(np.bincount(of_pair[kind], minlength=len(pairs)) for kind in kinds)], axis=1)


def _flow_px(keypoints: Keypoints, edges: Ints) -> Floats:
    """Lengths (n,) of the ways in the image from the first to the second of matching keypoints (n, 2)."""
    a, b = edges.T
    result: Floats = np.hypot(*(keypoints.xy_px.take(b, axis=0) - keypoints.xy_px.take(a, axis=0)).T)
    return result
