"""Pose of a camera set from points that it observes, refined from a predicted pose.

The motion model predicts the next pose from the last ones, to some pixels. A robust descent from there finds the
minimum of a global search in a fraction of its time. The loss is wide at first and narrows: points that are off because
the prediction is off count at first, and wrong points do not count in the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Floats, Ints

SIGMAS_PX = (32.0, 8.0, 2.0)  # of the Cauchy loss, one after the other, where nothing else is known
UNWEIGHTED_PX = 1e6  # of the Cauchy loss: beyond every error
STEPS = 6  # with each, at most
SMALL = 1e-5  # a step (rad, m) below this has arrived
NEAR = 0.1  # of the next loss' sigma: one that moves observations by less leads near enough for it


def resect(
    world_from_rig: Floats,
    xy_px: Floats,
    points_m: Floats,
    view: Ints,
    rig_from_view: Floats,
    view_kind: Ints,
    view_params: Floats,
    sigmas_px: Sequence[float] = SIGMAS_PX,
) -> Floats | None:
    """The pose (4, 4) of a rig near an expected one (4, 4) that fits its observations; None where there is none.

    Parameters
    ----------
    xy_px, points_m, view
        Image points (n, 2), the scene's points (n, 3) that they show, and the view (n,) that observes each.
    rig_from_view, view_kind, view_params
        Poses (v, 4, 4) of the views, and their cameras as `pack_cameras` has them.
    sigmas_px
        Of the loss, from wide to narrow.
    """
    rotation, position = world_from_rig[:3, :3].copy(), world_from_rig[:3, 3].copy()
    views = np.ascontiguousarray(rig_from_view[:, :3, :3]), np.ascontiguousarray(rig_from_view[:, :3, 3])
    square, gradient = np.empty((6, 6)), np.empty(6)
    for sigma_px, next_px in pairwise((*sigmas_px, 0.0)):
        for _ in range(STEPS):
            _pose_system(
                rotation, position, *views, view_kind, view_params, view, xy_px, points_m, sigma_px, square, gradient
            )
            try:
                step = -np.linalg.solve(square, gradient)
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(step).all():
                return None
            rotation, position = se3.exp_so3(step[:3]) @ rotation, position + step[3:]
            moved_px = sigma_px * math.sqrt(max(-float(step @ gradient), 0.0) / len(view))
            if moved_px < NEAR * next_px or np.abs(step).max() < SMALL:
                break
    return se3.transform(rotation, position)


def pose_information(
    world_from_rig: Floats,
    xy_px: Floats,
    points_m: Floats,
    view: Ints,
    rig_from_view: Floats,
    view_kind: Ints,
    view_params: Floats,
) -> Floats:
    """Information J'J (6, 6), for errors of 1 px, of observations on steps [omega, tau] of the rig's pose; as `resect`.

    R becomes exp(omega) R, t becomes t + tau, in world axes.
    """
    square, gradient = np.empty((6, 6)), np.empty(6)
    pose = world_from_rig[:3, :3].copy(), world_from_rig[:3, 3].copy()
    views = np.ascontiguousarray(rig_from_view[:, :3, :3]), np.ascontiguousarray(rig_from_view[:, :3, 3])
    _pose_system(*pose, *views, view_kind, view_params, view, xy_px, points_m, UNWEIGHTED_PX, square, gradient)
    return square * UNWEIGHTED_PX**2


@njit(cache=True, nogil=True)
def _pose_system(
    r: Any, t: Any, view_r: Any, view_t: Any, kind: Any, params: Any, view: Any, xy: Any, points: Any, sigma: float,
    square: Any, gradient: Any,
) -> None:  # fmt: skip
    """J'WJ (6, 6) and J'Wr (6,) in steps [omega, tau] of the pose, as in `adjustment.normal_equations`."""
    _add_observations(
        r, t, view_r, view_t, kind, params, view, xy, points, sigma, square, gradient,
        np.empty(6), np.empty(8), np.empty(3), np.empty(3), np.empty(3), np.empty(6),
    )  # fmt: skip


@uncounted()
def _add_observations(
    r: Any, t: Any, view_r: Any, view_t: Any, kind: Any, params: Any, view: Any, xy: Any, points: Any, sigma: float,
    square: Any, gradient: Any, work: Any, proj: Any, d: Any, rig: Any, n: Any, j: Any,
) -> None:  # fmt: skip
    square[:] = 0.0
    gradient[:] = 0.0
    for k in range(len(view)):
        e = view[k]
        for i in range(3):
            d[i] = points[k, i] - t[i]
        for i in range(3):
            rig[i] = r[0, i] * d[0] + r[1, i] * d[1] + r[2, i] * d[2] - view_t[e, i]
        x = view_r[e, 0, 0] * rig[0] + view_r[e, 1, 0] * rig[1] + view_r[e, 2, 0] * rig[2]
        y = view_r[e, 0, 1] * rig[0] + view_r[e, 1, 1] * rig[1] + view_r[e, 2, 1] * rig[2]
        z = view_r[e, 0, 2] * rig[0] + view_r[e, 1, 2] * rig[1] + view_r[e, 2, 2] * rig[2]
        if not project(kind[e], params[e], x, y, z, work, proj):
            continue
        r0, r1 = (proj[0] - xy[k, 0]) / sigma, (proj[1] - xy[k, 1]) / sigma
        s = math.sqrt(1.0 / (1.0 + r0 * r0 + r1 * r1))
        for row in range(2):
            residual = (r0 if row == 0 else r1) * s
            p0, p1, p2 = proj[2 + 3 * row], proj[3 + 3 * row], proj[4 + 3 * row]
            for i in range(3):
                rig[i] = (p0 * view_r[e, i, 0] + p1 * view_r[e, i, 1] + p2 * view_r[e, i, 2]) * s / sigma
            for i in range(3):
                n[i] = rig[0] * r[i, 0] + rig[1] * r[i, 1] + rig[2] * r[i, 2]
            j[0], j[1], j[2] = n[1] * d[2] - n[2] * d[1], n[2] * d[0] - n[0] * d[2], n[0] * d[1] - n[1] * d[0]
            j[3], j[4], j[5] = -n[0], -n[1], -n[2]
            for a in range(6):
                gradient[a] += j[a] * residual
                for b in range(a + 1):
                    square[a, b] += j[a] * j[b]
    for a in range(6):
        for b in range(a):
            square[b, a] = square[a, b]
