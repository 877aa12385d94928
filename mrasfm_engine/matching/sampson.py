"""Distances of matches from the epipolar lines of a relative pose, and the pose that they make most likely.

The error of a match is the Sampson distance [Hartley and Zisserman, Multiple View Geometry, 11.4.3]

    e = t . (g_a x g_b) / sqrt(|t x g_a|^2 + |t x g_b|^2)

in radians, with rays g in common axes and t from camera b to camera a. It is nearly linear in small changes of t and of
rotations, so that matches correct poses by Gauss-Newton steps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mrasfm_engine.geometry.small_cholesky import factorise, solve
from mrasfm_engine.jit import njit
from mrasfm_engine.matching.robust_correction import CONVERGED, INITIAL_DAMPING, ITERATIONS, SETTLED
from mrasfm_engine.types import Floats

MIN_BASELINE_M = 1e-6  # far below what any pose is known to, and far above what rounding leaves of its square
SMALL_RAD = 1e-6  # below, the series of a rotation's sine and cosine


def epipolar_derivatives(
    rig_from_a: Floats, rig_from_b: Floats, rays_a: Floats, rays_b: Floats
) -> tuple[Floats, Floats, Floats]:
    """Sampson distances (n,) in rad of rays (n, 3) of two cameras, and their derivatives (n, 9).

    These are by the rotations of a and of b and by the place of a against b, all in rig axes; the last are the unit
    normals (n, 3) of the epipolar planes. Cameras nearer to one another than `MIN_BASELINE_M` are taken as so far
    apart: the distances are the same at any length of a baseline, and would all vanish with it.
    """
    count = len(rays_a)
    error, derivatives, normal = np.empty(count), np.empty((count, 9)), np.empty((count, 3))
    _linearise(*_contiguous(rig_from_a, rig_from_b, rays_a, rays_b), error, derivatives, normal)
    return error, derivatives, normal


def most_likely_pose(
    base_from_a: Floats, base_from_b: Floats, rays_a: Floats, rays_b: Floats, prior_root: Floats, sigma_rad: float
) -> tuple[Floats, Floats]:
    """Correct two poses by matches under a Cauchy loss and a prior, by damped Gauss-Newton steps.

    The spread of the errors is that of all of them first, halved from step to step down to `sigma_rad`: so a pose far
    off is corrected before the matches that contradict it count as wrong.

    Parameters
    ----------
    prior_root
        Root (9, 9) of the prior's covariance, of the rotations of a and b and of the place of a against b.

    Returns
    -------
    x
        The correction (9,) in the prior's standard deviations.
    information
        That of the errors (9, 9), there.
    """
    x, information = np.zeros(9), np.zeros((9, 9))
    given = _contiguous(base_from_a, base_from_b, rays_a, rays_b, prior_root)
    _correct(*given, float(sigma_rad), x, information)
    return x, information


def _contiguous(*arrays: Floats) -> list[Floats]:
    return [np.ascontiguousarray(array, dtype=np.float64) for array in arrays]


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise(
    rig_from_a: Any, rig_from_b: Any, rays_a: Any, rays_b: Any, error: Any, derivatives: Any, normal: Any
) -> None:
    """See `epipolar_derivatives`."""
    t, a, b, ta, tb, across = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    baseline2 = 0.0
    for i in range(3):
        t[i] = rig_from_a[i, 3] - rig_from_b[i, 3]
        baseline2 += t[i] * t[i]
    baseline = math.sqrt(baseline2)
    if baseline == 0.0:
        t[0] = MIN_BASELINE_M
    elif baseline < MIN_BASELINE_M:
        for i in range(3):
            t[i] *= MIN_BASELINE_M / baseline
    for n in range(len(rays_a)):
        for i in range(3):
            a[i] = b[i] = 0.0
            for j in range(3):
                a[i] += rig_from_a[i, j] * rays_a[n, j]
                b[i] += rig_from_b[i, j] * rays_b[n, j]
        ta2 = tb2 = distance = 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            ta[i], tb[i] = t[j] * a[k] - t[k] * a[j], t[j] * b[k] - t[k] * b[j]
            across[i] = a[j] * b[k] - a[k] * b[j]
            ta2 += ta[i] * ta[i]
            tb2 += tb[i] * tb[i]
            distance += across[i] * t[i]
        length = max(math.sqrt(ta2 + tb2), 1e-12)
        error[n] = distance / length
        # How the length changes counts for matches far from their lines. As a and ta are perpendicular,
        # a x (ta x t) = ta (a . t), and likewise for b.
        share = error[n] / (length * length)
        along_a = along_b = 0.0
        for i in range(3):
            along_a += a[i] * t[i]
            along_b += b[i] * t[i]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            a_cross_ta, b_cross_tb = a[j] * ta[k] - a[k] * ta[j], b[j] * tb[k] - b[k] * tb[j]
            derivatives[n, i] = -(a[j] * tb[k] - a[k] * tb[j]) / length - share * along_a * ta[i]
            derivatives[n, 3 + i] = (b[j] * ta[k] - b[k] * ta[j]) / length - share * along_b * tb[i]
            derivatives[n, 6 + i] = across[i] / length - share * (a_cross_ta + b_cross_tb)
            normal[n, i] = ta[i] / max(math.sqrt(ta2), 1e-12)


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(pose: Any, by: Any, out: Any) -> None:
    """Turn a pose by a rotation vector, after Rodrigues."""
    angle2 = by[0] * by[0] + by[1] * by[1] + by[2] * by[2]
    angle = math.sqrt(angle2)
    if angle < SMALL_RAD:
        sine_share, versine_share = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        sine_share, versine_share = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    for column in range(3):
        along = versine_share * (by[0] * pose[0, column] + by[1] * pose[1, column] + by[2] * pose[2, column])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            across = by[j] * pose[k, column] - by[k] * pose[j, column]
            out[i, column] = (1.0 - versine_share * angle2) * pose[i, column] + sine_share * across + along * by[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _correct(
    base_from_a: Any,
    base_from_b: Any,
    rays_a: Any,
    rays_b: Any,
    prior_root: Any,
    sigma: float,
    x: Any,
    information: Any,
) -> None:
    """See `most_likely_pose`."""
    count = len(rays_a)
    moved_a, moved_b, moved, correction = base_from_a.copy(), base_from_b.copy(), np.empty(9), np.empty(9)
    error, derivatives, normal = np.empty(count), np.empty((count, 9)), np.empty((count, 3))
    damped, factor, gradient, step = np.empty((9, 9)), np.empty((9, 9)), np.empty(9), np.empty(9)
    _linearise(base_from_a, base_from_b, rays_a, rays_b, error, derivatives, normal)
    spread = max(sigma, math.sqrt((error * error).sum() / max(count, 1)))
    cost = _cost(error, x, spread)
    _normal_equations(error, derivatives, prior_root, spread, information, gradient)
    damping = INITIAL_DAMPING
    for _ in range(ITERATIONS):
        damped[:] = information
        for i in range(9):
            damped[i, i] += 1.0 + damping * information[i, i]
            step[i] = -(gradient[i] + x[i])
        if not factorise(damped, 9, factor):  # rays that are no numbers
            x[:] = np.nan
            break
        solve(factor, step, 9, step)
        moved[:] = x + step
        correction[:] = 0.0
        for i in range(9):
            for j in range(9):
                correction[i] += prior_root[i, j] * moved[j]
        _turn(base_from_a, correction[:3], moved_a)
        _turn(base_from_b, correction[3:6], moved_b)
        moved_a[:3, 3] = base_from_a[:3, 3] + correction[6:]
        _linearise(moved_a, moved_b, rays_a, rays_b, error, derivatives, normal)
        if not _cost(error, moved, spread) <= cost:  # a NaN is no step either
            damping *= 10.0
            continue
        x[:] = moved
        damping *= 0.1
        length2 = 0.0
        for i in range(9):
            for j in range(9):
                length2 += step[i] * damped[i, j] * step[j]
        narrower = max(sigma, 0.5 * spread)
        settled = narrower > SETTLED * spread
        spread = narrower
        cost = _cost(error, x, spread)
        _normal_equations(error, derivatives, prior_root, spread, information, gradient)
        if settled and length2 < CONVERGED**2:
            break


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(
    error: Any, derivatives: Any, prior_root: Any, spread: float, information: Any, gradient: Any
) -> None:
    """J' W J and J' W r of the errors, by the prior's standard deviations."""
    row = np.empty(9)
    information[:] = 0.0
    gradient[:] = 0.0
    for n in range(len(error)):
        weight = 1.0 / (spread * spread + error[n] * error[n])
        row[:] = 0.0
        for i in range(9):
            for j in range(9):
                row[j] += derivatives[n, i] * prior_root[i, j]
        for i in range(9):
            gradient[i] += weight * error[n] * row[i]
            for j in range(9):
                information[i, j] += weight * row[i] * row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _cost(error: Any, x: Any, spread: float) -> float:
    """Half of the Cauchy loss of the errors and of the prior's."""
    result = 0.0
    for i in range(len(x)):
        result += x[i] * x[i]
    for n in range(len(error)):
        result += math.log1p(error[n] * error[n] / (spread * spread))
    return 0.5 * result
