"""The most likely correction under errors of unknown size, some of which are wrong, and a prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.types import Floats, Ints

ITERATIONS = 40
INITIAL_DAMPING = 1e-3
CONVERGED = 0.1  # of what errors and prior leave uncertain
SETTLED = 0.99  # of the spread that errors had before
MEDIAN_SIGMAS = 0.6745  # median of the absolute values of a normal distribution


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Errors (n,) that have one spread, and their derivatives (n, k) in the unknowns `rows` (k,).

    `weight` is the share of an independent error that each counts as.
    """

    rows: Ints
    error: Floats
    jacobian: Floats
    weight: float


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Most likely correction (k,) in a prior's standard deviations, and the errors' information (k, k) there."""

    x: Floats
    information: Floats


def most_likely_correction(
    errors: Callable[[Floats], Sequence[Errors]], start: Floats, *, least_spread: Floats, prior: float = 1.0
) -> Correction:
    """Minimise the errors under a Cauchy loss and a prior of unit variance by damped Gauss-Newton steps.

    The spread of a group of errors is what their median says, and never rises. Where all of them are large their spread
    is too, and they say next to nothing against the prior: see `prior`.

    Parameters
    ----------
    errors
        Gives the groups of errors at a correction (k,).
    start
        Where to begin (k,).
    least_spread
        Standard deviations (groups,) that errors have at least.
    prior
        Weight of the prior.
    """
    x, damping = start, INITIAL_DAMPING
    here = errors(x)
    spread = _spread(here, least_spread)
    for _ in range(ITERATIONS):
        information, gradient = _normal_equations(here, x, spread)
        damped = information + np.diag(prior + damping * np.diag(information))
        step = -np.linalg.solve(damped, gradient + prior * x)
        there = errors(x + step)
        if not _cost(there, x + step, spread, prior) <= _cost(here, x, spread, prior):  # a NaN is no step either
            damping *= 10.0
            continue
        x, here, damping = x + step, there, 0.1 * damping
        narrower = np.minimum(spread, _spread(here, least_spread))
        settled = bool((narrower > SETTLED * spread).all())
        spread = narrower
        if settled and step @ damped @ step < CONVERGED**2:
            break
    return Correction(x=x, information=_normal_equations(here, x, spread)[0])


def _spread(groups: Sequence[Errors], at_least: Floats) -> Floats:
    """Standard deviations (groups,) by the medians of the errors."""
    return np.maximum(at_least, np.array([np.median(np.abs(group.error)) for group in groups]) / MEDIAN_SIGMAS)


def _normal_equations(groups: Sequence[Errors], x: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """J' W J and J' W r of the errors."""
    information, gradient = np.zeros((len(x), len(x))), np.zeros(len(x))
    for group, sigma in zip(groups, spread, strict=True):
        weight = group.weight / (sigma**2 + group.error**2)
        weighted = weight[:, None] * group.jacobian
        information[np.ix_(group.rows, group.rows)] += group.jacobian.T @ weighted
        gradient[group.rows] += group.error @ weighted
    return information, gradient


def _cost(groups: Sequence[Errors], x: Floats, spread: Floats, prior: float) -> float:
    """Half of the Cauchy loss of the errors, and of the prior's squares with its weight."""
    cost = 0.5 * prior * float(x @ x)
    for group, sigma in zip(groups, spread, strict=True):
        cost += 0.5 * group.weight * float(np.log1p(group.error**2 / sigma**2).sum())
    return cost
