"""Jumps of a receiver's error: a fix is lost and found, satellites change, and positions stay where they have come to.

The error that wanders (see `receiver_positions`) cannot do that. Between one sample and the next it would have to be
bent across, and the scene would be scaled and bent with it.

A jump is a step between the samples before and after it that scene and receiver cannot explain otherwise: with the
differences y of the scene and the samples around it, a straight line with a step is fitted to each axis,

    y = a + b t + step [t > jump]

as a scene whose scale or direction is off differs from right positions by a straight line.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mrasfm_engine.types import Floats, Ints

AROUND = 5  # samples before a jump, and as many after it, that show it
JUMP_SIGMAS = 6.0
SMALLEST_SIGMAS = 1e-3  # of what is declared: rounding of coordinates is no scatter
MAX_JUMPS = 16  # of a drive; more are noise of another kind


def find_jumps(off_m: Floats, sigma_m: Floats, time_s: Floats, *, wander_time_s: float) -> Ints:
    """Samples after which a receiver's error is another one: the first of each new error, ascending.

    Parameters
    ----------
    off_m
        Places of the antenna in the scene minus the samples (n, 3), in the order of time.
    sigma_m
        What the receiver declares (n, 3).
    time_s
        Of the samples (n,).
    wander_time_s
        Correlation time of the error that wanders.
    """
    if len(off_m) < 2 * AROUND:
        return np.zeros(0, dtype=np.int64)
    evidence = _evidence(off_m, sigma_m, time_s, wander_time_s)
    found: list[int] = []
    while len(found) < MAX_JUMPS:
        best = int(evidence.argmax())
        if evidence[best] <= JUMP_SIGMAS:
            break
        found.append(best + AROUND)
        evidence[max(0, best - AROUND) : best + AROUND + 1] = 0.0  # windows there show the same step
    return np.sort(np.array(found, dtype=np.int64))


def _evidence(off_m: Floats, sigma_m: Floats, time_s: Floats, wander_time_s: float) -> Floats:
    """The step before every sample with enough around it (m,), in standard deviations."""
    length = 2 * AROUND
    windows = np.swapaxes(sliding_window_view(off_m, length, axis=0), 1, 2)  # (m, length, 3)
    times_s = sliding_window_view(time_s, length)
    declared_m = sliding_window_view(sigma_m, length, axis=0).max(axis=2)
    after = np.arange(length) >= AROUND
    centred_s = times_s - times_s.mean(axis=1, keepdims=True)
    scale_s = np.maximum(np.abs(centred_s).max(axis=1, keepdims=True), 1e-9)
    design = np.stack([np.ones_like(times_s), centred_s / scale_s, np.broadcast_to(after, times_s.shape)], axis=2)
    inverse = np.linalg.pinv(np.swapaxes(design, 1, 2) @ design, hermitian=True)
    solution = inverse @ np.swapaxes(design, 1, 2) @ windows
    left = windows - design @ solution
    # Where single samples stick out of a window, what it shows is uncertain.
    spread_m = np.sqrt((left**2).sum(axis=1) / (length - design.shape[2]))
    scatter_m = np.maximum(_scatter(off_m, sigma_m) * declared_m, spread_m)
    # Between the middles of both sides the error that wanders changes by this much, as a Gauss-Markov process.
    apart_s = times_s[:, after].mean(axis=1) - times_s[:, ~after].mean(axis=1)
    wandered = 2.0 * (1.0 - np.exp(-apart_s / wander_time_s))[:, None] * declared_m**2
    variance = inverse[:, 2, 2][:, None] * scatter_m**2 + wandered
    result: Floats = np.linalg.norm(solution[:, 2] / np.sqrt(variance), axis=1)
    return result


def segment_of(units: Ints, first_units: Ints) -> Ints:
    """Number (n,) of the error that units have whose receiver's error jumps at some units (k,), ascending."""
    return np.searchsorted(first_units, units, side="right").astype(np.int64)


def _scatter(off_m: Floats, sigma_m: Floats) -> Floats:
    """Standard deviation (3,) from sample to sample in declared sigmas, of most: second differences know no slope."""
    second = np.abs(off_m[2:] - 2.0 * off_m[1:-1] + off_m[:-2]) / np.sqrt(6.0) / sigma_m[1:-1]
    result: Floats = np.maximum(np.median(second, axis=0) / 0.6745, SMALLEST_SIGMAS)
    return result
