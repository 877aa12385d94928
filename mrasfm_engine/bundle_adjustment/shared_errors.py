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

Where images stand beside priors, such errors are in the estimate too: weighed as independent ones, images overrule
priors that know more. One factor on the standard deviation of all observations mends the balance [the magnitude
adjustment: Ribatet, Cooley and Davison, Bayesian Inference from Composite Likelihoods, Statistica Sinica 2012]. Errors
are shared in some directions more than in others: the factor is the one whose estimate errs least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, stdtrit

from mrasfm_engine.bundle_adjustment.priors import ScalePrior, Term
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats

MIN_UNITS = 4  # fewer tell no covariance
SIGMAS = 3.0  # at which what few units tell is as improbable as of a normal distribution
LEVELS = 10  # rounds, in which directions that stood out no longer do
SINGULAR = 1e-9  # eigenvalues of a correlation below this are rounding
# Share of the images in what is known of a direction, below which priors alone tell it: less may be rounding where
# unknowns nearly make up for one another.
UNTOLD = 1e-4
LEAST_GAIN = 1e-6  # of a squared sigma, by a factor of e: where no factor gains it, rounding would choose one
POINT_GROUPS = 4096  # points that share nothing add up to as much as one by one; so many tell a variance to 2 %


@dataclass(frozen=True)
class SharedErrors:
    """Errors that observations share, by what they leave unknown of k functionals of the reduced vector."""

    covariance: Floats  # (k, k) of the functionals
    sigma_factor: float  # on standard deviations of observations, with which the functionals err least


def find_shared_errors(
    problem: Problem, state: State, system: ReducedCameraSystem, columns: Floats, of_independent: Floats
) -> SharedErrors | None:
    """Errors by what k functionals f of the reduced vector show; None where there are too few units to tell them.

    Parameters
    ----------
    problem
        With the curvature of its loss, see `kernels.Loss`.
    state, system
        A solution and its normal equations, without damping.
    columns
        (n, k) D^-1 f of every functional.
    of_independent
        (k, k) f' D^-1 f of all functionals.
    """
    observes = np.bincount(problem.observations.unit) > 0
    if observes.sum() < MIN_UNITS or not columns.any():
        return None
    number = np.cumsum(observes) - 1  # among the units that observe anything
    of_units, of_points = problem.scores(
        state, system, columns, number[problem.observations.unit], min(POINT_GROUPS, problem.observations.num_points)
    )
    covariance = of_points.T @ of_points + information_of_terms(problem, state, columns)
    known = np.diagonal(covariance) > 0.0
    covariance[np.ix_(known, known)] = _widened(covariance[np.ix_(known, known)], of_units[:, known])
    of_priors = information_of_terms(replace(problem, terms=_known_beforehand(problem)), state, columns)
    return SharedErrors(covariance, _best_sigma_factor(covariance, of_independent, of_priors))


def _known_beforehand(problem: Problem) -> list[Term]:
    """Terms whose weight does not follow that of the images."""
    return [term for term in problem.terms if not isinstance(term, ScalePrior)]


def _best_sigma_factor(covariance: Floats, of_independent: Floats, of_priors: Floats) -> float:
    """The `sigma_factor` of `SharedErrors`, one where errors share nothing.

    The sum of squared errors is smallest with it, in standard deviations of the estimate that weighs each direction by
    what it knows. Of a direction that images alone tell, or priors alone, no factor changes that much.

    Parameters
    ----------
    covariance, of_independent, of_priors
        (k, k) with shared errors, without, and what priors bring into it.
    """
    known = np.diagonal(of_independent) > 0.0
    sigma = np.sqrt(np.diagonal(of_independent)[known])
    independent, found, priors = (
        part[np.ix_(known, known)] / sigma / sigma[:, None] for part in (of_independent, covariance, of_priors)
    )
    # In axes in which the information of images and of priors is diagonal, and their sum is one.
    values, vectors = np.linalg.eigh(independent)
    white = vectors / np.sqrt(np.maximum(values, SINGULAR))
    of_terms, axes = np.linalg.eigh(white.T @ priors @ white)
    white = white @ axes
    scores = white.T @ found @ white - np.diag(of_terms)  # covariance of those of images
    share = np.clip(of_terms, 0.0, 1.0)  # above one where the loss bends the other way: images tell nothing there
    untold = 1.0 - share < UNTOLD
    share[untold], scores[untold], scores[:, untold] = 1.0, 0.0, 0.0
    told = (1.0 - share)[:, None] * np.linalg.pinv(scores, rcond=SINGULAR, hermitian=True) * (1.0 - share)
    metric = told + np.diag(share)

    def squared_errors(log_factor: float) -> float:
        weight = np.exp(-2.0 * log_factor)
        gain = 1.0 / (weight * (1.0 - share) + share)
        errors = float((gain[:, None] * (weight**2 * scores + np.diag(share)) * gain * metric).sum())
        return errors + LEAST_GAIN * log_factor**2

    most = 0.5 * np.log(max(float(np.linalg.eigvalsh(scores)[-1]), 1.0))
    best = minimize_scalar(squared_errors, bounds=(0.0, most), method="bounded") if most > 0.0 else None
    return 1.0 if best is None or best.fun >= squared_errors(0.0) else float(np.exp(best.x))


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


def information_of_terms(problem: Problem, state: State, columns: Floats) -> Floats:
    """X' E X (k, k) of columns X (n, k) of the reduced vector and the information E of all terms, without images."""
    extra = Extra.none(problem.layout)
    for term in problem.terms:
        term.add_to(state, problem.layout, extra)
    split = UNIT_DOF * problem.layout.num_units
    units, cameras = columns[:split].reshape(-1, UNIT_DOF, columns.shape[1]), columns[split:]
    result: Floats = np.einsum("uik,uij,ujl->kl", units, extra.units, units, optimize=True)
    result = result - extra.auxiliary.eliminated(columns[:split].T @ extra.auxiliary.with_units)
    return result + cameras.T @ extra.cameras @ cameras
