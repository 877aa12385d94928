"""The compiled elimination of points: sums over their observations, the reduced matrix, and the way back.

Derivatives of one observation are those of `kernels`. Their products need not be formed one observation at
a time. With d = X - t_u and V = N' N all that an observation adds to its unit's block follows from V and V [d]x, and as
d/dcamera = d/dunit T with a T that all observations of an image share (`add_images`), these sums by image make the
unreduced matrix of units and cameras.

For every point its 3x3 block V (now summed over its observations) and gradient e are eliminated on the spot: with W_i
its coupling to free block i,

    S_ij -= W_i V^-1 W_j'         g_i -= W_i V^-1 e

Points are damped as V + lambda diag V. S is kept as blocks: of the units' pattern (`schur_structure`), of a dense
border of the cameras' rows, and of the cameras' own square; each holds its entries row by row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.bundle_adjustment.kernels import (
    Bands,
    Loss,
    Motion,
    Observed,
    Views,
    linearise,
)
from mrasfm_engine.bundle_adjustment.schur_structure import Groups
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Floats, Ints

UNIT_SUMS = 27  # of an image: its unit's block by its lower triangle, and gradient


def image_sums(inner: int) -> int:
    """Number of an image's sums: its unit's, then of so many `inner` with the unit, with one another, gradient."""
    return UNIT_SUMS + 6 * inner + inner * (inner + 1) // 2 + inner


class Slots(NamedTuple):
    """Slots of units and cameras in the reduced vector, -1 where held; number of free units.

    `inner` is as long as a camera has places besides its pose, for intrinsics and its time offset: a length that is
    part of the type, so that loops over them are compiled for it.
    """

    unit: Ints
    camera: Ints
    num_units: int
    inner: tuple[int, ...]


class Sums(NamedTuple):
    """Output of `accumulate`: sums by image, blocks of the reduced matrix, its gradient, V^-1 and e of the points."""

    images: Floats
    units: Floats
    border: Floats
    cameras: Floats
    gradient: Floats
    v_inverse: Floats
    v_gradient: Floats


@njit(cache=True, forceinline=True, error_model="numpy")
def image_sums_gradient(inner: int) -> int:
    """Place of the gradient of a camera's `inner` unknowns among an image's sums."""
    return UNIT_SUMS + 6 * inner + inner * (inner + 1) // 2


@njit(cache=True, forceinline=True, error_model="numpy")
def _most_blocks(first_block: Any) -> int:
    """Largest number of blocks that a group couples."""
    most = 0
    for i in range(len(first_block) - 1):
        most = max(most, first_block[i + 1] - first_block[i])
    return most


@njit(cache=True, forceinline=True, error_model="numpy")
def _find(blocks: Any, begin: int, end: int, block: int) -> int:
    """Index of a block in blocks[begin:end], counted from begin; -1 where it is not there."""
    for i in range(begin, end):
        if blocks[i] == block:
            return i - begin
    return -1


@njit(cache=True, forceinline=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def invert3(v: Any, out: Any) -> bool:
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
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, obs_image: Any,
    free_slots: Slots, groups: Groups, loss: Loss, damping: float, lo: int, hi: int, sums: Sums,
) -> None:  # fmt: skip
    """Eliminate points order[lo:hi].

    Sums of observations by image are added to `sums.images` (images, see `image_sums`). The elimination is subtracted
    from the matrix: from blocks (b, 36) of the units' pattern, (cameras, units, 6 d) of the border and (cameras,
    cameras, d^2) of the cameras, where d are a camera's unknowns; of all three the lower blocks, and from the gradient
    (n,). Every point's V^-1 (p, 6) and gradient (p, 3) are kept.
    """
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    obs_unit, obs_camera, _, obs_xy, first, fixed = observed
    unit_slot, camera_slot, num_units, inner_places = free_slots
    inner = len(inner_places)
    dof = 6 + inner
    own, own_gradient = UNIT_SUMS + 6 * inner, image_sums_gradient(inner)
    order, first_point, blocks, first_block, places, first_place = groups
    images, s_units, s_border, s_cameras, g, v_inverse, v_gradient = sums
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    jx, jc = np.empty((2, 3)), np.empty((2, dof))
    v, inv, e = np.empty(6), np.empty(6), np.empty(3)
    most = _most_blocks(first_block)
    w = np.empty((most, 3, dof))  # coupling of a point to its blocks, transposed
    # W_j and W_i V^-1, spread over blocks' entries
    tiled, repeated = np.empty((most, 3 * 6 * dof)), np.empty(3 * 6 * dof)
    group = np.searchsorted(first_point, lo, side="right") - 1
    for index in range(lo, hi):
        while index >= first_point[group + 1]:
            group += 1
        b0, b1 = first_block[group], first_block[group + 1]
        p = order[index]
        v[:] = 0.0
        e[:] = 0.0
        w[: b1 - b0] = 0.0
        for n in range(first[p], first[p + 1]):
            u, c = obs_unit[n], obs_camera[n]
            band = 0 if bands is None else bands.of_observation[n]
            follows = np.bool_(False) if motion is None else motion.weight[band, 0] != 1.0
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows, c, cam_r[c], cam_t[c],
                kind[c], params[c], points[p], obs_xy[n], loss,
                d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            a0, a1, a2 = jx[0, 0], jx[0, 1], jx[0, 2]
            c0, c1, c2 = jx[1, 0], jx[1, 1], jx[1, 2]
            r0, r1 = res[0], res[1]
            v00, v01, v02 = a0 * a0 + c0 * c0, a0 * a1 + c0 * c1, a0 * a2 + c0 * c2
            v11, v12, v22 = a1 * a1 + c1 * c1, a1 * a2 + c1 * c2, a2 * a2 + c2 * c2
            e0, e1, e2 = a0 * r0 + c0 * r1, a1 * r0 + c1 * r1, a2 * r0 + c2 * r1
            v[0] += v00
            v[1] += v01
            v[2] += v02
            v[3] += v11
            v[4] += v12
            v[5] += v22
            e[0] += e0
            e[1] += e1
            e[2] += e2
            # V [d]x, row by row: the rotation's part of W', and of the unit's own block.
            d0, d1, d2 = d[0], d[1], d[2]
            t00, t01, t02 = v01 * d2 - v02 * d1, v02 * d0 - v00 * d2, v00 * d1 - v01 * d0
            t10, t11, t12 = v11 * d2 - v12 * d1, v12 * d0 - v01 * d2, v01 * d1 - v11 * d0
            t20, t21, t22 = v12 * d2 - v22 * d1, v22 * d0 - v02 * d2, v02 * d1 - v12 * d0
            s = images[obs_image[n]]
            s[0] += d2 * t10 - d1 * t20
            s[1] += d0 * t20 - d2 * t00
            s[2] += d0 * t21 - d2 * t01
            s[3] += d1 * t00 - d0 * t10
            s[4] += d1 * t01 - d0 * t11
            s[5] += d1 * t02 - d0 * t12
            s[6] -= t00
            s[7] -= t01
            s[8] -= t02
            s[9] += v00
            s[10] -= t10
            s[11] -= t11
            s[12] -= t12
            s[13] += v01
            s[14] += v11
            s[15] -= t20
            s[16] -= t21
            s[17] -= t22
            s[18] += v02
            s[19] += v12
            s[20] += v22
            s[21] += e1 * d2 - e2 * d1
            s[22] += e2 * d0 - e0 * d2
            s[23] += e0 * d1 - e1 * d0
            s[24] -= e0
            s[25] -= e1
            s[26] -= e2
            if motion is None:
                su = unit_slot[u]
                at = -1 if su < 0 else _find(blocks, b0, b1, su)
                if at >= 0:
                    _add_unit(w[at], 1.0, t00, t01, t02, t10, t11, t12, t20, t21, t22, v00, v01, v02, v11, v12, v22)
            else:
                for k in range(3):
                    su = -1 if motion.weight[band, k] == 0.0 else unit_slot[motion.support[band, k]]
                    at = -1 if su < 0 else _find(blocks, b0, b1, su)
                    if at >= 0:
                        _add_unit(
                            w[at], motion.weight[band, k],
                            t00, t01, t02, t10, t11, t12, t20, t21, t22, v00, v01, v02, v11, v12, v22,
                        )  # fmt: skip
            sc = camera_slot[c]
            if sc >= 0:
                for k in range(inner):
                    f0, f1 = jc[0, 6 + k], jc[1, 6 + k]
                    n0, n1, n2 = f0 * a0 + f1 * c0, f0 * a1 + f1 * c1, f0 * a2 + f1 * c2
                    o = UNIT_SUMS + 6 * k
                    s[o] += n1 * d2 - n2 * d1
                    s[o + 1] += n2 * d0 - n0 * d2
                    s[o + 2] += n0 * d1 - n1 * d0
                    s[o + 3] -= n0
                    s[o + 4] -= n1
                    s[o + 5] -= n2
                    for other in range(k + 1):
                        s[own + k * (k + 1) // 2 + other] += f0 * jc[0, 6 + other] + f1 * jc[1, 6 + other]
                    s[own_gradient + k] += f0 * r0 + f1 * r1
                at = _find(blocks, b0, b1, num_units + sc)
                if at >= 0:
                    wc = w[at]
                    for i in range(dof):
                        x0, x1 = jc[0, i], jc[1, i]
                        wc[0, i] += x0 * a0 + x1 * c0
                        wc[1, i] += x0 * a1 + x1 * c1
                        wc[2, i] += x0 * a2 + x1 * c2
        for i in range(3):
            v_gradient[p, i] = e[i]
        v[0] += damping * v[0]
        v[3] += damping * v[3]
        v[5] += damping * v[5]
        if fixed[p] or not invert3(v, inv):
            # A point that is fixed or without depth stays where it is, and takes no part in the reduction.
            v_inverse[p, :] = 0.0
            continue
        for i in range(6):
            v_inverse[p, i] = inv[i]
        x0 = inv[0] * e[0] + inv[1] * e[1] + inv[2] * e[2]
        x1 = inv[1] * e[0] + inv[3] * e[1] + inv[4] * e[2]
        x2 = inv[2] * e[0] + inv[4] * e[1] + inv[5] * e[2]
        for i in range(b1 - b0):
            block = blocks[b0 + i]
            rows = 6 if block < num_units else dof
            o = 6 * block if block < num_units else 6 * num_units + dof * (block - num_units)
            for a in range(rows):
                g[o + a] -= w[i, 0, a] * x0 + w[i, 1, a] * x1 + w[i, 2, a] * x2
        _subtract_products(
            w, inv, tiled, repeated, blocks, b0, b1, num_units, inner_places,
            places, first_place[group], s_units, s_border, s_cameras,
        )  # fmt: skip


@njit(cache=True, forceinline=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _add_unit(
    w: Any, weight: float, t00: float, t01: float, t02: float, t10: float, t11: float, t12: float, t20: float,
    t21: float, t22: float, v00: float, v01: float, v02: float, v11: float, v12: float, v22: float,
) -> None:  # fmt: skip
    """Add weight [V [d]x, -V] to w (3, at least 6)."""
    w[0, 0] += weight * t00
    w[0, 1] += weight * t01
    w[0, 2] += weight * t02
    w[0, 3] -= weight * v00
    w[0, 4] -= weight * v01
    w[0, 5] -= weight * v02
    w[1, 0] += weight * t10
    w[1, 1] += weight * t11
    w[1, 2] += weight * t12
    w[1, 3] -= weight * v01
    w[1, 4] -= weight * v11
    w[1, 5] -= weight * v12
    w[2, 0] += weight * t20
    w[2, 1] += weight * t21
    w[2, 2] += weight * t22
    w[2, 3] -= weight * v02
    w[2, 4] -= weight * v12
    w[2, 5] -= weight * v22


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _subtract_products(
    w: Any, inv: Any, tiled: Any, repeated: Any, blocks: Any, b0: int, b1: int, num_units: int,
    inner_places: Any, places: Any, place: int, s_units: Any, s_border: Any, s_cameras: Any,
) -> None:  # fmt: skip
    """S_ij -= W_i V^-1 W_j' for all pairs of a point's blocks.

    Entry (a, b) of a product needs row a of W_i V^-1 and row b of W_j. Both are first spread over the 6 columns of a
    block, so that one loop without gaps runs over all of its entries.
    """
    dof = 6 + len(inner_places)
    count, wide = b1 - b0, 6 * dof
    for i in range(count):
        block = blocks[b0 + i]
        rows = 6 if block < num_units else dof
        for a in range(rows):
            x0, x1, x2 = w[i, 0, a], w[i, 1, a], w[i, 2, a]
            y0 = x0 * inv[0] + x1 * inv[1] + x2 * inv[2]
            y1 = x0 * inv[1] + x1 * inv[3] + x2 * inv[4]
            y2 = x0 * inv[2] + x1 * inv[4] + x2 * inv[5]
            for k in range(6 * a, 6 * a + 6):
                repeated[k], repeated[wide + k], repeated[2 * wide + k] = y0, y1, y2
        if rows == 6:
            for a in range(6):
                x0, x1, x2 = w[i, 0, a], w[i, 1, a], w[i, 2, a]
                for k in range(a, wide, 6):
                    tiled[i, k], tiled[i, wide + k], tiled[i, 2 * wide + k] = x0, x1, x2
        entries = 6 * rows
        for j in range(i + 1):
            other = blocks[b0 + j]
            if other >= num_units:
                target = s_cameras[block - num_units, other - num_units]
                for a in range(dof):
                    y0, y1, y2 = repeated[6 * a], repeated[wide + 6 * a], repeated[2 * wide + 6 * a]
                    for b in range(dof):
                        target[dof * a + b] -= y0 * w[j, 0, b] + y1 * w[j, 1, b] + y2 * w[j, 2, b]
                continue
            target = s_units[places[place + i * (i + 1) // 2 + j]] if rows == 6 else s_border[block - num_units, other]
            source = tiled[j]
            for k in range(entries):
                target[k] -= (
                    repeated[k] * source[k]
                    + repeated[wide + k] * source[wide + k]
                    + repeated[2 * wide + k] * source[2 * wide + k]
                )


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def add_images(
    views: Views, bands: Bands | None, motion: Motion | None, image_unit: Any, image_camera: Any, image_band: Any,
    free_slots: Slots, first_row: Any, rows: Any, images: Any, s_units: Any, s_border: Any, s_cameras: Any,
    diagonal: Any, g: Any,
) -> None:  # fmt: skip
    """Add the sums of every image to the matrix, to the undamped diagonal (n,) and to the gradient (n,).

    A camera's derivatives follow from the unit's: d/dcamera = d/dunit T with

        T = [ R     0 ]      R = world_from_band's rotation, q = the camera's place from that about which the unit turns
            [ [q]xR R ]

    so that of all products of Jacobians only the unit's are summed over observations.
    """
    unit_slot, camera_slot, num_units, inner_places = free_slots
    inner = len(inner_places)
    dof = 6 + inner
    own, own_gradient = UNIT_SUMS + 6 * inner, image_sums_gradient(inner)
    h, t, th, r, q = np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6)), np.empty((3, 3)), np.empty(3)
    for image in range(len(images)):
        u, c, band = image_unit[image], image_camera[image], image_band[image]
        s = images[image]
        k = 0
        for i in range(6):
            for j in range(i + 1):
                h[i, j] = h[j, i] = s[k]
                k += 1
        sc = camera_slot[c]
        if sc >= 0:
            _camera_from_unit(views.unit_r[u], bands, motion, band, views.cam_t[c], r, q, t)
            for i in range(6):
                for j in range(6):
                    x = 0.0
                    for k in range(6):
                        x += t[k, i] * h[k, j]
                    th[i, j] = x
            o = 6 * num_units + dof * sc
            square = s_cameras[sc, sc]
            for i in range(6):
                x = 0.0
                for k in range(6):
                    x += t[k, i] * s[21 + k]
                g[o + i] += x
                for f in range(inner):
                    y = 0.0
                    for k in range(6):
                        y += t[k, i] * s[UNIT_SUMS + 6 * f + k]
                    square[dof * (6 + f) + i] += y
                for j in range(6):
                    z = 0.0
                    for k in range(6):
                        z += th[i, k] * t[k, j]
                    square[dof * i + j] += z
                    if i == j:
                        diagonal[o + i] += z
            for f in range(inner):
                g[o + 6 + f] += s[own_gradient + f]
                for other in range(f + 1):
                    square[dof * (6 + f) + 6 + other] += s[own + f * (f + 1) // 2 + other]
                diagonal[o + 6 + f] += s[own + f * (f + 1) // 2 + f]
        for a in range(3):
            if motion is None:
                if a > 0:
                    break
                wa, sa = 1.0, unit_slot[u]
            else:
                wa = motion.weight[band, a]
                sa = -1 if wa == 0.0 else unit_slot[motion.support[band, a]]
            if sa < 0:
                continue
            for i in range(6):
                g[6 * sa + i] += wa * s[21 + i]
                diagonal[6 * sa + i] += wa * wa * h[i, i]
            if sc >= 0:
                border = s_border[sc, sa]
                for j in range(6):
                    for i in range(6):
                        border[6 * i + j] += wa * th[i, j]
                    for f in range(inner):
                        border[36 + 6 * f + j] += wa * s[UNIT_SUMS + 6 * f + j]
            for b in range(3):
                if motion is None:
                    if b > 0:
                        break
                    wb, sb = 1.0, sa
                else:
                    wb = motion.weight[band, b]
                    sb = -1 if wb == 0.0 else unit_slot[motion.support[band, b]]
                if sb < 0 or sb > sa:
                    continue
                at = first_row[sb] + np.searchsorted(rows[first_row[sb] : first_row[sb + 1]], sa)
                if at >= first_row[sb + 1] or rows[at] != sa:
                    continue  # only where points have more units than they may couple
                block = s_units[at]
                for i in range(6):
                    for j in range(6):
                        block[6 * i + j] += wa * wb * h[i, j]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def _camera_from_unit(
    unit_r: Any, bands: Bands | None, motion: Motion | None, band: int, cam_t: Any, r: Any, q: Any, t: Any
) -> None:
    """R, q and T of `add_images` for one image."""
    if bands is None:
        for i in range(3):
            q[i] = 0.0
            for j in range(3):
                r[i, j] = unit_r[i, j]
                q[i] += unit_r[i, j] * cam_t[j]
    else:
        follows = np.bool_(False) if motion is None else motion.weight[band, 0] != 1.0
        for i in range(3):
            q[i] = 0.0
            for j in range(3):
                r[i, j] = 0.0
                for k in range(3):
                    r[i, j] += unit_r[i, k] * bands.r[band, k, j]
                q[i] += r[i, j] * cam_t[j]
                if not follows:
                    q[i] += unit_r[i, j] * bands.t[band, j]
    for j in range(3):
        for i in range(3):
            t[i, j] = t[3 + i, 3 + j] = r[i, j]
        t[3, j] = q[1] * r[2, j] - q[2] * r[1, j]
        t[4, j] = q[2] * r[0, j] - q[0] * r[2, j]
        t[5, j] = q[0] * r[1, j] - q[1] * r[0, j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def substitute(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, step: Any, v_inverse: Any, v_gradient: Any, lo: int, hi: int, out: Any,
) -> None:  # fmt: skip
    """New points lo..hi after a step of the reduced vector: X - V^-1 (e + sum of W_i' step_i)."""
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof = 6 + len(inner_places)
    jx, jc, e = np.empty((2, 3)), np.empty((2, dof)), np.empty(3)
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    obs_unit, obs_camera, _, obs_xy, first, _ = observed
    for p in range(lo, hi):
        for i in range(3):
            e[i] = v_gradient[p, i]
        for n in range(first[p], first[p + 1]):
            u, c = obs_unit[n], obs_camera[n]
            su, sc = unit_slot[u], camera_slot[c]
            if motion is None and su < 0 and sc < 0:
                continue
            band = 0 if bands is None else bands.of_observation[n]
            follows = np.bool_(False) if motion is None else motion.weight[band, 0] != 1.0
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows, c, cam_r[c], cam_t[c],
                kind[c], params[c], points[p], obs_xy[n], loss,
                d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            # A unit's step moves the residual as moving the point by (X - t_u) x omega - tau does.
            x0, x1, x2 = 0.0, 0.0, 0.0
            for a in range(3):
                if motion is None:
                    if a > 0:
                        break
                    wa, sa = 1.0, su
                else:
                    wa = motion.weight[band, a]
                    sa = -1 if wa == 0.0 else unit_slot[motion.support[band, a]]
                if sa >= 0:
                    o = 6 * sa
                    x0 += wa * (d[1] * step[o + 2] - d[2] * step[o + 1] - step[o + 3])
                    x1 += wa * (d[2] * step[o] - d[0] * step[o + 2] - step[o + 4])
                    x2 += wa * (d[0] * step[o + 1] - d[1] * step[o] - step[o + 5])
            m0 = jx[0, 0] * x0 + jx[0, 1] * x1 + jx[0, 2] * x2
            m1 = jx[1, 0] * x0 + jx[1, 1] * x1 + jx[1, 2] * x2
            if sc >= 0:
                o = 6 * num_units + dof * sc
                for i in range(dof):
                    m0 += jc[0, i] * step[o + i]
                    m1 += jc[1, i] * step[o + i]
            for i in range(3):
                e[i] += jx[0, i] * m0 + jx[1, i] * m1
        inv = v_inverse[p]
        out[p, 0] = points[p, 0] - (inv[0] * e[0] + inv[1] * e[1] + inv[2] * e[2])
        out[p, 1] = points[p, 1] - (inv[1] * e[0] + inv[3] * e[1] + inv[4] * e[2])
        out[p, 2] = points[p, 2] - (inv[2] * e[0] + inv[4] * e[1] + inv[5] * e[2])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"})
def add_scores(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, free_slots: Slots,
    loss: Loss, columns: Any, v_inverse: Any, image: Any, most: int, lo: int, hi: int, out: Any,
) -> None:  # fmt: skip
    """Add r' (J_poses x + J_point y) of the observations of points lo..hi, y = -V^-1 W' x, to their images' scores."""
    d, rig, cam, work, proj, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8), np.empty(2)
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof, count = 6 + len(inner_places), columns.shape[1]
    jx, jc, inv = np.empty((2, 3)), np.empty((2, dof)), np.empty((3, 3))
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    along, normal = np.empty((2, count)), np.empty((most, 3))  # of an observation; J_point' r of each
    e, shift = np.empty((3, count)), np.empty((3, count))
    for p in range(lo, hi):
        begin, end = observed.first[p], observed.first[p + 1]
        e[:] = 0.0
        for n in range(begin, end):
            u, c = observed.unit[n], observed.camera[n]
            band = 0 if bands is None else bands.of_observation[n]
            follows = np.bool_(False) if motion is None else motion.weight[band, 0] != 1.0
            normal[n - begin] = 0.0
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows, c, cam_r[c], cam_t[c], kind[c], params[c],
                points[p], observed.xy[n], loss, d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            # A unit's step moves the residual as moving the point by (X - t_u) x omega - tau does.
            shift[:] = 0.0
            for a in range(3):
                if motion is None:
                    if a > 0:
                        break
                    weight, slot = 1.0, unit_slot[u]
                else:
                    weight = motion.weight[band, a]
                    slot = -1 if weight == 0.0 else unit_slot[motion.support[band, a]]
                if slot >= 0:
                    o = 6 * slot
                    for k in range(count):
                        w0, w1, w2 = columns[o, k], columns[o + 1, k], columns[o + 2, k]
                        shift[0, k] += weight * (d[1] * w2 - d[2] * w1 - columns[o + 3, k])
                        shift[1, k] += weight * (d[2] * w0 - d[0] * w2 - columns[o + 4, k])
                        shift[2, k] += weight * (d[0] * w1 - d[1] * w0 - columns[o + 5, k])
            for i in range(2):
                for k in range(count):
                    along[i, k] = jx[i, 0] * shift[0, k] + jx[i, 1] * shift[1, k] + jx[i, 2] * shift[2, k]
            if camera_slot[c] >= 0:
                o = 6 * num_units + dof * camera_slot[c]
                for i in range(2):
                    for j in range(dof):
                        for k in range(count):
                            along[i, k] += jc[i, j] * columns[o + j, k]
            for k in range(count):
                out[image[n], k] += res[0] * along[0, k] + res[1] * along[1, k]
            for j in range(3):
                normal[n - begin, j] = jx[0, j] * res[0] + jx[1, j] * res[1]
                for k in range(count):
                    e[j, k] += jx[0, j] * along[0, k] + jx[1, j] * along[1, k]
        if observed.fixed[p]:
            continue
        v = v_inverse[p]
        inv[0, 0], inv[1, 1], inv[2, 2] = v[0], v[3], v[5]
        inv[0, 1] = inv[1, 0] = v[1]
        inv[0, 2] = inv[2, 0] = v[2]
        inv[1, 2] = inv[2, 1] = v[4]
        for i in range(3):
            for k in range(count):
                shift[i, k] = inv[i, 0] * e[0, k] + inv[i, 1] * e[1, k] + inv[i, 2] * e[2, k]
        for n in range(begin, end):
            q = normal[n - begin]
            for k in range(count):
                out[image[n], k] -= q[0] * shift[0, k] + q[1] * shift[1, k] + q[2] * shift[2, k]
