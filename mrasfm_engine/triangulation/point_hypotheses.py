"""Fits of a point that stands, and of one that moves evenly over the ground, to the observations of one track.

From a camera `offset` away from the reference camera, a point that stands in direction `d` at inverse distance `rho` is
seen in the direction `d - rho * offset`. One that moves is seen in `d - rho * offset + tau * nu` after the time `tau`;
`nu` is its velocity times its inverse distance. Both are linear in their unknowns and hold at any distance, also at
infinity. The unknowns are two shifts of `d` across itself, `rho`, and `nu` along the ground's two axes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.geometry.small_cholesky import factorise, solve
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Floats, Ints

STANDS, MOVES = 3, 5  # number of unknowns
ITERATIONS = 4
ROUGH_ITERATIONS = 3  # before them, from a start that may be far off
LOSS_SIGMAS = 2.5  # of the Cauchy loss: as likely as not, an error beyond it is a wrong match
BEHIND = 20.0  # cost of an observation that would be behind its camera, and the most that one costs
SMALL_GAIN = 0.01  # of cost, below which a fit is at its end
REGULAR = 1e-6  # information of a shift, in sigmas per radian: nothing beside any pixel's


class Views(NamedTuple):
    """All cameras at the instants of their row bands."""

    rotation: Floats  # (bands, 3, 3) cam_from_world
    translation_m: Floats  # (bands, 3)
    time_s: Floats  # (bands,)
    is_posed: Bools  # (bands,)
    kind: Ints  # (cameras,)
    params: Floats  # (cameras, PARAMETERS)
    sigma_px: Floats  # (cameras,) standard deviation of an image coordinate


class Sight(NamedTuple):
    """Observations of one track; only the first ones are in use."""

    keypoint: Ints  # (n,)
    band: Ints  # (n,)
    camera: Ints  # (n,)
    xy_px: Floats  # (n, 2)
    offset_m: Floats  # (n, 3) of the camera's centre from the reference camera's
    time_s: Floats  # (n,) since the reference
    direction: Floats  # (3,) of the reference keypoint's ray
    tangents: Floats  # (2, 3) across it
    axes: Floats  # (2, 3) of the ground: along and across the vehicle's motion


class Scratch(NamedTuple):
    """Memory of a fit."""

    information: Floats  # (5, 5)
    factor: Floats  # (5, 5) its Cholesky factor
    gradient: Floats  # (5,)
    step: Floats  # (5,)
    best: Floats  # (5,)
    jacobian: Floats  # (2, 5)
    work: Floats  # (6,)
    projected: Floats  # (8,)


@njit(cache=True, nogil=True)
def new_scratch() -> Scratch:
    """Memory for fits, one after the other."""
    return Scratch(
        np.zeros((5, 5)), np.zeros((5, 5)), np.zeros(5), np.zeros(5), np.zeros(5), np.zeros((2, 5)), np.empty(6),
        np.empty(8),
    )  # fmt: skip


@uncounted()
def _linearise(count: int, unknowns: int, p: Any, sight: Any, views: Any, loss: float, scratch: Any) -> float:
    """Cost of the observations at p; information and gradient, without priors, into scratch."""
    a, b, jacobian, work, out = (
        scratch.information, scratch.gradient, scratch.jacobian, scratch.work, scratch.projected
    )  # fmt: skip
    d, e, axes, offset, r = sight.direction, sight.tangents, sight.axes, sight.offset_m, views.rotation
    for i in range(unknowns):
        b[i] = 0.0
        for j in range(unknowns):
            a[i, j] = 0.0
    total, loss2 = 0.0, loss * loss
    for m in range(count):
        q0 = d[0] + p[0] * e[0, 0] + p[1] * e[1, 0] - p[2] * offset[m, 0]
        q1 = d[1] + p[0] * e[0, 1] + p[1] * e[1, 1] - p[2] * offset[m, 1]
        q2 = d[2] + p[0] * e[0, 2] + p[1] * e[1, 2] - p[2] * offset[m, 2]
        tau = sight.time_s[m]
        if unknowns == MOVES:
            q0 += tau * (p[3] * axes[0, 0] + p[4] * axes[1, 0])
            q1 += tau * (p[3] * axes[0, 1] + p[4] * axes[1, 1])
            q2 += tau * (p[3] * axes[0, 2] + p[4] * axes[1, 2])
        k = sight.band[m]
        x = r[k, 0, 0] * q0 + r[k, 0, 1] * q1 + r[k, 0, 2] * q2
        y = r[k, 1, 0] * q0 + r[k, 1, 1] * q1 + r[k, 1, 2] * q2
        z = r[k, 2, 0] * q0 + r[k, 2, 1] * q1 + r[k, 2, 2] * q2
        c = sight.camera[m]
        if not project(views.kind[c], views.params[c], x, y, z, work, out):
            total += BEHIND
            continue
        per_px = 1.0 / views.sigma_px[c]
        r0, r1 = (out[0] - sight.xy_px[m, 0]) * per_px, (out[1] - sight.xy_px[m, 1]) * per_px
        squared = r0 * r0 + r1 * r1
        total += min(loss2 * math.log(1.0 + squared / loss2), BEHIND)
        weight = 1.0 / (1.0 + squared / loss2)
        for i in range(2):
            g0 = (out[2 + 3 * i] * r[k, 0, 0] + out[3 + 3 * i] * r[k, 1, 0] + out[4 + 3 * i] * r[k, 2, 0]) * per_px
            g1 = (out[2 + 3 * i] * r[k, 0, 1] + out[3 + 3 * i] * r[k, 1, 1] + out[4 + 3 * i] * r[k, 2, 1]) * per_px
            g2 = (out[2 + 3 * i] * r[k, 0, 2] + out[3 + 3 * i] * r[k, 1, 2] + out[4 + 3 * i] * r[k, 2, 2]) * per_px
            jacobian[i, 0] = g0 * e[0, 0] + g1 * e[0, 1] + g2 * e[0, 2]
            jacobian[i, 1] = g0 * e[1, 0] + g1 * e[1, 1] + g2 * e[1, 2]
            jacobian[i, 2] = -(g0 * offset[m, 0] + g1 * offset[m, 1] + g2 * offset[m, 2])
            if unknowns == MOVES:
                jacobian[i, 3] = tau * (g0 * axes[0, 0] + g1 * axes[0, 1] + g2 * axes[0, 2])
                jacobian[i, 4] = tau * (g0 * axes[1, 0] + g1 * axes[1, 1] + g2 * axes[1, 2])
        for i in range(unknowns):
            b[i] += weight * (jacobian[0, i] * r0 + jacobian[1, i] * r1)
            for j in range(i + 1):
                a[i, j] += weight * (jacobian[0, i] * jacobian[0, j] + jacobian[1, i] * jacobian[1, j])
    for i in range(unknowns):
        for j in range(i):
            a[j, i] = a[i, j]
    a[0, 0] += REGULAR
    a[1, 1] += REGULAR
    return total


@uncounted()
def cost_of_standing(count: int, x: float, y: float, z: float, sight: Any, views: Any, scratch: Any) -> float:
    """Cost of the observations of a point that stands at x, y, z from the reference camera."""
    r, offset, out, total, product = views.rotation, sight.offset_m, scratch.projected, 0.0, 1.0
    loss2 = LOSS_SIGMAS * LOSS_SIGMAS
    for m in range(count):
        k, c = sight.band[m], sight.camera[m]
        dx, dy, dz = x - offset[m, 0], y - offset[m, 1], z - offset[m, 2]
        if not project(
            views.kind[c], views.params[c], r[k, 0, 0] * dx + r[k, 0, 1] * dy + r[k, 0, 2] * dz,
            r[k, 1, 0] * dx + r[k, 1, 1] * dy + r[k, 1, 2] * dz, r[k, 2, 0] * dx + r[k, 2, 1] * dy + r[k, 2, 2] * dz,
            scratch.work, out,
        ):  # fmt: skip
            return np.inf
        squared = ((out[0] - sight.xy_px[m, 0]) ** 2 + (out[1] - sight.xy_px[m, 1]) ** 2) / views.sigma_px[c] ** 2
        product *= 1.0 + squared / loss2
        if product > 1e200:  # one logarithm for many factors
            total += loss2 * math.log(product)
            product = 1.0
    return total + loss2 * math.log(product)


@uncounted()
def fit(
    count: int, unknowns: int, is_near: bool, p: Any, mean: Any, weight: Any, least: float, most: float, enough: float,
    sight: Any, views: Any, scratch: Any,
) -> tuple[float, float, bool]:  # fmt: skip
    """Fit p to observations and priors (means and weights by unknown, from the third on), `rho` within its bounds.

    Returns the cost with priors, that without, and whether the information at p is positive: its factor is in scratch.
    A start that is not near begins with a loss that forgives little, which leads near it from anywhere. Below the cost
    that is `enough` the fit goes no further, and neither its cost nor its factor is that of the best p.
    """
    a, b, factor, step, best = (
        scratch.information, scratch.gradient, scratch.factor, scratch.step, scratch.best
    )  # fmt: skip
    p[2] = min(max(p[2], least), most)
    lowest, lowest_data, is_done = np.inf, np.inf, False
    for i in range(len(p)):
        best[i] = p[i]
    for iteration in range(0 if is_near else -ROUGH_ITERATIONS, ITERATIONS + 1):
        data = _linearise(count, unknowns, p, sight, views, LOSS_SIGMAS * 4.0 ** max(-iteration, 0), scratch)
        total = data
        for i in range(2, unknowns):
            total += weight[i] * (p[i] - mean[i]) ** 2
            a[i, i] += weight[i]
            b[i] += weight[i] * (p[i] - mean[i])
        if total < enough:  # a loss that forgives less costs more
            return total, data, False
        if iteration >= 0 and total < lowest:
            is_done = lowest - total < SMALL_GAIN or iteration == ITERATIONS
            lowest, lowest_data = total, data
            for i in range(unknowns):
                best[i] = p[i]
            if is_done:
                break
        elif iteration > 2:
            break
        if iteration == ITERATIONS or not factorise(a, unknowns, factor):
            break
        solve(factor, b, unknowns, step)
        wanted = p[2] - step[2]
        if wanted < least or wanted > most:
            # On the bound: the others find their best for it.
            shift = p[2] - min(max(wanted, least), most)
            for i in range(unknowns):
                if i != 2:
                    b[i] -= a[i, 2] * shift
                    a[i, 2] = a[2, i] = 0.0
            a[2, 2], b[2] = 1.0, shift
            if not factorise(a, unknowns, factor):
                break
            solve(factor, b, unknowns, step)
        for i in range(unknowns):
            p[i] -= step[i]
        p[2] = min(max(p[2], least), most)
    if not is_done:  # the information is not that at the best p
        for i in range(unknowns):
            p[i] = best[i]
        _linearise(count, unknowns, p, sight, views, LOSS_SIGMAS, scratch)
        for i in range(2, unknowns):
            a[i, i] += weight[i]
    return lowest, lowest_data, factorise(a, unknowns, factor) and lowest < np.inf
