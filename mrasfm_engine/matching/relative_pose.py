"""Relative pose of two cameras with its covariance: the gate for matches that follows, and the correction they demand.

The error of a match is the Sampson distance [Hartley and Zisserman, Multiple View Geometry, 11.4.3]

    e = t . (g_a x g_b) / sqrt(|t x g_a|^2 + |t x g_b|^2)

in radians, with rays g in common axes and t from camera b to camera a. It is linear in t and nearly so in small
rotations, so a covariance of the poses gives its variance, and matches correct poses by Gauss-Newton steps under them
as a prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.types import Bools, Floats, Ints

GATE_SIGMAS = 3.0
MIN_BASELINE_M = 1e-6  # far below what any pose is known to, and far above what rounding leaves of its square
ITERATIONS = 40
INITIAL_DAMPING = 1e-3
CONVERGED = 0.1  # of what matches and prior leave uncertain
SETTLED = 0.99  # of the spread that errors had before
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
        error, by_rotation, by_shift, normal = epipolar_derivatives(self.base_from_a, self.base_from_b, rays_a, rays_b)
        return error, np.concatenate([*by_rotation, by_shift], axis=1), normal

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
        keep = np.linspace(0, len(rays_a) - 1, min(len(rays_a), MAX_REFINING)).astype(np.int64)
        rays_a, rays_b = rays_a[keep], rays_b[keep]
        variance, axes = np.linalg.eigh(self.covariance)
        whole = axes * np.sqrt(np.maximum(variance, 0.0))

        def errors(x: Floats) -> list[Errors]:
            error, jacobian, _ = self.corrected(whole @ x).linearise(rays_a, rays_b)
            return [Errors(rows=np.arange(9), error=error, jacobian=jacobian @ whole)]

        found = most_likely_correction(errors, 9, NarrowingSpread(sigma_rad))
        posterior = whole @ np.linalg.inv(np.eye(9) + found.information) @ whole.T
        moved = self.corrected(whole @ found.x)
        refined = RelativePose(base_from_a=moved.base_from_a, base_from_b=moved.base_from_b, covariance=posterior)
        return refined, float(found.x @ found.x)


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Errors (n,) that have one spread, and their derivatives (n, k) in the unknowns `rows` (k,).

    `variance` is what each has beside the spread, `weight` the share of an independent error that each counts as.
    """

    rows: Ints
    error: Floats
    jacobian: Floats
    variance: Floats | float = 0.0
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Most likely correction (k,) in a prior's standard deviations, and the errors' information (k, k) there."""

    x: Floats
    information: Floats


class Spread(Protocol):
    """Standard deviations (groups,) of the errors, from step to step."""

    def first(self, groups: Sequence[Errors]) -> Floats:
        """The spread to begin with."""
        ...

    def next(self, groups: Sequence[Errors], spread: Floats) -> Floats:
        """The spread after a step, never larger than before."""
        ...


@dataclass(frozen=True)
class MedianSpread:
    """The spread that the median of the errors has, for errors of unknown size; at least `at_least` (groups,)."""

    at_least: Floats

    def first(self, groups: Sequence[Errors]) -> Floats:
        """The spread to begin with."""
        return np.maximum(self.at_least, np.array([np.median(np.abs(group.error)) for group in groups]) / 0.6745)

    def next(self, groups: Sequence[Errors], spread: Floats) -> Floats:
        """The spread after a step, never larger than before."""
        result: Floats = np.minimum(spread, self.first(groups))
        return result


@dataclass(frozen=True)
class NarrowingSpread:
    """The spread of all errors first, halved from step to step down to a known one.

    So a pose far off is corrected before the matches that contradict it count as wrong.
    """

    at_last: float

    def first(self, groups: Sequence[Errors]) -> Floats:
        """The spread to begin with."""
        return np.array([max(self.at_last, float(np.sqrt((group.error**2).mean()))) for group in groups])

    def next(self, groups: Sequence[Errors], spread: Floats) -> Floats:
        """The spread after a step, never larger than before."""
        result: Floats = np.maximum(self.at_last, 0.5 * spread)
        return result


def most_likely_correction(errors: Callable[[Floats], Sequence[Errors]], size: int, by: Spread) -> Correction:
    """Minimise the errors under a Cauchy loss and a prior of unit variance, from zero on, by damped Gauss-Newton steps.

    `errors` gives the groups of errors at a correction (size,).
    """
    x, damping = np.zeros(size), INITIAL_DAMPING
    here = errors(x)
    spread = by.first(here)
    for _ in range(ITERATIONS):
        information, gradient, cost = _normal_equations(here, x, spread)
        damped = information + np.diag(1.0 + damping * np.diag(information))
        step = -np.linalg.solve(damped, gradient + x)
        there = errors(x + step)
        if _cost(there, x + step, spread) > cost:
            damping *= 10.0
            continue
        x, here, damping = x + step, there, 0.1 * damping
        narrower = by.next(here, spread)
        settled = bool((narrower > SETTLED * spread).all())
        spread = narrower
        if settled and step @ damped @ step < CONVERGED**2:
            break
    return Correction(x=x, information=_normal_equations(here, x, spread)[0])


def _normal_equations(groups: Sequence[Errors], x: Floats, spread: Floats) -> tuple[Floats, Floats, float]:
    """J' W J and J' W r of the errors, and half the cost with the prior's."""
    information, gradient = np.zeros((len(x), len(x))), np.zeros(len(x))
    for group, sigma in zip(groups, spread, strict=True):
        weight = group.weight / (sigma**2 + group.variance + group.error**2)
        weighted = weight[:, None] * group.jacobian
        information[np.ix_(group.rows, group.rows)] += group.jacobian.T @ weighted
        gradient[group.rows] += group.error @ weighted
    return information, gradient, _cost(groups, x, spread)


def _cost(groups: Sequence[Errors], x: Floats, spread: Floats) -> float:
    cost = 0.5 * float(x @ x)
    for group, sigma in zip(groups, spread, strict=True):
        cost += 0.5 * group.weight * float(np.log1p(group.error**2 / (sigma**2 + group.variance)).sum())
    return cost


def _forms(covariance: Floats, rows: Floats) -> Floats:
    """Variances (n,) of linear functions, given by rows (n, k), of what has a covariance (k, k)."""
    result: Floats = ((rows @ covariance) * rows).sum(1)
    return result


def epipolar_derivatives(
    rig_from_a: Floats, rig_from_b: Floats, rays_a: Floats, rays_b: Floats
) -> tuple[Floats, tuple[Floats, Floats], Floats, Floats]:
    """Sampson distances (n,) in rad of rays (n, 3) of two cameras, and their derivatives.

    These are (n, 3) each, in the rotations of a and b and in the place of a against b, all in rig axes; the last are
    the unit normals (n, 3) of the epipolar planes. Cameras nearer to one another than `MIN_BASELINE_M` are taken as so
    far apart: the distances are the same at any length of a baseline, and would all vanish with it.
    """
    a, b = rays_a @ rig_from_a[:3, :3].T, rays_b @ rig_from_b[:3, :3].T
    t = rig_from_a[:3, 3] - rig_from_b[:3, 3]
    baseline_m = float(np.linalg.norm(t))
    if baseline_m < MIN_BASELINE_M:
        t = MIN_BASELINE_M * (t / baseline_m if baseline_m > 0.0 else np.array([1.0, 0.0, 0.0]))
    # A product with a matrix takes a quarter of the time of np.cross.
    along_t = se3.skew(t).T
    across, ta, tb = _cross(a, b), a @ along_t, b @ along_t
    ta2 = (ta**2).sum(1)
    length = np.maximum(np.sqrt(ta2 + (tb**2).sum(1)), 1e-12)[:, None]
    normal = ta / np.maximum(np.sqrt(ta2), 1e-12)[:, None]
    by_rotation = -_cross(a, tb) / length, _cross(b, ta) / length
    return across @ t / length[:, 0], by_rotation, across / length, normal


def _cross(a: Floats, b: Floats) -> Floats:
    """np.cross of rows (n, 3), in half its time."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
