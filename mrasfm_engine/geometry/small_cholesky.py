"""Cholesky factors of matrices of a few unknowns, for kernels that solve thousands of them."""

from __future__ import annotations

import math
from typing import Any

from mrasfm_engine.jit import uncounted


@uncounted()
def factorise(a: Any, unknowns: int, factor: Any) -> bool:
    """Cholesky factor of an information matrix; False where it is not positive."""
    for i in range(unknowns):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                factor[i, i] = math.sqrt(s)
            else:
                factor[i, j] = s / factor[j, j]
    return True


@uncounted()
def solve(factor: Any, b: Any, unknowns: int, out: Any) -> None:
    """Solve with the factor of `factorise`."""
    for i in range(unknowns):
        s = b[i]
        for k in range(i):
            s -= factor[i, k] * out[k]
        out[i] = s / factor[i, i]
    for i in range(unknowns - 1, -1, -1):
        s = out[i]
        for k in range(i + 1, unknowns):
            s -= factor[k, i] * out[k]
        out[i] = s / factor[i, i]


@uncounted()
def log_determinant(factor: Any, unknowns: int) -> float:
    """Logarithm of the determinant of what was factorised."""
    result = 0.0
    for i in range(unknowns):
        result += 2.0 * math.log(factor[i, i])
    return result
