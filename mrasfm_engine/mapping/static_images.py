"""Static images while the vehicle moves, found from matches alone, before there are poses.

A lorry that fills an image and drives along has more and better matches than the static world, and it reaches into the
neighbouring views. It can win every vote on a unit's pose, and the unit then stands where the one before stood. So
cameras are compared first: where most of them have matches that show motion between two units, a camera whose ground is
static shows something else. The result only keeps such images from misleading the first poses; `dynamic_objects`
decides with poses, and names images.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints
from mrasfm_engine.types import Bools, Floats, Ints

STILL_PX = 2.0
MOVING_PX = 20.0  # that most of the matches that move exceed in a camera that shows motion; less does not tell
MIN_MATCHES = 30  # of a camera, before it says anything
MOVING_SHARE = 0.2  # of them, in a camera that shows motion
MIN_FALL = 0.14  # how steeply (sine) a ray must point down to meet the ground near by: 8 degrees
MIN_GROUND = 10  # matches on such rays
STILL_SHARE = 0.5  # of these


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

    def units(pair: PairMatches) -> tuple[int, int]:
        a, b = sorted((int(image_unit[pair.image_a]), int(image_unit[pair.image_b])))
        return a, b

    for _, group in groupby(sorted(same, key=units), key=units):
        quiet: list[Ints] = []
        moving = standing = 0
        for pair in group:
            a = keypoints.first[pair.image_a] + pair.matches[pair.inliers, 0].astype(np.int64)
            b = keypoints.first[pair.image_b] + pair.matches[pair.inliers, 1].astype(np.int64)
            flow_px = np.hypot(*(keypoints.xy_px.take(b, axis=0) - keypoints.xy_px.take(a, axis=0)).T)
            moves = flow_px > STILL_PX
            if len(flow_px) < MIN_MATCHES:
                continue
            if moves.mean() < MOVING_SHARE:
                standing += 1
            elif moves.sum() >= MIN_MATCHES and (flow_px > MOVING_PX).sum() > 0.5 * moves.sum():
                moving += 1
            ground = keypoints.rays[a] @ rig_from_cam[image_camera[pair.image_a], 2, :3] < -MIN_FALL
            if ground.sum() >= MIN_GROUND and moves[ground].mean() < STILL_SHARE:
                quiet += [a[~moves], b[~moves]]
        # A standing car that others drive past looks alike: then the cameras that show no motion are more.
        if quiet and moving >= max(standing, 1):
            result[np.concatenate(quiet)] = True
    return result
