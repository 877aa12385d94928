"""Relative pose of two cameras with its covariance: the gate for matches that follows, and the correction they demand.

Errors of matches are those of `sampson`: a covariance of the poses gives their variance, and matches correct
poses under them as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.sampson import epipolar_derivatives, most_likely_pose
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.types import Bools, Floats

GATE_SIGMAS = 3.0
MAX_REFINING = 150  # matches: more say nothing new of a pose, as lens models are off by the same in all of them


@dataclass(frozen=True, kw_only=True)
class UncertainRig:
    """Poses of the cameras in the rig.

    Attributes
    ----------
    rig_from_cam
        (c, 4, 4)
    covariance
        (6 c, 6 c) of rotations (rad) and positions (m) along the rig's axes, camera by camera.
    """

    rig_from_cam: Floats
    covariance: Floats

    def relative_pose(self, a: int, b: int) -> RelativePose:
        """Cameras a and b of one instant."""
        return self.relative_pose_between(a, b, np.stack([np.eye(4)] * 2), np.zeros((12, 12)))

    def relative_pose_between(self, a: int, b: int, base_from_rig: Floats, covariance: Floats) -> RelativePose:
        """Camera a of one unit and camera b of another.

        Parameters
        ----------
        base_from_rig
            Poses (2, 4, 4) of the two units.
        covariance
            (12, 12) of rotation (rad) and position (m) of the one and of the other, along the axes of the base.
        """
        by_unit, by_camera = np.zeros((9, 12)), np.zeros((9, 12))
        for k, (camera, sign) in enumerate(((a, 1.0), (b, -1.0))):
            rotation, lever_m = base_from_rig[k, :3, :3], base_from_rig[k, :3, :3] @ self.rig_from_cam[camera, :3, 3]
            by_unit[3 * k : 3 * k + 3, 6 * k : 6 * k + 3] = np.eye(3)
            by_unit[6:, 6 * k : 6 * k + 6] = sign * np.concatenate([-se3.skew(lever_m), np.eye(3)], axis=1)
            by_camera[3 * k : 3 * k + 3, 6 * k : 6 * k + 3] = rotation
            by_camera[6:, 6 * k + 3 : 6 * k + 6] = sign * rotation
        rows = np.concatenate([6 * a + np.arange(6), 6 * b + np.arange(6)])
        of_cameras = self.covariance[np.ix_(rows, rows)]
        return RelativePose(
            base_from_a=base_from_rig[0] @ self.rig_from_cam[a],
            base_from_b=base_from_rig[1] @ self.rig_from_cam[b],
            covariance=by_unit @ covariance @ by_unit.T + by_camera @ of_cameras @ by_camera.T,
        )


@dataclass(frozen=True, kw_only=True)
class RelativePose:
    """Poses of two cameras in common axes.

    Attributes
    ----------
    base_from_a, base_from_b
        (4, 4)
    covariance
        (9, 9) of the rotations of a and of b (rad) and of the position of a against b (m), along the base's axes.
    """

    base_from_a: Floats
    base_from_b: Floats
    covariance: Floats

    @property
    def b_from_a(self) -> Floats:
        """Transform (4, 4) from camera a to camera b."""
        result: Floats = se3.inverse(self.base_from_b) @ self.base_from_a
        return result

    def fits(self, rays_a: Floats, rays_b: Floats, *, max_error: float) -> Bools:
        """Mask (n,) of the matches that meet in front of both cameras, near their epipolar lines.

        `max_error` (rad) is the keypoints' share of the gate; the covariance adds its own.
        """
        error, jacobian, normal = self.linearise(rays_a, rays_b)
        near = error**2 < max_error**2 + GATE_SIGMAS**2 * _forms(self.covariance, jacobian)
        slack = self.parallax_slack(normal, max_error=max_error)
        result: Bools = near & (signed_parallax(self.b_from_a, rays_a, rays_b) > -slack)
        return result

    def parallax_slack(self, normal: Floats, *, max_error: float) -> Floats:
        """Parallax (n,) in rad that keypoints and rotations may be off by.

        A turn about the epipolar plane's normal (n, 3) lets rays cross nearer or farther, or behind.
        """
        variance = _forms(self.covariance[:6, :6], np.concatenate([normal, -normal], axis=1))
        result: Floats = np.sqrt(max_error**2 + GATE_SIGMAS**2 * variance)
        return result

    def linearise(self, rays_a: Floats, rays_b: Floats) -> tuple[Floats, Floats, Floats]:
        """Errors (n,), their derivatives (n, 9), and the unit normals (n, 3) of the epipolar planes."""
        return epipolar_derivatives(self.base_from_a, self.base_from_b, rays_a, rays_b)

    def corrected(self, step: Floats) -> RelativePose:
        """The poses moved by rotations and a shift (9,), with the covariance as it is."""
        a, b = self.base_from_a.copy(), self.base_from_b.copy()
        a[:3, :3], b[:3, :3] = se3.exp_so3(step[:6].reshape(2, 3)) @ np.stack([a[:3, :3], b[:3, :3]])
        a[:3, 3] += step[6:]
        return RelativePose(base_from_a=a, base_from_b=b, covariance=self.covariance)

    def refined(self, rays_a: Floats, rays_b: Floats, *, sigma_rad: float) -> tuple[RelativePose, float]:
        """The most likely pose under matches and this one as prior, and how unlikely a prior that makes it.

        `sigma_rad` is the standard deviation of right matches. The second result is the squared length of the
        correction in the prior's standard deviations.
        """
        keep = even_choice(len(rays_a), MAX_REFINING)
        rays_a, rays_b = rays_a[keep], rays_b[keep]
        variance, axes = np.linalg.eigh(self.covariance)
        prior_root = axes * np.sqrt(np.maximum(variance, 0.0))
        x, information = most_likely_pose(self.base_from_a, self.base_from_b, rays_a, rays_b, prior_root, sigma_rad)
        posterior = prior_root @ np.linalg.inv(np.eye(9) + information) @ prior_root.T
        moved = self.corrected(prior_root @ x)
        refined = RelativePose(base_from_a=moved.base_from_a, base_from_b=moved.base_from_b, covariance=posterior)
        return refined, float(x @ x)


def _forms(covariance: Floats, rows: Floats) -> Floats:
    """Variances (n,) of linear functions, given by rows (n, k), of what has a covariance (k, k)."""
    result: Floats = ((rows @ covariance) * rows).sum(1)
    return result
