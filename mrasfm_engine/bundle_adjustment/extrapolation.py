"""Extrapolation of steps whose weights change with them.

The normal equations have the weights of the robust loss without its curvature, so that they take the cost for steeper
than it is: near the minimum every step goes along those before and is shorter by a factor, another one in every
direction. From the last steps follows where these series end [Anderson acceleration: Walker and Ni, Anderson
acceleration for fixed-point iterations, SIAM Journal on Numerical Analysis 2011]: of all combinations of the last
iterates, that is next whose own step is the shortest, in standard deviations, and that step with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.types import Floats

MOST_STEPS = 3  # that are remembered: more have other weights, and their small differences are noise
MAX_FACTOR = 8.0  # of a step's length: of series that hardly shrink, so few steps tell little
LEAST_SHARE = 1e-6  # of the largest eigenvalue, below which differences of steps are nearly dependent


@dataclass(frozen=True, kw_only=True)
class _Taken:
    """A step of the past.

    Attributes
    ----------
    step
        (n,) as the normal equations have it.
    gradient
        (n,) from which it came.
    way
        (n,) that was gone instead.
    """

    step: Floats
    gradient: Floats
    way: Floats


@dataclass
class Extrapolation:
    """Steps so far, of one sort of normal equations."""

    taken: list[_Taken] = field(default_factory=list)

    def remember(self, step: Floats, gradient: Floats, way: Floats) -> None:
        """Add a step (n,) with its gradient, and the way that was gone for it."""
        self.taken = [*self.taken, _Taken(step=step, gradient=gradient, way=way)][-MOST_STEPS:]

    def forget(self) -> None:
        """Begin anew."""
        self.taken = []

    def way_of(self, step: Floats, gradient: Floats) -> Floats:
        """The way (n,) to go for a step (n,); the step itself where the last ones tell nothing of it.

        Inner products of steps are those of the normal equations, of which one product with a gradient is enough.
        """
        if not self.taken:
            return step
        steps = np.stack([*(one.step for one in self.taken), step])
        gradients = np.stack([*(one.gradient for one in self.taken), gradient])
        ways = np.stack([one.way for one in self.taken])
        turns = np.diff(steps, axis=0)
        square, right = -turns @ np.diff(gradients, axis=0).T, -turns @ gradient
        share = _solved(0.5 * (square + square.T), right)
        if share is None or 1.0 + np.abs(share).sum() > MAX_FACTOR:
            return step
        way: Floats = step - share @ (ways + turns)
        return way if float(way @ gradient) < 0.0 else step  # of steps that grow, their series began uphill


def _solved(square: Floats, right: Floats) -> Floats | None:
    """Solution (k,) of a positive square system, without what hardly counts in it; None where nothing does."""
    size = np.sqrt(np.maximum(np.diagonal(square), 0.0))
    if not (size > 0.0).all():
        return None
    values, vectors = np.linalg.eigh(square / np.outer(size, size))
    counts = values > LEAST_SHARE * values[-1]
    found: Floats = vectors[:, counts] @ ((vectors[:, counts].T @ (right / size)) / values[counts]) / size
    return found
