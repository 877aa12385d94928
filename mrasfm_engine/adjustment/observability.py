"""How well the adjustment knows what it estimated: marginal covariances, and scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mrasfm_engine.adjustment.problem import CAMERA_DOF, UNIT_DOF
from mrasfm_engine.adjustment.solver import Problem
from mrasfm_engine.scene.state import State

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SINGULAR = 1e-11  # pivots and eigenvalues of the scaled matrix below this are rounding


@dataclass(frozen=True, kw_only=True)
class Covariances:
    """Marginal standard deviations; infinite where nothing determines an unknown."""

    sigma_unit_position_m: Floats  # (u, 3), NaN for fixed units
    sigma_camera: Floats  # (c, 7) rotation (rad), translation (m), log focal; NaN for fixed cameras
    sigma_scale: float  # relative, of the trajectory's size
    calibration: Floats  # (6 c, 6 c) joint covariance of the free cameras' rotations and translations, camera by camera


def covariances(problem: Problem, state: State) -> Covariances:
    """Marginals at a solution, from the inverse of the reduced normal equations (Gauss-Newton, robust weights).

    Scale is the functional sum (p_i - mean)' dp_i / sum |p_i - mean|^2 of the free units' positions: it does not change
    when the scene is moved or turned. What nothing determines has an infinite sigma.
    """
    layout = problem.layout
    reduced = problem.normal_equations(state, 0.0)
    free = np.setdiff1d(np.arange(layout.size), layout.held())
    free = free[np.diagonal(reduced.matrix)[free] > 0.0]
    inverse, loose = _inverse(reduced.matrix[np.ix_(free, free)])
    variance = np.full(layout.size, np.inf)
    variance[layout.held()] = 0.0
    variance[free] = np.where(loose, np.inf, np.maximum(np.diagonal(inverse), 0.0))
    covariance = np.zeros((layout.size, layout.size))
    covariance[np.ix_(free, free)] = inverse
    units, cameras = np.flatnonzero(layout.unit_slot >= 0), np.flatnonzero(layout.camera_slot >= 0)
    split = UNIT_DOF * layout.num_units
    per_unit = np.full((len(layout.unit_slot), UNIT_DOF), np.nan)
    per_unit[units] = np.sqrt(variance[:split]).reshape(-1, UNIT_DOF)
    per_camera = np.full((len(layout.camera_slot), CAMERA_DOF), np.nan)
    per_camera[cameras] = np.sqrt(variance[split:]).reshape(-1, CAMERA_DOF)
    positions = np.isinf(variance[:split]).reshape(-1, UNIT_DOF)[:, 3:]
    poses = split + (CAMERA_DOF * np.arange(layout.num_cameras)[:, None] + np.arange(6)).ravel()
    loose_poses = np.isinf(variance[poses])
    covariance[poses[loose_poses], poses[loose_poses]] = np.inf
    return Covariances(
        sigma_unit_position_m=per_unit[:, 3:],
        sigma_camera=per_camera,
        sigma_scale=np.inf
        if positions.any()
        else _sigma_scale(state.unit_position_m[units], covariance[:split, :split]),
        calibration=covariance[np.ix_(poses, poses)],
    )


def _inverse(matrix: Floats) -> tuple[Floats, Bools]:
    """Inverse (n, n) of a symmetric matrix without its null space, and which unknowns (n,) take part in that."""
    n = len(matrix)
    if n == 0:
        return matrix, np.zeros(0, dtype=np.bool_)
    # Scaled to a unit diagonal first: metres and radians differ by orders of magnitude.
    d = 1.0 / np.sqrt(np.diagonal(matrix))
    scaled = matrix * d[:, None] * d[None, :]
    loose = np.zeros(n, dtype=np.bool_)
    try:
        factor = scipy.linalg.cho_factor(scaled, lower=True)
        regular = float((np.diagonal(factor[0]) ** 2).min()) > SINGULAR
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        inverse = np.asarray(scipy.linalg.cho_solve(factor, np.eye(n)))
    else:
        values, vectors = scipy.linalg.eigh(scaled)
        null = values < SINGULAR * values[-1]
        loose = (vectors[:, null] ** 2).sum(1) > 1e-9
        inverse = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T
    result: Floats = inverse * d[:, None] * d[None, :]
    return result, loose


def _sigma_scale(position: Floats, covariance: Floats) -> float:
    if len(position) < 2:
        return float("nan")
    centred = position - position.mean(0)
    functional = np.zeros((len(position), UNIT_DOF))
    functional[:, 3:] = centred / max(float((centred**2).sum()), 1e-12)
    row = functional.ravel()
    return float(np.sqrt(max(float(row @ covariance @ row), 0.0)))
