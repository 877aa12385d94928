"""Points that move by themselves: what their observations cost, and one step of each where poses are held.

In a step of Levenberg-Marquardt, points follow the poses by their derivatives (`back_substitution.substitute`). Where
that throws a few of little depth far away, the whole step would be refused for them; and where a robust weight changes,
a point has further to go. Both cost iterations of the whole system. Here every point goes on towards its own minimum
once the poses have moved, as in Ceres' inner iterations or in variable projection (Golub and Pereyra, 1973): an
iteration then costs a little more, and there are far fewer.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.kernels import (
    BEHIND_PX,
    Bands,
    Loss,
    Observed,
    Views,
    camera_point,
    linearise,
    workspace,
)
from mrasfm_engine.bundle_adjustment.point_elimination import invert3
from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted

CONVERGED = 3e-3  # change of cost an observation, below which the derivatives have led a point far enough
WORTH = 3e-2  # gain an observation, after which a point is still far enough from its minimum for one more step


@uncounted()
def _point_cost(
    views: Views, bands: Bands | None, observed: Observed, begin: int, end: int, scale2: float, x: Any,
    d: Any, rig: Any, cam: Any, work: Any, proj: Any,
) -> float:  # fmt: skip
    """Sum of log(1 + r^2 / scale^2) over a point's observations begin..end, were it at x; r in pixels."""
    result, product = 0.0, 1.0
    for n in range(begin, end):
        u, c = observed.unit[n], observed.camera[n]
        band = 0 if bands is None else bands.of_observation[n]
        camera_point(
            views.unit_r[u], views.unit_t[u], bands, band, np.bool_(False), views.cam_r[c], views.cam_t[c],
            x, d, rig, cam,
        )  # fmt: skip
        r2 = BEHIND_PX * BEHIND_PX
        if project(views.kind[c], views.params[c], cam[0], cam[1], cam[2], work, proj):
            r2 = (proj[0] - observed.xy[n, 0]) ** 2 + (proj[1] - observed.xy[n, 1]) ** 2
        product *= 1.0 + r2 / scale2
        if product > 1e200:  # one logarithm for many factors
            result += math.log(product)
            product = 1.0
    return result + math.log(product)


@uncounted()
def _point_system(
    views: Views, bands: Bands | None, observed: Observed, begin: int, end: int, loss: Loss,
    x: Any, d: Any, rig: Any, cam: Any, work: Any, proj: Any, res: Any, jx: Any, jc: Any, v: Any, e: Any,
) -> None:  # fmt: skip
    """V (6,) and gradient e (3,) of a point at x over its observations begin..end."""
    v[:] = 0.0
    e[:] = 0.0
    for n in range(begin, end):
        u, c = observed.unit[n], observed.camera[n]
        band = 0 if bands is None else bands.of_observation[n]
        if not linearise(
            views.unit_r[u], views.unit_t[u], bands, band, np.bool_(False), c, np.bool_(False), views.cam_r[c],
            views.cam_t[c], views.kind[c], views.params[c], x, observed.xy[n], loss,
            d, rig, cam, work, proj, res, jx, jc,
        ):  # fmt: skip
            continue
        a0, a1, a2 = jx[0, 0], jx[0, 1], jx[0, 2]
        c0, c1, c2 = jx[1, 0], jx[1, 1], jx[1, 2]
        v[0] += a0 * a0 + c0 * c0
        v[1] += a0 * a1 + c0 * c1
        v[2] += a0 * a2 + c0 * c2
        v[3] += a1 * a1 + c1 * c1
        v[4] += a1 * a2 + c1 * c2
        v[5] += a2 * a2 + c2 * c2
        e[0] += a0 * res[0] + c0 * res[1]
        e[1] += a1 * res[0] + c1 * res[1]
        e[2] += a2 * res[0] + c2 * res[1]


@njit(cache=True, nogil=True)
def refine_points(
    views: Views, bands: Bands | None, points: Any, observed: Observed, loss: Loss,
    before: Any, costs_before: Any, steps: int, lo: int, hi: int, costs: Any,
) -> None:  # fmt: skip
    """Move points lo..hi, in place, to where the poses and the calibration of now want them; what they cost to costs.

    Points have followed a step of the poses by its derivatives. One that costs more than `costs_before` where it was
    `before` goes back there if that is better. A point whose cost has hardly changed needs no more; every other makes a
    step of its own, if it is for the better, and up to `steps` as long as these gain.
    """
    _refine_points(
        views, bands, points, observed, loss, before, costs_before, steps, lo, hi, costs,
        workspace(7), np.empty(6), np.empty(3), np.empty(6), np.empty(3), np.empty(3),
    )  # fmt: skip


@uncounted()
def _refine_points(
    views: Views, bands: Bands | None, points: Any, observed: Observed, loss: Loss,
    before: Any, costs_before: Any, steps: int, lo: int, hi: int, costs: Any,
    memory: Any, v: Any, e: Any, inv: Any, x: Any, trial: Any,
) -> None:  # fmt: skip
    d, rig, cam, work, proj, res, jx, jc = memory
    scale2 = loss.scale2 * loss.sigma * loss.sigma
    for p in range(lo, hi):
        begin, end = observed.first[p], observed.first[p + 1]
        for i in range(3):
            x[i] = points[p, i]
        cost = _point_cost(
            views, bands, observed, begin, end, scale2, x, d, rig, cam, work, proj,
        )  # fmt: skip
        if observed.fixed[p]:
            costs[p] = cost
            continue
        if cost > costs_before[p]:
            for i in range(3):
                trial[i] = before[p, i]
            back = _point_cost(
                views, bands, observed, begin, end, scale2, trial, d, rig, cam, work, proj,
            )  # fmt: skip
            if back < cost:
                cost = back
                for i in range(3):
                    x[i] = trial[i]
        gained, enough = abs(cost - costs_before[p]), CONVERGED
        for _ in range(steps):
            if gained <= enough * (end - begin):
                break
            enough = WORTH
            gained = 0.0
            _point_system(
                views, bands, observed, begin, end, loss, x, d, rig, cam, work, proj, res, jx, jc, v, e,
            )  # fmt: skip
            if not invert3(v, inv):
                break
            trial[0] = x[0] - (inv[0] * e[0] + inv[1] * e[1] + inv[2] * e[2])
            trial[1] = x[1] - (inv[1] * e[0] + inv[3] * e[1] + inv[4] * e[2])
            trial[2] = x[2] - (inv[2] * e[0] + inv[4] * e[1] + inv[5] * e[2])
            own = _point_cost(
                views, bands, observed, begin, end, scale2, trial, d, rig, cam, work, proj,
            )  # fmt: skip
            if own < cost:
                gained = cost - own
                cost = own
                for i in range(3):
                    x[i] = trial[i]
        costs[p] = cost
        for i in range(3):
            points[p, i] = x[i]


@njit(cache=True, nogil=True)
def point_costs(
    views: Views, bands: Bands | None, points: Any, observed: Observed, scale2: float, lo: int, hi: int, costs: Any
) -> None:
    """Compute the cost of points lo..hi: sums of log(1 + r^2 / scale^2) over their observations."""
    _point_costs(views, bands, points, observed, scale2, lo, hi, costs, workspace(6))


@uncounted()
def _point_costs(
    views: Views, bands: Bands | None, points: Any, observed: Observed, scale2: float, lo: int, hi: int, costs: Any,
    memory: Any,
) -> None:  # fmt: skip
    d, rig, cam, work, proj, _, _, _ = memory
    for p in range(lo, hi):
        costs[p] = _point_cost(
            views, bands, observed, observed.first[p], observed.first[p + 1], scale2, points[p],
            d, rig, cam, work, proj,
        )  # fmt: skip
