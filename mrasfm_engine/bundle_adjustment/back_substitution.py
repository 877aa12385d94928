"""The way back from a step of units and cameras to the points that were eliminated."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.kernels import (
    Bands,
    Loss,
    Motion,
    Observed,
    Slots,
    Views,
    follows_trajectory,
    linearise,
    num_supports,
    row_band,
    support,
    workspace,
)
from mrasfm_engine.bundle_adjustment.point_elimination import multiply3
from mrasfm_engine.jit import njit, uncounted


@uncounted(forceinline=True)
def _moved_point(
    d: Any, omega0: float, omega1: float, omega2: float, tau0: float, tau1: float, tau2: float
) -> tuple[float, float, float]:  # fmt: skip
    """Move of the point that changes the residual as a unit's step does: (X - t_u) x omega - tau."""
    return (
        d[1] * omega2 - d[2] * omega1 - tau0,
        d[2] * omega0 - d[0] * omega2 - tau1,
        d[0] * omega1 - d[1] * omega0 - tau2,
    )


@njit(cache=True, nogil=True)
def substitute(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, step: Any, v_inverse: Any, v_gradient: Any, lo: int, hi: int, out: Any,
) -> None:  # fmt: skip
    """New points lo..hi after a step of the reduced vector: X - V^-1 (e + sum of W_i' step_i)."""
    _substitute(
        views, bands, motion, points, observed, free_slots, loss, step, v_inverse, v_gradient, lo, hi, out,
        workspace(6 + len(free_slots.inner)), np.empty(3),
    )  # fmt: skip


@uncounted()
def _substitute(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, step: Any, v_inverse: Any, v_gradient: Any, lo: int, hi: int, out: Any, memory: Any, e: Any,
) -> None:  # fmt: skip
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof = 6 + len(inner_places)
    d, rig, cam, work, proj, res, jx, jc = memory
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    obs_unit, obs_camera, _, obs_xy, first, _ = observed
    for p in range(lo, hi):
        for i in range(3):
            e[i] = v_gradient[p, i]
        for n in range(first[p], first[p + 1]):
            u, c, band = obs_unit[n], obs_camera[n], row_band(bands, n)
            sc = camera_slot[c]
            if motion is None and unit_slot[u] < 0 and sc < 0:
                continue
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows_trajectory(motion, band), c, sc >= 0,
                cam_r[c], cam_t[c], kind[c], params[c], points[p], obs_xy[n], loss,
                d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            x0, x1, x2 = 0.0, 0.0, 0.0
            for k in range(num_supports(motion)):
                slot, weight = support(motion, unit_slot, u, band, k)
                if slot >= 0:
                    o = 6 * slot
                    y0, y1, y2 = _moved_point(
                        d, step[o], step[o + 1], step[o + 2], step[o + 3], step[o + 4], step[o + 5]
                    )
                    x0 += weight * y0
                    x1 += weight * y1
                    x2 += weight * y2
            m0 = jx[0, 0] * x0 + jx[0, 1] * x1 + jx[0, 2] * x2
            m1 = jx[1, 0] * x0 + jx[1, 1] * x1 + jx[1, 2] * x2
            if sc >= 0:
                o = 6 * num_units + dof * sc
                for i in range(dof):
                    m0 += jc[0, i] * step[o + i]
                    m1 += jc[1, i] * step[o + i]
            for i in range(3):
                e[i] += jx[0, i] * m0 + jx[1, i] * m1
        y0, y1, y2 = multiply3(v_inverse[p], e[0], e[1], e[2])
        out[p, 0] = points[p, 0] - y0
        out[p, 1] = points[p, 1] - y1
        out[p, 2] = points[p, 2] - y2


@njit(cache=True, nogil=True)
def add_scores(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, columns: Any, v_inverse: Any, group: Any, most: int, lo: int, hi: int, out: Any, by_points: Any,
) -> None:  # fmt: skip
    """Add r' (J_poses x + J_point y) of the observations of points lo..hi, y = -V^-1 W' x, to their groups' scores.

    And to those of groups (g, k) of points, which are dealt out in turn.
    """
    count = columns.shape[1]
    along, normal = np.empty((2, count)), np.empty((most, 3))  # of an observation; J_point' r of each
    _add_scores(
        views, bands, motion, points, observed, free_slots, loss, columns, v_inverse, group, lo, hi, out, by_points,
        workspace(6 + len(free_slots.inner)), along, normal, np.empty((3, count)), np.empty((3, count)),
    )  # fmt: skip


@uncounted()
def _add_scores(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, columns: Any, v_inverse: Any, group: Any, lo: int, hi: int, out: Any, by_points: Any,
    memory: Any, along: Any, normal: Any, e: Any, shift: Any,
) -> None:  # fmt: skip
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof, count = 6 + len(inner_places), columns.shape[1]
    d, rig, cam, work, proj, res, jx, jc = memory
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    obs_unit, obs_camera, _, obs_xy, first, fixed = observed
    for p in range(lo, hi):
        begin, end, of_point = first[p], first[p + 1], p % len(by_points)
        e[:] = 0.0
        for n in range(begin, end):
            u, c, band = obs_unit[n], obs_camera[n], row_band(bands, n)
            sc = camera_slot[c]
            normal[n - begin] = 0.0
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows_trajectory(motion, band), c, sc >= 0,
                cam_r[c], cam_t[c], kind[c], params[c], points[p], obs_xy[n], loss,
                d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            shift[:] = 0.0
            for k in range(num_supports(motion)):
                slot, weight = support(motion, unit_slot, u, band, k)
                if slot >= 0:
                    _add_moved_points(d, weight, columns, 6 * slot, shift)
            _residuals_along(jx, jc, shift, columns, -1 if sc < 0 else 6 * num_units + dof * sc, along)
            for k in range(count):
                score = res[0] * along[0, k] + res[1] * along[1, k]
                out[group[n], k] += score
                by_points[of_point, k] += score
            for j in range(3):
                normal[n - begin, j] = jx[0, j] * res[0] + jx[1, j] * res[1]
                for k in range(count):
                    e[j, k] += jx[0, j] * along[0, k] + jx[1, j] * along[1, k]
        if fixed[p]:
            continue
        for k in range(count):
            shift[0, k], shift[1, k], shift[2, k] = multiply3(v_inverse[p], e[0, k], e[1, k], e[2, k])
        for n in range(begin, end):
            q = normal[n - begin]
            for k in range(count):
                score = q[0] * shift[0, k] + q[1] * shift[1, k] + q[2] * shift[2, k]
                out[group[n], k] -= score
                by_points[of_point, k] -= score


@uncounted(forceinline=True)
def _add_moved_points(d: Any, weight: float, columns: Any, o: int, shift: Any) -> None:
    """Add weight times `_moved_point` of steps (n, k), of the unit at place o, to shift (3, k)."""
    for k in range(columns.shape[1]):
        x0, x1, x2 = _moved_point(
            d, columns[o, k], columns[o + 1, k], columns[o + 2, k], columns[o + 3, k], columns[o + 4, k],
            columns[o + 5, k],
        )  # fmt: skip
        shift[0, k] += weight * x0
        shift[1, k] += weight * x1
        shift[2, k] += weight * x2


@uncounted(forceinline=True)
def _residuals_along(jx: Any, jc: Any, shift: Any, columns: Any, o: int, along: Any) -> None:
    """Change of a residual along (2, k) moves of its point and steps of its camera at place o, -1 where it is held."""
    for i in range(2):
        for k in range(columns.shape[1]):
            along[i, k] = jx[i, 0] * shift[0, k] + jx[i, 1] * shift[1, k] + jx[i, 2] * shift[2, k]
    if o >= 0:
        for i in range(2):
            for j in range(jc.shape[1]):
                for k in range(columns.shape[1]):
                    along[i, k] += jc[i, j] * columns[o + j, k]
