"""Votes of a unit's cameras on the unit's pose, each by its own PnP.

A camera that is covered, or observes too few points, has no vote: no pose fits its points. A camera with a wrong
extrinsic has a vote that is well supported and far from the others; it is voted out by name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.types import Bools, Floats

VOTE_ROTATION_DEG = 1.0  # votes farther than this from the average are out
VOTE_TRANSLATION_M = 0.5


@dataclass(frozen=True, kw_only=True)
class Vote:
    """Pose of the unit by one camera."""

    camera: int
    world_from_rig: Floats  # (4, 4)
    inliers: int


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Pose on which the largest group of cameras agrees."""

    world_from_rig: Floats  # (4, 4)
    agreeing: Bools  # (votes,)


def largest_agreement(votes: list[Vote]) -> Agreement | None:
    """The average of the largest group of votes, of equally large ones the better supported; None without votes.

    The L1 average of all votes comes first (MRASfM, eq. 6): while most cameras are right it is near them. Without a
    majority (two cameras against two) it lies in between and is right for nobody, so the votes themselves are tried as
    well. Cameras count first, as one that sees much texture knows no better where it is mounted.
    """
    if not votes:
        return None
    poses = np.stack([vote.world_from_rig for vote in votes])
    inliers = np.array([vote.inliers for vote in votes], dtype=np.float64)
    average = se3.transform(robust_mean_rotation(poses[:, :3, :3]), geometric_median(poses[:, :3, 3]))
    groups = [agree(poses, centre) for centre in (average, *poses)]
    group = max(groups, key=lambda g: (g.sum(), inliers[g].sum()))
    weights = inliers[group]
    return Agreement(
        world_from_rig=se3.transform(
            se3.mean_rotation(poses[group, :3, :3], weights), np.average(poses[group, :3, 3], axis=0, weights=weights)
        ),
        agreeing=group,
    )


def agree(poses: Floats, pose: Floats) -> Bools:
    """Return which poses (n, 4, 4) of a unit equal another (4, 4), as far as single cameras can tell."""
    turned = se3.rotation_angle_deg(poses[:, :3, :3] @ pose[:3, :3].T)
    moved = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    result: Bools = (turned < VOTE_ROTATION_DEG) & (moved < VOTE_TRANSLATION_M)
    return result
