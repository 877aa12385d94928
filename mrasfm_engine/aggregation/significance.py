"""Sums of squares in sigmas, whatever number of values they are of."""

from __future__ import annotations

import math

from scipy.special import chdtrc, ndtri  # scipy.stats takes half a second to import


def in_sigmas(squared: float, freedoms: int) -> float:
    """Size of a normal variable that is as unlikely as a chi-squared one of so many degrees of freedom."""
    beyond = float(chdtrc(freedoms, squared))
    # The root is what it tends to: it jumps by a hundredth for six, and by a tenth for sixty.
    return float(-ndtri(beyond / 2.0)) if beyond > 0.0 else math.sqrt(squared)
