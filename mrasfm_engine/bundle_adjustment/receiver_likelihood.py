"""Likelihood of the sizes that both parts of a receiver's errors have, in what was declared of them.

With w and v the factors on what scatters and on what wanders, and r = v / w, the states of the process have the
information P + r^2 A'A beside errors of w times the declared sigmas. In axes in which P is the identity and A'A is
diagonal, that is diagonal for all sizes: the axes are found once, and each size takes products of small matrices alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
from threadpoolctl import ThreadpoolController

from mrasfm_engine.bundle_adjustment.receiver_positions import AXES, ReceiverPositions, without_common_errors
from mrasfm_engine.types import Floats

_THREADS = ThreadpoolController()


def restricted_log_likelihood(
    declared: ReceiverPositions, off_m: Floats, others: Floats
) -> Callable[[float, float], float]:
    """Log likelihood of errors of positions, up to a constant, whatever moves the antenna: a function of the factors on
    the independent and on the wandering part of what is declared.

    That is of what the ways by which the scene may be moved cannot explain [Patterson and Thompson, Recovery of
    inter-block information when block sizes are unequal, Biometrika 1971].

    Parameters
    ----------
    declared
        Positions whose errors' wandering part has the standard deviations of the independent one.
    off_m
        (n, 3) errors.
    others
        (n, 3, m) ways.
    """
    scaled = np.concatenate([others, off_m[:, :, None], declared.common_m], axis=2) / declared.sigma_m[:, :, None]
    count, size, flat = others.shape[2] + 1, scaled.shape[2], scaled.reshape(AXES * len(scaled), -1)
    off, diagonal = declared.precision
    precision = np.diag(diagonal) + np.diag(off[1:], 1) + np.diag(off[1:], -1)
    with _THREADS.limit(limits=1, user_api="blas"):  # others would go on waiting for more long after so little work
        values, axes = scipy.linalg.eigh(declared.shares.T @ declared.shares, precision)
    values = np.maximum(values, 0.0)
    along = (axes.T @ (declared.shares.T @ scaled.reshape(len(scaled), -1))).reshape(-1, size)
    in_white_noise, log_sigmas = flat.T @ flat, float(np.log(declared.sigma_m).sum())

    def log_likelihood(white: float, wander: float) -> float:
        ratio2 = (wander / white) ** 2
        shrunk = np.repeat(ratio2 / (1.0 + ratio2 * values), AXES)[:, None] * along
        known, of_common = without_common_errors((in_white_noise - along.T @ shrunk) / white**2, count)
        matrix, right = known[:-1, :-1], known[:-1, -1]
        left = known[-1, -1] - right @ np.linalg.lstsq(matrix, right, rcond=1e-12)[0]
        determinant = 2.0 * (log_sigmas + len(flat) * np.log(white)) + AXES * np.log1p(ratio2 * values).sum()
        determinant += np.linalg.slogdet(matrix)[1] + np.linalg.slogdet(of_common)[1]
        return -0.5 * float(left + determinant)

    return log_likelihood
