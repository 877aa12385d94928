"""Errors of estimated camera poses and of a camera set's calibration, for measurements and their tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid
from mrasfm_engine.types import Floats


@dataclass(frozen=True, kw_only=True)
class CameraPoseErrors:
    """Errors of camera poses after one rigid alignment of all camera centres."""

    translation_m: Floats  # (n,)
    rotation_deg: Floats  # (n,)
    truth_from_estimate: Floats  # (4, 4)

    @property
    def translation_max_m(self) -> float:
        """Largest distance of a camera centre from the truth."""
        return float(self.translation_m.max())

    @property
    def translation_median_m(self) -> float:
        """Median distance of a camera centre from the truth."""
        return float(np.median(self.translation_m))

    @property
    def rotation_max_deg(self) -> float:
        """Largest angle between a camera's rotation and the true one."""
        return float(self.rotation_deg.max())

    @property
    def rotation_median_deg(self) -> float:
        """Median angle between a camera's rotation and the true one."""
        return float(np.median(self.rotation_deg))


@dataclass(frozen=True, kw_only=True)
class CameraPairError:
    """Error of one camera's pose relative to another's."""

    camera_a: str
    camera_b: str
    rotation_deg: float
    translation_m: float


def compare_camera_poses(estimate: Floats, truth: Floats) -> CameraPoseErrors:
    """Errors of every estimated `world_from_cam` (n, 4, 4) after one rigid alignment fitted on all camera centres.

    Raises
    ------
    ValueError
        Where shapes differ or there are no poses.
    """
    if estimate.shape != truth.shape or estimate.shape[1:] != (4, 4) or not len(estimate):
        raise ValueError(f"poses (n, 4, 4) of both are needed: {estimate.shape}, {truth.shape}")
    truth_from_estimate = align_rigid(truth[:, :3, 3], estimate[:, :3, 3]).a_from_b
    aligned = truth_from_estimate @ estimate
    return CameraPoseErrors(
        translation_m=np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1),
        rotation_deg=se3.rotation_angle_deg(np.swapaxes(truth[:, :3, :3], -1, -2) @ aligned[:, :3, :3]),
        truth_from_estimate=truth_from_estimate,
    )


def compare_calibrations(estimate: Mapping[str, Floats], truth: Mapping[str, Floats]) -> list[CameraPairError]:
    """Errors of `cam_a_from_cam_b` of every pair of cameras that both calibrations have.

    Pairs, because a common motion of all cameras against the rig frame is a gauge: images do not see it.

    Parameters
    ----------
    estimate, truth
        `rig_from_cam` (4, 4) by camera name.

    Raises
    ------
    ValueError
        Where the calibrations have fewer than two cameras in common.
    """
    names = [name for name in estimate if name in truth]
    if len(names) < 2:
        raise ValueError("two cameras that both calibrations name are needed")
    errors = []
    for a, b in combinations(names, 2):
        estimated = se3.inverse(estimate[a]) @ estimate[b]
        true = se3.inverse(truth[a]) @ truth[b]
        errors.append(
            CameraPairError(
                camera_a=a,
                camera_b=b,
                rotation_deg=float(se3.rotation_angle_deg(true[:3, :3].T @ estimated[:3, :3])),
                translation_m=float(np.linalg.norm(estimated[:3, 3] - true[:3, 3])),
            )
        )
    return errors
