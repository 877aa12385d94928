"""Errors of an estimated trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid, align_similarity
from mrasfm_engine.types import Floats, Ints

MIN_POSES = 3
FIRST_UNITS = 5  # on which a route is aligned to see the error of its end
ARM_M = 10.0


@dataclass(frozen=True, kw_only=True)
class TrajectoryErrors:
    """Errors over poses that both trajectories have."""

    poses: int
    metric_rmse_m: float  # of positions after rigid alignment
    metric_median_m: float
    rotation_median_deg: float  # after removing the mean rotation between the trajectories
    similarity_rmse_m: float  # of positions after similarity alignment
    similarity_scale: float  # the factor that brings the estimate onto the truth


def match_timestamps(estimate_us: Ints, truth_us: Ints, *, tolerance_us: int) -> tuple[Ints, Ints]:
    """Pairs of nearest timestamps no farther apart than the tolerance, each timestamp used at most once.

    Parameters
    ----------
    estimate_us, truth_us
        Timestamps (n,) and (m,), each rising.

    Returns
    -------
    tuple
        Indices (k,) into `estimate_us` and (k,) into `truth_us`.
    """
    if not len(estimate_us) or not len(truth_us):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    right = np.clip(np.searchsorted(truth_us, estimate_us), 1, len(truth_us) - 1) if len(truth_us) > 1 else None
    if right is None:
        nearest = np.zeros(len(estimate_us), dtype=np.int64)
    else:
        closer_left = estimate_us - truth_us[right - 1] <= truth_us[right] - estimate_us
        nearest = np.where(closer_left, right - 1, right)
    distance = np.abs(estimate_us - truth_us[nearest])
    # Of estimates that share a truth, the nearest one has it.
    order = np.lexsort((distance, nearest))
    first = np.r_[True, nearest[order][1:] != nearest[order][:-1]]
    kept = np.sort(order[first & (distance[order] <= tolerance_us)])
    return kept.astype(np.int64), nearest[kept].astype(np.int64)


def compare_trajectories(estimate: Floats, truth: Floats) -> TrajectoryErrors:
    """Errors of estimated poses (n, 4, 4) `world_from_rig` against true ones (n, 4, 4) of the same instants.

    Positions are compared after one rigid and after one similarity alignment of all of them. Rotations are compared
    after removing the robust mean of `R_estimate R_truth^T`, not after the alignment of positions: those of a straight
    drive say nothing about roll.

    Raises
    ------
    ValueError
        Where shapes differ or there are fewer than 3 poses.
    """
    if estimate.shape != truth.shape or estimate.shape[1:] != (4, 4) or len(estimate) < MIN_POSES:
        raise ValueError(f"at least {MIN_POSES} poses (n, 4, 4) of both are needed: {estimate.shape}, {truth.shape}")
    positions, true_positions = estimate[:, :3, 3], truth[:, :3, 3]
    # Ratio 0: of a nearly straight drive, too, the alignment with the smallest error is wanted.
    rigid_alignment = align_rigid(true_positions, positions, collinear_ratio=0.0)
    rigid = np.linalg.norm(rigid_alignment.apply(positions) - true_positions, axis=1)
    alignment = align_similarity(true_positions, positions, collinear_ratio=0.0)
    similar = np.linalg.norm(alignment.apply(positions) - true_positions, axis=1)
    differences = estimate[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], -1, -2)
    residuals = se3.rotation_angle_deg(_mean_rotation(differences).T @ differences)
    return TrajectoryErrors(
        poses=len(estimate),
        metric_rmse_m=_rms(rigid),
        metric_median_m=float(np.median(rigid)),
        rotation_median_deg=float(np.median(residuals)),
        similarity_rmse_m=_rms(similar),
        similarity_scale=alignment.scale,
    )


def compare_known(estimate: Floats, truth: Floats) -> TrajectoryErrors | None:
    """`compare_trajectories` over the poses (n, 4, 4) that both know, others are NaN; None for fewer than 3."""
    known = np.isfinite(estimate[:, 0, 0]) & np.isfinite(truth[:, 0, 0])
    return compare_trajectories(estimate[known], truth[known]) if known.sum() >= MIN_POSES else None


def end_error_m(estimate: Floats, truth: Floats) -> float | None:
    """Distance of the last unit from its true place, after a rigid alignment on the first units' poses.

    Aligned are the first units' positions and points 10 m along each of their axes, so that rotations count as well: a
    few positions on a line leave the roll about it free. None where the last unit or all of the first ones are missing.

    Parameters
    ----------
    estimate, truth
        Poses (units, 4, 4); NaN for units that are not registered. A shorter estimate misses the last ones.
    """
    if len(estimate) < len(truth) or not np.isfinite(estimate[-1]).all():
        return None
    known = np.flatnonzero(np.isfinite(estimate[:FIRST_UNITS, 0, 0]))
    if not len(known):
        return None
    arms = np.concatenate([np.zeros((1, 3)), ARM_M * np.eye(3)])

    def points(poses: Floats) -> Floats:
        first = poses[known]
        result: Floats = (first[:, None, :3, :3] @ arms[..., None])[..., 0] + first[:, None, :3, 3]
        return result.reshape(-1, 3)

    aligned = align_rigid(points(truth), points(estimate)).a_from_b @ estimate[-1]
    return float(np.linalg.norm(aligned[:3, 3] - truth[-1, :3, 3]))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean_rotation(rotations: Floats, *, iterations: int = 20) -> Floats:
    """L1 mean (3, 3) of rotations (n, 3, 3) by iteratively reweighted chordal means.

    `averaging.robust_mean_rotation` starts from all pairs, which are too many for a long drive.
    Source: Hartley, Aftab and Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011.
    """
    mean = se3.mean_rotation(rotations)
    for _ in range(iterations):
        angles_rad = np.linalg.norm(se3.log_so3(mean.T @ rotations), axis=1)
        mean = se3.mean_rotation(rotations, 1 / np.maximum(angles_rad, 1e-6))
    return mean
