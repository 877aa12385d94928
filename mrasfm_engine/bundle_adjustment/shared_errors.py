"""Covariance of an adjustment whose errors the observations of an image share, or those of a point.

The inverse of the normal equations is the covariance where observations err independently and as their standard
deviation says. Those of an image do not where its pose is not what the model makes of it: the vehicle does not move
between units as interpolated, the shutter rolls, a lorry fills the view. Those of a point do not where its
neighbourhood draws keypoints to one side in image after image. It shows in the scores s = sum J' w r of images and of
points, whose squares M = sum s s' give the covariance

    D^-1 (M + T) D^-1

with T the information of all terms that are no image observations, and D the derivative of the scores and terms [the
sandwich of Huber and White, by clusters: Liang and Zeger, Longitudinal Data Analysis Using Generalized Linear Models,
Biometrika 1986]. Under a robust loss D is less than the matrix of the normal equations, as weights fall where residuals
rise [Huber, Robust Statistics, 1981, section 7.6]: little in all, but much in directions that other unknowns can nearly
make up for. Scores of points are those of independent errors, and of what a point's share; scores of images widen that
as far as they exceed it [two ways of clustering: Cameron, Gelbach and Miller, Robust Inference With Multiway
Clustering, Journal of Business and Economic Statistics 2011]. They are of whole units: a unit's pose has absorbed what
its images share.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, stdtrit

from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats

MIN_UNITS = 4  # fewer tell no covariance
SIGMAS = 3.0  # at which what few units tell is as improbable as of a normal distribution
LEVELS = 10  # rounds, in which directions that stood out no longer do
SINGULAR = 1e-9  # eigenvalues of a correlation below this are rounding
POINT_GROUPS = 4096  # points that share nothing add up to as much as one by one; so many tell a variance to 2 %


def shared_error_covariance(
    problem: Problem, state: State, system: ReducedCameraSystem, columns: Floats
) -> Floats | None:
    """Covariance (k, k) of k functionals f of the reduced vector; None where there are too few units to tell it.

    Parameters
    ----------
    problem
        With the curvature of its loss, see `kernels.Loss`.
    state, system
        A solution and its normal equations, without damping.
    columns
        (n, k) D^-1 f of every functional.
    """
    observes = np.bincount(problem.observations.unit) > 0
    if observes.sum() < MIN_UNITS or not columns.any():
        return None
    number = np.cumsum(observes) - 1  # among the units that observe anything
    of_units = problem.scores(state, system, columns, number[problem.observations.unit])
    of_points = problem.scores(state, system, columns, problem.observations.point % POINT_GROUPS)
    covariance = of_points.T @ of_points + _of_terms(problem, state, columns)
    known = np.diagonal(covariance) > 0.0
    covariance[np.ix_(known, known)] = _widened(covariance[np.ix_(known, known)], of_units[:, known])
    return covariance


def _widened(covariance: Floats, scores: Floats) -> Floats:
    """Covariance (k, k) with what it lacks of the scores (n, k) of units: in directions that stand out as much as they
    have, in all others their mean.

    Few units scatter far in some directions although they share nothing: the eigenvalues of their covariance over the
    true one reach (1 + sqrt(k / n))^2 [Marchenko and Pastur, Mathematics of the USSR-Sbornik 1967]. One that stands out
    is l (1 + k / n / (l - 1)), where l is the true one [Baik and Silverstein, Journal of Multivariate Analysis 2006].
    What n units tell of a direction alone, errors exceed as Student's distribution exceeds the normal one. Scores
    cancel, so that n is one less than there are units.
    """
    freedoms = len(scores) - 1
    ratio = scores.shape[1] / freedoms
    sigma = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / sigma / sigma[:, None])
    lengths = np.sqrt(np.maximum(values, SINGULAR))
    root = sigma[:, None] * vectors * lengths  # times its transpose: the covariance
    white = scores @ (vectors / lengths / sigma[:, None])
    found, directions = np.linalg.eigh(white.T @ white * (len(scores) / freedoms))
    edge, level = (1.0 + np.sqrt(ratio)) ** 2, 1.0
    for _ in range(LEVELS):
        others = found[found <= edge * level]
        level = max(float(others.mean()), level) if len(others) else level
    found = found / level
    half = np.maximum(found + 1.0 - ratio, 0.0) / 2.0
    own = np.where(found > edge, half + np.sqrt(np.maximum(half**2 - found, 0.0)), 1.0)
    own = 1.0 + (own - 1.0) * (stdtrit(freedoms, ndtr(SIGMAS)) / SIGMAS) ** 2
    spread = root @ directions * np.sqrt(level * own)
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
