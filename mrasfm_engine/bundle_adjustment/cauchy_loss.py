"""The Cauchy loss of residuals that are divided by their standard deviations."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.types import Floats


def cauchy_weights(residuals: Floats, loss_scale: float) -> Floats:
    """Weights (n,) under a Cauchy loss of residuals (n, k) over sigma, each taken as a whole."""
    result: Floats = 1.0 / (1.0 + (residuals**2).sum(1) / loss_scale**2)
    return result


def cauchy_cost(residuals: Floats, loss_scale: float) -> float:
    """Half the sum of the Cauchy loss of residuals (n, k) over sigma."""
    return 0.5 * cauchy_loss((residuals**2).sum(1), loss_scale)


def cauchy_loss(squared: Floats, loss_scale: float) -> float:
    """Sum of the Cauchy loss of residuals over sigma with squared lengths of any shape."""
    return float(loss_scale**2 * relative_cauchy_losses(squared, loss_scale).sum())


def relative_cauchy_losses(squared: Floats, loss_scale: float = 1.0) -> Floats:
    """Cauchy losses, over the square of their scale, of residuals with squared lengths of any shape.

    These are over sigma, or over sigma and the loss's scale, which then is 1.
    """
    result: Floats = np.log1p(squared / loss_scale**2)
    return result
