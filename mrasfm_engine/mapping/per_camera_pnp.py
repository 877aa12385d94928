"""Votes of a unit's cameras on the unit's pose, each by its own PnP and with its covariance.

A camera that is covered, or observes too few points, has no vote: no pose fits its points. A camera with a wrong
extrinsic has a vote that is well supported and far from the others; it is voted out by name.

Two votes agree by a chi-square test on the six degrees of freedom of their difference. A vote is uncertain by its PnP
and by its camera's `rig_from_cam`. The prior's sigma of the latter is an upper bound: a camera that is 3 deg off passes
for likely under a prior of 2 deg, also where all other cameras agree to a tenth of a degree. So the share of the
prior's sigma that the cameras really are apart by is estimated from the votes of the half that agrees best, as
`bundle_adjustment.priors.robust_gauge_weights` compares a camera with how far cameras are off as a rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.types import Bools, Floats

DOF = 6
DISAGREEMENT = 1e-3  # chance that votes of one pose count as different: a rig of a few cameras errs once in 100 units
SPREAD_STEPS = 12  # of bisection between nothing and the prior's sigma


@dataclass(frozen=True, kw_only=True)
class Vote:
    """Pose of the unit by one camera.

    Covariances are of steps [omega, tau] of the unit's pose in world axes: R becomes exp(omega) R, t becomes t + tau.
    """

    camera: int
    world_from_rig: Floats  # (4, 4)
    inliers: int
    pnp_covariance: Floats  # (6, 6)
    calibration_covariance: Floats  # (6, 6) by the prior of the camera's rig_from_cam


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """Pose of the unit by its motion; the covariance as that of a vote."""

    world_from_rig: Floats  # (4, 4)
    covariance: Floats  # (6, 6)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Pose on which the largest group of cameras agrees."""

    world_from_rig: Floats  # (4, 4)
    agreeing: Bools  # (votes,)
    by_motion: bool = False  # the expected pose contradicts a better supported group of as many cameras


def calibration_covariance(
    world_from_rig: Floats, camera_position_m: Floats, *, sigma_rotation_rad: float, sigma_translation_m: float
) -> Floats:
    """Covariance (6, 6) of a unit's pose that one camera tells, by the prior of that camera's `rig_from_cam`.

    With steps delta, nu of `rig_from_cam` in rig axes and the camera where it is in the world, the unit's pose moves by

        omega = -R delta        tau = -R nu - R [t_c]x delta
    """
    rotation = world_from_rig[:3, :3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = rotation
    jacobian[3:, :3] = rotation @ se3.skew(camera_position_m)
    jacobian *= np.repeat([sigma_rotation_rad, sigma_translation_m], 3)
    result: Floats = jacobian @ jacobian.T
    return result


def largest_agreement(votes: list[Vote], expected: Expectation | None = None) -> Agreement | None:
    """The average of the largest group of votes, of equally large ones the better supported; None without votes.

    Of equally large groups, those that an expected pose agrees with come first. Two cameras that differ have no
    majority, and an image of another instant observes as many points as the right one of the other camera.

    The L1 average of all votes comes first (MRASfM, eq. 6): while most cameras are right it is near them. Without a
    majority (two cameras against two) it lies in between and is right for nobody, so the votes themselves are tried as
    well. Cameras count first, as one that sees much texture knows no better where it is mounted; in the average every
    vote has the weight of its information.
    """
    if not votes:
        return None
    poses = np.stack([vote.world_from_rig for vote in votes])
    inliers = np.array([vote.inliers for vote in votes], dtype=np.float64)
    average = se3.transform(robust_mean_rotation(poses[:, :3, :3]), geometric_median(poses[:, :3, 3]))
    spread = calibration_spread(votes)
    covariance = _covariances(votes, spread)
    groups = [_near(votes, covariance, average, spread)]
    groups += [_near(votes, covariance + own, pose, spread) for own, pose in zip(covariance, poses, strict=True)]
    groups.sort(key=lambda g: (g.sum(), inliers[g].sum()), reverse=True)
    largest = [g for g in groups if g.sum() == groups[0].sum()]
    means = [_mean(poses[g], covariance[g]) for g in largest]
    chosen = 0
    if expected is not None:
        apart = [expected.covariance + np.linalg.inv(np.linalg.inv(covariance[g]).sum(0)) for g in largest]
        squares = squared_lengths(_differences(np.stack(means), expected.world_from_rig), np.stack(apart))
        chosen = int(np.argmax(squares <= chdtri(DOF, DISAGREEMENT)))  # the first one that agrees; none: the first
    return Agreement(world_from_rig=means[chosen], agreeing=largest[chosen], by_motion=chosen > 0)


def agree(votes: list[Vote], world_from_rig: Floats) -> Bools:
    """Return which votes (n,) are for a pose (4, 4) of the unit, as far as single cameras can tell."""
    spread = calibration_spread(votes)
    return _near(votes, _covariances(votes, spread), world_from_rig, spread)


def calibration_spread(votes: list[Vote]) -> float:
    """Share of their priors' sigmas by which the calibrations of the voting cameras are apart, at most 1.

    The differences of the half of the cameras that agrees best are as large as chance has them [an order statistic of
    pairwise differences, as Q_n by Rousseeuw and Croux, Alternatives to the Median Absolute Deviation, 1993]. What PnP
    explains is not counted. Two cameras have no majority, and the prior holds.
    """
    half = _half(votes)
    if half < 2:
        return 1.0
    a, b = np.triu_indices(len(votes), 1)
    rank = half * (half - 1) // 2
    expected = float(chdtri(DOF, 1.0 - rank / (len(a) + 1.0)))
    poses = np.stack([vote.world_from_rig for vote in votes])
    difference = _differences(poses[a], poses[b])
    low, high = 0.0, 1.0
    for _ in range(SPREAD_STEPS):
        middle = 0.5 * (low + high)
        covariance = _covariances(votes, middle)
        squares = squared_lengths(difference, covariance[a] + covariance[b])
        low, high = (middle, high) if np.partition(squares, rank - 1)[rank - 1] > expected else (low, middle)
    return high


def _half(votes: list[Vote]) -> int:
    return (len(votes) + 1) // 2


def _limit(votes: list[Vote], spread: float) -> float:
    """Limit of squared differences: by the prior a chi-square, by an estimated spread the F distribution's."""
    if spread >= 1.0:
        return float(chdtri(DOF, DISAGREEMENT))
    return DOF * float(fdtri(DOF, DOF * (_half(votes) - 1), 1.0 - DISAGREEMENT))


def _near(votes: list[Vote], covariance: Floats, world_from_rig: Floats, spread: float) -> Bools:
    poses = np.stack([vote.world_from_rig for vote in votes])
    result: Bools = squared_lengths(_differences(poses, world_from_rig), covariance) <= _limit(votes, spread)
    return result


def _covariances(votes: list[Vote], spread: float) -> Floats:
    """Covariances (n, 6, 6) of the votes with a share of the prior's sigma of the calibration."""
    return np.stack([vote.pnp_covariance + spread**2 * vote.calibration_covariance for vote in votes])


def _differences(poses: Floats, others: Floats) -> Floats:
    """Steps [omega, tau] (n, 6) from other poses to poses (n, 4, 4)."""
    turn = se3.log_so3(poses[..., :3, :3] @ np.swapaxes(others[..., :3, :3], -1, -2))
    return np.concatenate([turn, poses[..., :3, 3] - others[..., :3, 3]], axis=-1)


def squared_lengths(differences: Floats, covariances: Floats) -> Floats:
    """Squared Mahalanobis lengths (n,) of differences (n, 6)."""
    solved = np.linalg.solve(covariances, differences[..., None])[..., 0]
    result: Floats = (differences * solved).sum(-1)
    return result


def _mean(poses: Floats, covariances: Floats) -> Floats:
    """Mean (4, 4) of poses (n, 4, 4), weighted by their information."""
    start = se3.transform(se3.mean_rotation(poses[:, :3, :3]), poses[:, :3, 3].mean(0))
    information = np.linalg.inv(covariances)
    weighted = (information @ _differences(poses, start)[..., None]).sum(0)[:, 0]
    step = np.linalg.solve(information.sum(0), weighted)
    return se3.transform(se3.exp_so3(step[:3]) @ start[:3, :3], start[:3, 3] + step[3:])
