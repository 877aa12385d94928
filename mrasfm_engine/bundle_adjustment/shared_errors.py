"""Covariance that errors add which the observations of an image share, or those of a point.

The inverse of the normal equations H is the covariance of an adjustment whose observations err independently. Those of
an image do not where its pose is not what the model makes of it: the vehicle does not move between units as
interpolated, the shutter rolls, a lorry fills the view. Those of a point do not where its neighbourhood draws keypoints
to one side in image after image. It shows in the scores s = sum J' w r of images and of points. Of independent errors
their squares M = sum s s' have the expectation F, the observations' part of H, so that

    H^-1 (M - F) H^-1

is what shared errors add [the sandwich of Huber and White, by clusters: Liang and Zeger, Longitudinal Data Analysis
Using Generalized Linear Models, Biometrika 1986]: those of images and those of points one to another, in those
directions in which they add something [two ways of clustering: Cameron, Gelbach and Miller, Robust Inference With
Multiway Clustering, Journal of Business and Economic Statistics 2011]. The scores of images are of whole units: a
unit's pose has absorbed what its images share.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats

MIN_UNITS = 10  # beyond those that units and cameras absorb: fewer tell no covariance
POINT_GROUPS = 4096  # points that share nothing add up to as much as one by one; so many tell a variance to 2 %


def shared_error_covariance(
    problem: Problem, state: State, system: ReducedCameraSystem, columns: Floats, covariance: Floats
) -> Floats:
    """Covariance (k, k) that shared errors add to that of k functionals f of the reduced vector; not negative.

    Parameters
    ----------
    state, system
        A solution and its normal equations, without damping.
    columns
        (n, k) H^-1 f of every functional.
    covariance
        (k, k) f' H^-1 f of all pairs of functionals.
    """
    _, unit = np.unique(problem.observations.unit, return_inverse=True)
    units = int(unit.max(initial=-1)) + 1
    if units < MIN_UNITS or not covariance.any():
        return np.zeros_like(covariance)
    of_units = problem.scores(state, system, columns, unit)
    of_points = problem.scores(state, system, columns, problem.observations.point % POINT_GROUPS)
    independent = covariance - _of_terms(problem, state, columns)
    added = units / (units - 1) * of_units.T @ of_units - independent + (of_points.T @ of_points - independent)
    sigma = np.sqrt(np.diagonal(covariance))
    by_sigma = np.where(sigma > 0.0, 1.0 / np.where(sigma > 0.0, sigma, 1.0), 0.0)
    values, vectors = np.linalg.eigh(added * by_sigma * by_sigma[:, None])
    spread = vectors * np.sqrt(np.maximum(values, 0.0)) * sigma[:, None]
    result: Floats = spread @ spread.T
    return result


def _of_terms(problem: Problem, state: State, columns: Floats) -> Floats:
    """X' E X (k, k) of the columns X and the information E of all terms that are not image observations."""
    extra = Extra.none(problem.layout)
    for term in problem.terms:
        term.add_to(state, problem.layout, extra)
    split = UNIT_DOF * problem.layout.num_units
    units, cameras = columns[:split].reshape(-1, UNIT_DOF, columns.shape[1]), columns[split:]
    result: Floats = np.einsum("uik,uij,ujl->kl", units, extra.units, units, optimize=True)
    result = result - extra.auxiliary.eliminated(columns[:split].T @ extra.auxiliary.with_units)
    return result + cameras.T @ extra.cameras @ cameras
