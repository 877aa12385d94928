"""The compiled inner loops of camera set bundle adjustment: residuals, Jacobians, Schur complement over points.

One observation of point X by camera c of unit u, with (R_u, t_u) = world_from_rig, (A, b) = unit_from_shot,
(R_c, t_c) = rig_from_cam:

    x_rig = R_u' (X - t_u)      x_shot = A' (x_rig - b)      x_cam = R_c' (x_shot - t_c)
    residual = (pixel(x_cam) - observed) / sigma

With P = d pixel / d x_cam (2x3), M = P R_c', Q = M A' and N = Q R_u' the derivatives in the steps of `problem` are,
row by row,

    d/dX     =  N                       d/dtau_u = -N            d/domega_u = N x (X - t_u)
    d/dtau_c = -M                       d/domega_c = M x (x_shot - t_c)
    d/dphi   =  pixel - principal point

Where the motion within a unit follows from the trajectory, a shot's pose takes part in steps of up to three units
(`support`, with `weight` w): d/dtau_i = -w_i N and d/domega_i = w_i N x (X - t_shot). Left out is that a turned unit
also bends the way to its neighbours, which is small where a unit's step is short against the depth of points. A shot
that is held to its unit has no other support, and the derivatives above.

Where all images are taken at their unit's time, shot_r, shot_t, support, weight and obs_shot are None: numba compiles
the kernels without them, so that nobody pays for what is not there.

because R' exp(-omega) v = R' v + R' [v]x omega and n' [v]x omega = (n x v)' omega. The Cauchy loss enters by
reweighting: an observation counts w = 1 / (1 + r^2 / s^2) (its Gauss-Newton approximation).

For every point its 3x3 block V and gradient e are eliminated on the spot: with W_i its coupling to free block i,

    S_ij -= W_i V^-1 W_j'         g_i -= W_i V^-1 e

Only blocks with row >= column of S are filled. Points are damped as V + lambda diag V.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mrasfm_engine.geometry.camera_model import project

MAX_BLOCKS = 512  # free units and cameras one point may couple; more observations of it still count for themselves
BEHIND_PX = 1000.0  # what an observation costs whose point is behind the camera
MIN_DEPTH_M = 1e-3


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _camera_point(
    unit_r: Any, unit_t: Any, shot_r: Any, shot_t: Any, shot: int, follows: bool, cam_r: Any, cam_t: Any, x: Any,
    from_unit: Any, rig: Any, cam: Any,
) -> None:  # fmt: skip
    """from_unit = X - t_u (X - t_shot where the shot follows several units), rig = x_shot - t_c, cam = x_cam."""
    for i in range(3):
        from_unit[i] = x[i] - unit_t[i]
    if shot_r is None:
        for i in range(3):
            rig[i] = unit_r[0, i] * from_unit[0] + unit_r[1, i] * from_unit[1] + unit_r[2, i] * from_unit[2] - cam_t[i]
    else:
        for i in range(3):
            cam[i] = (
                unit_r[0, i] * from_unit[0] + unit_r[1, i] * from_unit[1] + unit_r[2, i] * from_unit[2]
                - shot_t[shot, i]
            )  # fmt: skip
        if follows:
            for i in range(3):
                from_unit[i] = unit_r[i, 0] * cam[0] + unit_r[i, 1] * cam[1] + unit_r[i, 2] * cam[2]
        for i in range(3):
            rig[i] = shot_r[shot, 0, i] * cam[0] + shot_r[shot, 1, i] * cam[1] + shot_r[shot, 2, i] * cam[2] - cam_t[i]
    for i in range(3):
        cam[i] = cam_r[0, i] * rig[0] + cam_r[1, i] * rig[1] + cam_r[2, i] * rig[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def squared_errors(
    unit_r: Any, unit_t: Any, shot_r: Any, shot_t: Any, cam_r: Any, cam_t: Any, kind: Any, params: Any, points: Any,
    obs_unit: Any, obs_shot: Any, obs_camera: Any, obs_point: Any, obs_xy: Any, lo: int, hi: int, out: Any,
) -> None:  # fmt: skip
    """Squared reprojection errors in pixels of observations lo..hi; BEHIND_PX squared behind the camera."""
    d, rig, cam, work, proj = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8)
    for n in range(lo, hi):
        u, c = obs_unit[n], obs_camera[n]
        shot = 0 if obs_shot is None else obs_shot[n]
        _camera_point(
            unit_r[u], unit_t[u], shot_r, shot_t, shot, False, cam_r[c], cam_t[c], points[obs_point[n]], d, rig, cam
        )
        if cam[2] < MIN_DEPTH_M:
            out[n] = BEHIND_PX * BEHIND_PX
            continue
        project(kind[c], params[c], cam[0], cam[1], cam[2], work, proj)
        out[n] = (proj[0] - obs_xy[n, 0]) ** 2 + (proj[1] - obs_xy[n, 1]) ** 2


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _linearise(
    unit_r: Any, unit_t: Any, shot_r: Any, shot_t: Any, shot: int, follows: bool, cam_r: Any, cam_t: Any,
    kind: int, k: Any, x: Any, xy: Any, sigma: float, loss2: float,
    d: Any, rig: Any, cam: Any, work: Any, proj: Any, res: Any, ju: Any, jc: Any, jx: Any,
) -> bool:  # fmt: skip
    """Weighted residual and Jacobians of one observation; False behind the camera."""
    _camera_point(unit_r, unit_t, shot_r, shot_t, shot, follows, cam_r, cam_t, x, d, rig, cam)
    if cam[2] < MIN_DEPTH_M:
        return False
    project(kind, k, cam[0], cam[1], cam[2], work, proj)
    r0, r1 = (proj[0] - xy[0]) / sigma, (proj[1] - xy[1]) / sigma
    sw = math.sqrt(1.0 / (1.0 + (r0 * r0 + r1 * r1) / loss2))
    res[0], res[1] = r0 * sw, r1 * sw
    s = sw / sigma
    for i in range(2):
        p0, p1, p2 = proj[2 + 3 * i] * s, proj[3 + 3 * i] * s, proj[4 + 3 * i] * s
        m0 = p0 * cam_r[0, 0] + p1 * cam_r[0, 1] + p2 * cam_r[0, 2]
        m1 = p0 * cam_r[1, 0] + p1 * cam_r[1, 1] + p2 * cam_r[1, 2]
        m2 = p0 * cam_r[2, 0] + p1 * cam_r[2, 1] + p2 * cam_r[2, 2]
        if shot_r is None:
            q0, q1, q2 = m0, m1, m2
        else:
            q0 = m0 * shot_r[shot, 0, 0] + m1 * shot_r[shot, 0, 1] + m2 * shot_r[shot, 0, 2]
            q1 = m0 * shot_r[shot, 1, 0] + m1 * shot_r[shot, 1, 1] + m2 * shot_r[shot, 1, 2]
            q2 = m0 * shot_r[shot, 2, 0] + m1 * shot_r[shot, 2, 1] + m2 * shot_r[shot, 2, 2]
        n0 = q0 * unit_r[0, 0] + q1 * unit_r[0, 1] + q2 * unit_r[0, 2]
        n1 = q0 * unit_r[1, 0] + q1 * unit_r[1, 1] + q2 * unit_r[1, 2]
        n2 = q0 * unit_r[2, 0] + q1 * unit_r[2, 1] + q2 * unit_r[2, 2]
        jx[i, 0], jx[i, 1], jx[i, 2] = n0, n1, n2
        ju[i, 0], ju[i, 1], ju[i, 2] = n1 * d[2] - n2 * d[1], n2 * d[0] - n0 * d[2], n0 * d[1] - n1 * d[0]
        ju[i, 3], ju[i, 4], ju[i, 5] = -n0, -n1, -n2
        jc[i, 0], jc[i, 1], jc[i, 2] = m1 * rig[2] - m2 * rig[1], m2 * rig[0] - m0 * rig[2], m0 * rig[1] - m1 * rig[0]
        jc[i, 3], jc[i, 4], jc[i, 5] = -m0, -m1, -m2
        jc[i, 6] = (proj[i] - k[2 + i]) * s
    return True


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _slot_of(ids: Any, count: int, block: int) -> int:
    for i in range(count):
        if ids[i] == block:
            return i
    return -1


@njit(cache=True, inline="always", error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _invert3(v: Any, out: Any) -> bool:
    """Inverse of a symmetric 3x3 matrix [00, 01, 02, 11, 12, 22]; False where it is singular."""
    c0, c1, c2 = v[3] * v[5] - v[4] * v[4], v[2] * v[4] - v[1] * v[5], v[1] * v[4] - v[2] * v[3]
    det = v[0] * c0 + v[1] * c1 + v[2] * c2
    if not det > 1e-14 * v[0] * v[3] * v[5] or not det > 0.0:
        return False
    i = 1.0 / det
    out[0], out[1], out[2] = c0 * i, c1 * i, c2 * i
    out[3], out[4], out[5] = (
        (v[0] * v[5] - v[2] * v[2]) * i,
        (v[1] * v[2] - v[0] * v[4]) * i,
        (v[0] * v[3] - v[1] * v[1]) * i,
    )
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def accumulate(
    unit_r: Any, unit_t: Any, shot_r: Any, shot_t: Any, cam_r: Any, cam_t: Any, kind: Any, params: Any, points: Any,
    support: Any, weight: Any, obs_unit: Any, obs_shot: Any, obs_camera: Any, obs_xy: Any, first: Any,
    unit_slot: Any, camera_slot: Any, num_units: int,
    sigma: float, loss2: float, damping: float, lo: int, hi: int, s: Any, diagonal: Any, g: Any,
    v_inverse: Any, v_gradient: Any,
) -> None:  # fmt: skip
    """Add the reduced normal equations of points lo..hi to s (n, n), the undamped diagonal of the unreduced ones to
    diagonal (n,), and the reduced gradient to g (n,); keep every point's V^-1 (p, 6) and gradient (p, 3)."""
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    ju, jc, jx = np.empty((2, 6)), np.empty((2, 7)), np.empty((2, 3))
    ids, offsets, sizes = np.empty(MAX_BLOCKS, np.int64), np.empty(MAX_BLOCKS, np.int64), np.empty(MAX_BLOCKS, np.int64)
    w, wv = np.empty((MAX_BLOCKS, 7, 3)), np.empty((7, 3))
    v, damped, inv, e = np.empty(6), np.empty(6), np.empty(6), np.empty(3)
    for p in range(lo, hi):
        count = 0
        v[:] = 0.0
        e[:] = 0.0
        for n in range(first[p], first[p + 1]):
            u, c = obs_unit[n], obs_camera[n]
            shot = 0 if obs_shot is None else obs_shot[n]
            follows = False if weight is None else weight[shot, 0] != 1.0
            if not _linearise(
                unit_r[u], unit_t[u], shot_r, shot_t, shot, follows, cam_r[c], cam_t[c],
                kind[c], params[c], points[p], obs_xy[n], sigma, loss2,
                d, rig, cam, work, proj, res, ju, jc, jx,
            ):  # fmt: skip
                continue
            a0, a1, a2 = jx[0, 0], jx[0, 1], jx[0, 2]
            b0, b1, b2 = jx[1, 0], jx[1, 1], jx[1, 2]
            v[0] += a0 * a0 + b0 * b0
            v[1] += a0 * a1 + b0 * b1
            v[2] += a0 * a2 + b0 * b2
            v[3] += a1 * a1 + b1 * b1
            v[4] += a1 * a2 + b1 * b2
            v[5] += a2 * a2 + b2 * b2
            e[0] += a0 * res[0] + b0 * res[1]
            e[1] += a1 * res[0] + b1 * res[1]
            e[2] += a2 * res[0] + b2 * res[1]
            su, sc = unit_slot[u], camera_slot[c]
            ou, oc = 6 * su, 6 * num_units + 7 * sc
            if weight is None:
                if su >= 0:
                    slot = _slot_of(ids, count, su)
                    if slot < 0 and count < MAX_BLOCKS:
                        slot = count
                        ids[slot], offsets[slot], sizes[slot] = su, ou, 6
                        w[slot] = 0.0
                        count += 1
                    for i in range(6):
                        g[ou + i] += ju[0, i] * res[0] + ju[1, i] * res[1]
                        diagonal[ou + i] += ju[0, i] * ju[0, i] + ju[1, i] * ju[1, i]
                        for j in range(i + 1):
                            s[ou + i, ou + j] += ju[0, i] * ju[0, j] + ju[1, i] * ju[1, j]
                        if slot >= 0:
                            for j in range(3):
                                w[slot, i, j] += ju[0, i] * jx[0, j] + ju[1, i] * jx[1, j]
            else:
                for a in range(3):
                    wa = weight[shot, a]
                    sa = -1 if wa == 0.0 else unit_slot[support[shot, a]]
                    if sa < 0:
                        continue
                    oa = 6 * sa
                    slot = _slot_of(ids, count, sa)
                    if slot < 0 and count < MAX_BLOCKS:
                        slot = count
                        ids[slot], offsets[slot], sizes[slot] = sa, oa, 6
                        w[slot] = 0.0
                        count += 1
                    for i in range(6):
                        g[oa + i] += wa * (ju[0, i] * res[0] + ju[1, i] * res[1])
                        diagonal[oa + i] += wa * wa * (ju[0, i] * ju[0, i] + ju[1, i] * ju[1, i])
                        if slot >= 0:
                            for j in range(3):
                                w[slot, i, j] += wa * (ju[0, i] * jx[0, j] + ju[1, i] * jx[1, j])
                    for b in range(3):
                        wb = weight[shot, b]
                        sb = -1 if wb == 0.0 else unit_slot[support[shot, b]]
                        if sb < 0 or sb > sa:
                            continue
                        for i in range(6):
                            for j in range(i + 1 if sb == sa else 6):
                                s[oa + i, 6 * sb + j] += wa * wb * (ju[0, i] * ju[0, j] + ju[1, i] * ju[1, j])
            if sc >= 0:
                slot = _slot_of(ids, count, num_units + sc)
                if slot < 0 and count < MAX_BLOCKS:
                    slot = count
                    ids[slot], offsets[slot], sizes[slot] = num_units + sc, oc, 7
                    w[slot] = 0.0
                    count += 1
                for i in range(7):
                    g[oc + i] += jc[0, i] * res[0] + jc[1, i] * res[1]
                    diagonal[oc + i] += jc[0, i] * jc[0, i] + jc[1, i] * jc[1, i]
                    for j in range(i + 1):
                        s[oc + i, oc + j] += jc[0, i] * jc[0, j] + jc[1, i] * jc[1, j]
                    if weight is None:
                        if su >= 0:
                            for j in range(6):
                                s[oc + i, ou + j] += jc[0, i] * ju[0, j] + jc[1, i] * ju[1, j]
                    else:
                        for a in range(3):
                            wa = weight[shot, a]
                            oa = -1 if wa == 0.0 else 6 * unit_slot[support[shot, a]]
                            if oa >= 0:
                                for j in range(6):
                                    s[oc + i, oa + j] += wa * (jc[0, i] * ju[0, j] + jc[1, i] * ju[1, j])
                    if slot >= 0:
                        for j in range(3):
                            w[slot, i, j] += jc[0, i] * jx[0, j] + jc[1, i] * jx[1, j]
        for i in range(6):
            damped[i] = v[i]
        damped[0] += damping * v[0]
        damped[3] += damping * v[3]
        damped[5] += damping * v[5]
        for i in range(3):
            v_gradient[p, i] = e[i]
        if not _invert3(damped, inv):
            # A point without depth: it stays where it is, and takes no part in the reduction.
            v_inverse[p, :] = 0.0
            continue
        for i in range(6):
            v_inverse[p, i] = inv[i]
        for i in range(count):
            for r in range(sizes[i]):
                x0, x1, x2 = w[i, r, 0], w[i, r, 1], w[i, r, 2]
                wv[r, 0] = x0 * inv[0] + x1 * inv[1] + x2 * inv[2]
                wv[r, 1] = x0 * inv[1] + x1 * inv[3] + x2 * inv[4]
                wv[r, 2] = x0 * inv[2] + x1 * inv[4] + x2 * inv[5]
                g[offsets[i] + r] -= wv[r, 0] * e[0] + wv[r, 1] * e[1] + wv[r, 2] * e[2]
            for j in range(count):
                if offsets[j] > offsets[i]:
                    continue
                oi, oj = offsets[i], offsets[j]
                for r in range(sizes[i]):
                    y0, y1, y2 = wv[r, 0], wv[r, 1], wv[r, 2]
                    for q in range(sizes[j]):
                        s[oi + r, oj + q] -= y0 * w[j, q, 0] + y1 * w[j, q, 1] + y2 * w[j, q, 2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def substitute(
    unit_r: Any, unit_t: Any, shot_r: Any, shot_t: Any, cam_r: Any, cam_t: Any, kind: Any, params: Any, points: Any,
    support: Any, weight: Any, obs_unit: Any, obs_shot: Any, obs_camera: Any, obs_xy: Any, first: Any,
    unit_slot: Any, camera_slot: Any, num_units: int,
    sigma: float, loss2: float, step: Any, v_inverse: Any, v_gradient: Any, lo: int, hi: int, out: Any,
) -> None:  # fmt: skip
    """New points lo..hi after a step of the reduced vector: X - V^-1 (e + sum of W_i' step_i)."""
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    ju, jc, jx, e = np.empty((2, 6)), np.empty((2, 7)), np.empty((2, 3)), np.empty(3)
    for p in range(lo, hi):
        for i in range(3):
            e[i] = v_gradient[p, i]
        for n in range(first[p], first[p + 1]):
            u, c = obs_unit[n], obs_camera[n]
            su, sc = unit_slot[u], camera_slot[c]
            if weight is None and su < 0 and sc < 0:
                continue
            shot = 0 if obs_shot is None else obs_shot[n]
            follows = False if weight is None else weight[shot, 0] != 1.0
            if not _linearise(
                unit_r[u], unit_t[u], shot_r, shot_t, shot, follows, cam_r[c], cam_t[c],
                kind[c], params[c], points[p], obs_xy[n], sigma, loss2,
                d, rig, cam, work, proj, res, ju, jc, jx,
            ):  # fmt: skip
                continue
            m0, m1 = 0.0, 0.0
            if weight is None:
                if su >= 0:
                    for i in range(6):
                        m0 += ju[0, i] * step[6 * su + i]
                        m1 += ju[1, i] * step[6 * su + i]
            else:
                for a in range(3):
                    wa = weight[shot, a]
                    sa = -1 if wa == 0.0 else unit_slot[support[shot, a]]
                    if sa >= 0:
                        for i in range(6):
                            m0 += wa * ju[0, i] * step[6 * sa + i]
                            m1 += wa * ju[1, i] * step[6 * sa + i]
            if sc >= 0:
                o = 6 * num_units + 7 * sc
                for i in range(7):
                    m0 += jc[0, i] * step[o + i]
                    m1 += jc[1, i] * step[o + i]
            for i in range(3):
                e[i] += jx[0, i] * m0 + jx[1, i] * m1
        inv = v_inverse[p]
        out[p, 0] = points[p, 0] - (inv[0] * e[0] + inv[1] * e[1] + inv[2] * e[2])
        out[p, 1] = points[p, 1] - (inv[1] * e[0] + inv[3] * e[1] + inv[4] * e[2])
        out[p, 2] = points[p, 2] - (inv[2] * e[0] + inv[4] * e[1] + inv[5] * e[2])
