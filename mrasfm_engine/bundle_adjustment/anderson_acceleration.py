"""Anderson acceleration of steps whose robust weights change with them.

The normal equations have the weights of the robust loss without its curvature, so that they take the cost for steeper
than it is: near the minimum every step goes along those before and is shorter by a factor, another one in every
direction. The last steps show where these series end: of the affine combinations of the last iterates, that is taken
whose combined step is the shortest, in standard deviations, and from there that step [Walker and Ni, Anderson
acceleration for fixed-point iterations, SIAM Journal on Numerical Analysis 2011].
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.types import Floats

DEPTH = 2  # iterations that are kept: those before had other weights, and their small differences are noise
MAX_FACTOR = 8.0  # of an update along its step: of series that hardly shrink, so few steps tell little
LEAST_EIGENVALUE = 1e-6  # relative to the largest, below which differences of steps are nearly dependent


@dataclass(frozen=True, kw_only=True)
class _Iteration:
    """An iteration of the past.

    Attributes
    ----------
    step
        (n,) solution of the normal equations.
    gradient
        (n,) of which it is the solution.
    update
        (n,) that was applied.
    """

    step: Floats
    gradient: Floats
    update: Floats


@dataclass
class AndersonAcceleration:
    """The last iterations of a solve, and the updates that follow from them."""

    history: deque[_Iteration] = field(default_factory=lambda: deque(maxlen=DEPTH))

    def record(self, step: Floats, gradient: Floats, update: Floats) -> None:
        """Keep an iteration: its step (n,), the gradient of that, and the update that was applied."""
        self.history.append(_Iteration(step=step, gradient=gradient, update=update))

    def clear(self) -> None:
        """Drop all iterations."""
        self.history.clear()

    def update_for(self, step: Floats, gradient: Floats) -> Floats:
        """The update (n,) for a step (n,): the step itself where the history tells nothing of it.

        The inner product of two steps is that of the normal equations H, of which H step = -gradient is enough. As H
        changes a little between iterations, the products of step differences are made symmetric.
        """
        decrement = -float(step @ gradient)
        if not self.history or not decrement > 0.0:
            return step
        steps = np.stack([*(one.step for one in self.history), step])
        gradients = np.stack([*(one.gradient for one in self.history), gradient])
        updates = np.stack([one.update for one in self.history])
        differences = np.diff(steps, axis=0)
        products = -differences @ np.diff(gradients, axis=0).T
        coefficients = _solved(0.5 * (products + products.T), -differences @ gradient)
        update: Floats = step - coefficients @ (updates + differences)
        # Of steps that grow, the series comes from uphill.
        factor = -float(update @ gradient) / decrement
        return update if coefficients.any() and 0.0 < factor <= MAX_FACTOR else step


def _solved(square: Floats, right: Floats) -> Floats:
    """Solution (k,) of a symmetric system in the directions that are clearly positive; zero in all others."""
    result = np.zeros(len(right))
    rows = np.flatnonzero(np.diagonal(square) > 0.0)
    if len(rows):
        size = np.sqrt(np.diagonal(square)[rows])
        values, vectors = np.linalg.eigh(square[np.ix_(rows, rows)] / np.outer(size, size))
        counts = values > LEAST_EIGENVALUE * values[-1]
        scaled = vectors[:, counts].T @ (right[rows] / size)
        result[rows] = vectors[:, counts] @ (scaled / values[counts]) / size
    return result
