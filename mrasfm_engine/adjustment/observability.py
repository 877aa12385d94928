"""How well the adjustment knows what it estimated: marginal covariances, scale, and what is only the prior."""

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

OBSERVED_RATIO = 0.5  # a direction counts as observed when its posterior sigma is below this share of the prior's


@dataclass(frozen=True, kw_only=True)
class Covariances:
    """Marginal standard deviations and the covariance of the reduced unknowns."""

    sigma_unit_position_m: Floats  # (u, 3), NaN for fixed units
    sigma_unit_rotation_rad: Floats  # (u, 3)
    sigma_camera: Floats  # (c, 7) rotation (rad), translation (m), log focal; NaN for fixed cameras
    sigma_scale: float  # relative, of the trajectory's size


def covariances(problem: Problem, state: State) -> Covariances:
    """Marginals at a solution, from the inverse of the reduced normal equations (Gauss-Newton, robust weights).

    Scale is the functional sum (p_i - mean)' dp_i / sum |p_i - mean|^2 of the free units' positions: it does not change
    when the scene is moved or turned.
    """
    layout = problem.layout
    reduced = problem.normal_equations(state, 0.0)
    free = np.setdiff1d(np.arange(layout.size), layout.held())
    a = reduced.matrix[np.ix_(free, free)]
    # Scaled to a unit diagonal first: metres and radians differ by orders of magnitude.
    d = 1.0 / np.sqrt(np.maximum(np.diagonal(a), 1e-300))
    scaled = a * d[:, None] * d[None, :]
    try:
        inverse = np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(scaled, lower=True), np.eye(len(free))))
    except np.linalg.LinAlgError:
        inverse = np.asarray(np.linalg.pinv(scaled, hermitian=True))
    covariance = np.zeros((layout.size, layout.size))
    covariance[np.ix_(free, free)] = inverse * d[:, None] * d[None, :]
    variance = np.maximum(np.diagonal(covariance), 0.0)
    units, cameras = np.flatnonzero(layout.unit_slot >= 0), np.flatnonzero(layout.camera_slot >= 0)
    split = UNIT_DOF * layout.num_units
    per_unit = np.full((len(layout.unit_slot), UNIT_DOF), np.nan)
    per_unit[units] = np.sqrt(variance[:split]).reshape(-1, UNIT_DOF)
    per_camera = np.full((len(layout.camera_slot), CAMERA_DOF), np.nan)
    per_camera[cameras] = np.sqrt(variance[split:]).reshape(-1, CAMERA_DOF)
    return Covariances(
        sigma_unit_position_m=per_unit[:, 3:],
        sigma_unit_rotation_rad=per_unit[:, :3],
        sigma_camera=per_camera,
        sigma_scale=_sigma_scale(state.unit_position_m[units], covariance[:split, :split]),
    )


def _sigma_scale(position: Floats, covariance: Floats) -> float:
    if len(position) < 2:
        return float("nan")
    centred = position - position.mean(0)
    functional = np.zeros((len(position), UNIT_DOF))
    functional[:, 3:] = centred / max(float((centred**2).sum()), 1e-12)
    row = functional.ravel()
    return float(np.sqrt(max(float(row @ covariance @ row), 0.0)))


def observed_directions(sigma_camera: Floats, sigma_rotation_rad: Floats, sigma_translation_m: Floats) -> Bools:
    """Which directions (c, 6) of the cameras' poses the drive observed; the rest is only the prior."""
    prior = np.repeat(np.stack([sigma_rotation_rad, sigma_translation_m], 1), 3, axis=1)
    result: Bools = sigma_camera[:, :6] < OBSERVED_RATIO * prior
    return result
