"""Matches of pairs of units by which motions of cameras are compared, and the cameras that these compare."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.matching.relative_pose import UncertainRig
from mrasfm_engine.matching.verification import parallax_rad
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Floats

MAX_MOTIONS = 30  # more say little: lens models err alike in all of them
# Of two images. Simulated cameras of 0.4 px noise see directions of motion 1.5 deg apart by 20 matches, 0.7 by 40 and
# 0.4 by 160. Cameras that are turned by 6 deg are found to within 4.2 deg by 10, 1.5 by 40 and 1.2 by 160.
MAX_MATCHES = 40
MIN_PARALLAX_RAD = np.radians(0.5)  # median: less are some pixels, which do not determine a direction of motion
DETERMINED = 0.5  # of the standard deviation of a turn between two cameras: what is left where their images show it


@dataclass(frozen=True, kw_only=True)
class MotionMatches:
    """Viewing rays (n, 3), in camera axes, of matches between two images of two units."""

    motion: int  # number of the pair of units
    camera_a: int  # in the earlier unit
    camera_b: int
    rays_a: Floats
    rays_b: Floats


def groups_that_share_views(rig: UncertainRig) -> list[int]:
    """Number of each camera's group, in which simultaneous images determine the rotations against one another.

    They do where they leave less than half of what is uncertain of the two cameras: matches of one instant show that
    better than motions.
    """
    turns = rig.covariance.reshape(len(rig.rig_from_cam), 6, -1, 6)[:, :3, :, :3].swapaxes(1, 2)
    group = list(range(len(turns)))
    for a, b in combinations(group.copy(), 2):
        own = turns[a, a] + turns[b, b]
        between, alone = (np.linalg.eigvalsh(each)[-1] for each in (own - turns[a, b] - turns[b, a], own))
        if between < DETERMINED**2 * alone:
            group = [group[a] if of == group[b] else of for of in group]
    return group


def motion_matches(
    drive: Drive,
    pairs: Sequence[PairMatches],
    groups: Sequence[int],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    config: MatchConfig,
) -> tuple[list[MotionMatches], Floats]:
    """Matches of pairs of units that cameras of two groups match, evenly over the drive, and the times (m,) between."""
    between: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in pairs:
        u, v = sorted(drive.images[image].unit for image in (pair.image_a, pair.image_b))
        if u < v and np.count_nonzero(pair.inliers) >= config.min_matches:
            between.setdefault((u, v), []).append(pair)
    several = sorted(
        units
        for units, own in between.items()
        if len({groups[camera] for camera in _cameras_by_themselves(drive, own)}) > 1
    )
    result, elapsed_s = list[MotionMatches](), list[float]()
    for row in even_choice(len(several), MAX_MOTIONS).tolist():
        u, v = several[row]
        for pair in between[u, v]:
            a, b = (drive.images[image] for image in (pair.image_a, pair.image_b))
            rays_a, rays_b = rays_of(pair)
            if a.camera == b.camera and parallax_rad(rays_a, rays_b) < MIN_PARALLAX_RAD:
                continue
            if a.unit > b.unit:
                a, b, rays_a, rays_b = b, a, rays_b, rays_a
            keep = even_choice(len(rays_a), MAX_MATCHES)
            result.append(
                MotionMatches(
                    motion=len(elapsed_s),
                    camera_a=a.camera,
                    camera_b=b.camera,
                    rays_a=rays_a[keep],
                    rays_b=rays_b[keep],
                )
            )
        elapsed_s.append(float(drive.timestamps_us[v] - drive.timestamps_us[u]) / 1e6)
    return result, np.array(elapsed_s)


def _cameras_by_themselves(drive: Drive, pairs: Sequence[PairMatches]) -> set[int]:
    """Cameras that match images of their own."""
    ends = ([drive.images[image].camera for image in (pair.image_a, pair.image_b)] for pair in pairs)
    return {a for a, b in ends if a == b}
