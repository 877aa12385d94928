"""Covariance that errors add which the observations of an image share, or those of a point.

The inverse of the normal equations H is the covariance of an adjustment whose observations err independently. Those of
an image do not where its pose is not what the model makes of it: the vehicle does not move between units as
interpolated, the shutter rolls, a lorry fills the view. Those of a point do not where its neighbourhood draws keypoints
to one side in image after image. It shows in the scores s = sum J' w r of images and of points. With F the
observations' part of H and M = sum s s' their squares, which independent errors make F / k^2 at most,

    H^-1 (k^2 M - F) H^-1

is what shared errors add [the sandwich of Huber and White, by clusters: Liang and Zeger, Longitudinal Data Analysis
Using Generalized Linear Models, Biometrika 1986]: those of images and those of points one to another, in those
directions in which they add something [two ways of clustering: Cameron, Gelbach and Miller, Robust Inference With
Multiway Clustering, Journal of Business and Economic Statistics 2011]. The scores of images are of whole units: a
unit's pose has absorbed what its images share. k is the ratio of H to the derivative of the scores: the weights of a
robust loss fall where residuals rise, so that a solution gives way further than H says [Huber, Robust Statistics, 1981,
section 7.6].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats

MIN_UNITS = 10  # beyond those that units and cameras absorb: fewer tell no covariance
SCALE_STEP = 0.1  # of the logarithm of the loss' squared scale, for derivatives
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
    k2 = _weights_by_slopes(problem, state) ** 2
    added = k2 * units / (units - 1) * of_units.T @ of_units - independent
    added += k2 * of_points.T @ of_points - independent
    sigma = np.sqrt(np.diagonal(covariance))
    by_sigma = np.where(sigma > 0.0, 1.0 / np.where(sigma > 0.0, sigma, 1.0), 0.0)
    values, vectors = np.linalg.eigh(added * by_sigma * by_sigma[:, None])
    spread = vectors * np.sqrt(np.maximum(values, 0.0)) * sigma[:, None]
    result: Floats = spread @ spread.T
    return result


def _weights_by_slopes(problem: Problem, state: State) -> float:
    """Sum of the observations' weights over that of the derivatives of weighted residuals by residuals; 1 and more.

    Under the Cauchy loss w = 1 / (1 + r^2 / S) and in two dimensions the mean derivative is w^2. The sum L of the
    losses log(1 + r^2 / S) has both in its derivatives by log S: L' = sum (w - 1), L'' = sum w (1 - w).
    """

    def loss(step: float) -> float:
        scale = problem.options.loss_scale * np.exp(0.5 * step)
        return float(replace(problem, options=replace(problem.options, loss_scale=scale)).point_costs(state).sum())

    below, here, above = loss(-SCALE_STEP), loss(0.0), loss(SCALE_STEP)
    weights = len(problem.observations.point) + (above - below) / (2 * SCALE_STEP)
    slopes = weights - (above - 2 * here + below) / SCALE_STEP**2
    return max(weights / slopes, 1.0) if slopes > 0.0 else 1.0


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
