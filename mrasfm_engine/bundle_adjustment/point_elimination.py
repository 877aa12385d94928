"""The compiled elimination of points: sums over their observations, and the reduced matrix.

An observation counts in the sums of its image (`image_sums`), whose blocks make the unreduced matrix. For every point
its 3x3 block V = N' N (summed over its observations) and gradient e are eliminated on the spot: with W_i its coupling
to free block i,

    S_ij -= W_i V^-1 W_j'         g_i -= W_i V^-1 e

Points are damped as V + lambda diag V. S is kept as blocks: of the units' pattern (`schur_structure`), of a dense
border of the cameras' rows, and of the cameras' own square; each holds its entries row by row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.bundle_adjustment.image_sums import add_inner_sums, add_unit_sums, as_tuples, observation_products
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
from mrasfm_engine.bundle_adjustment.schur_structure import Groups
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Floats


class Sums(NamedTuple):
    """Output of `accumulate`: sums by image, blocks of the reduced matrix, its gradient, V^-1 and e of the points."""

    images: Floats
    units: Floats
    border: Floats
    cameras: Floats
    gradient: Floats
    v_inverse: Floats
    v_gradient: Floats


@uncounted(forceinline=True)
def _most_blocks(first_block: Any) -> int:
    """Largest number of blocks that a group couples."""
    most = 0
    for i in range(len(first_block) - 1):
        most = max(most, first_block[i + 1] - first_block[i])
    return most


@uncounted(forceinline=True)
def _find(blocks: Any, begin: int, end: int, block: int) -> int:
    """Index of a block in blocks[begin:end], counted from begin; -1 where it is not there."""
    for i in range(begin, end):
        if blocks[i] == block:
            return i - begin
    return -1


@uncounted(forceinline=True)
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


@uncounted(forceinline=True)
def multiply3(m: Any, x0: float, x1: float, x2: float) -> tuple[float, float, float]:
    """Product of a symmetric 3x3 matrix, kept as that of `invert3`, with a vector."""
    return (
        m[0] * x0 + m[1] * x1 + m[2] * x2,
        m[1] * x0 + m[3] * x1 + m[4] * x2,
        m[2] * x0 + m[4] * x1 + m[5] * x2,
    )


@njit(cache=True, nogil=True)
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
    dof = 6 + len(free_slots.inner)
    most = _most_blocks(groups.first_block)
    w = np.empty((most, 3, dof))  # coupling of a point to its blocks, transposed
    _accumulate(
        views, bands, motion, points, observed, obs_image, free_slots, groups, loss, damping, lo, hi, sums,
        workspace(dof), np.empty(6), np.empty(6), np.empty(3), w, np.empty((dof, 3)),
    )  # fmt: skip


@uncounted()
def _accumulate(
    views: Views, bands: Bands | None, motion: Motion | None, points: Any, observed: Observed, obs_image: Any,
    free_slots: Slots, groups: Groups, loss: Loss, damping: float, lo: int, hi: int, sums: Sums,
    memory: Any, v: Any, inv: Any, e: Any, w: Any, y: Any,
) -> None:  # fmt: skip
    unit_r, unit_t, cam_r, cam_t, kind, params = views
    obs_unit, obs_camera, _, obs_xy, first, fixed = observed
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof = 6 + len(inner_places)
    order, first_point, blocks, first_block, places, first_place = groups
    images, s_units, s_border, s_cameras, g, v_inverse, v_gradient = sums
    d, rig, cam, work, proj, res, jx, jc = memory
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
            u, c, band = obs_unit[n], obs_camera[n], row_band(bands, n)
            slot_of_camera = camera_slot[c]
            if not linearise(
                unit_r[u], unit_t[u], bands, band, follows_trajectory(motion, band), c, slot_of_camera >= 0,
                cam_r[c], cam_t[c], kind[c], params[c], points[p], obs_xy[n], loss,
                d, rig, cam, work, proj, res, jx, jc,
            ):  # fmt: skip
                continue
            n_rows, dn, rn = as_tuples(jx, d, res)
            vn, tn, en = observation_products(n_rows, dn, rn)
            _add_point(v, e, vn, en)
            s = images[obs_image[n]]
            add_unit_sums(s, dn, vn, tn, en)
            for k in range(num_supports(motion)):
                slot, weight = support(motion, unit_slot, u, band, k)
                at = -1 if slot < 0 else _find(blocks, b0, b1, slot)
                if at >= 0:
                    _couple_unit(w[at], weight, tn, vn)
            if slot_of_camera >= 0:
                add_inner_sums(s, dn, n_rows, jc, rn, inner_places)
                at = _find(blocks, b0, b1, num_units + slot_of_camera)
                if at >= 0:
                    _couple_camera(w[at], n_rows, jc)
        for i in range(3):
            v_gradient[p, i] = e[i]
        _damp(v, damping)
        if fixed[p] or not invert3(v, inv):
            # A point that is fixed or without depth stays where it is, and takes no part in the reduction.
            v_inverse[p, :] = 0.0
            continue
        for i in range(6):
            v_inverse[p, i] = inv[i]
        _subtract_gradient(w, inv, e, blocks, b0, b1, num_units, dof, g)
        _subtract_products(
            w, inv, y, blocks, b0, b1, num_units, inner_places, places, first_place[group],
            s_units, s_border, s_cameras,
        )  # fmt: skip


@uncounted(forceinline=True)
def _damp(v: Any, damping: float) -> None:
    """Add damping diag V to V."""
    v[0] += damping * v[0]
    v[3] += damping * v[3]
    v[5] += damping * v[5]


@uncounted(forceinline=True)
def _add_point(v: Any, e: Any, block: Any, gradient: Any) -> None:
    """Add an observation to its point's V and e."""
    v00, v01, v02, v11, v12, v22 = block
    e0, e1, e2 = gradient
    v[0] += v00
    v[1] += v01
    v[2] += v02
    v[3] += v11
    v[4] += v12
    v[5] += v22
    e[0] += e0
    e[1] += e1
    e[2] += e2


@uncounted(forceinline=True)
def _couple_unit(w: Any, weight: float, t: Any, v: Any) -> None:
    """Add weight [V [d]x, -V] of an observation to w (3, at least 6)."""
    v00, v01, v02, v11, v12, v22 = v
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = t
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


@uncounted(forceinline=True)
def _couple_camera(w: Any, n_rows: Any, jc: Any) -> None:
    """Add N' J of an observation, J its derivatives in the camera, to w (3, camera's unknowns)."""
    (a0, a1, a2), (c0, c1, c2) = n_rows
    for i in range(jc.shape[1]):
        x0, x1 = jc[0, i], jc[1, i]
        w[0, i] += x0 * a0 + x1 * c0
        w[1, i] += x0 * a1 + x1 * c1
        w[2, i] += x0 * a2 + x1 * c2


@uncounted(forceinline=True)
def _subtract_gradient(
    w: Any, inv: Any, e: Any, blocks: Any, b0: int, b1: int, num_units: int, dof: int, g: Any
) -> None:
    """g_i -= W_i V^-1 e for all of a point's blocks."""
    x0, x1, x2 = multiply3(inv, e[0], e[1], e[2])
    for i in range(b1 - b0):
        block = blocks[b0 + i]
        rows = 6 if block < num_units else dof
        o = 6 * block if block < num_units else 6 * num_units + dof * (block - num_units)
        for a in range(rows):
            g[o + a] -= w[i, 0, a] * x0 + w[i, 1, a] * x1 + w[i, 2, a] * x2


@uncounted()
def _subtract_products(
    w: Any, inv: Any, y: Any, blocks: Any, b0: int, b1: int, num_units: int, inner_places: Any,
    places: Any, place: int, s_units: Any, s_border: Any, s_cameras: Any,
) -> None:  # fmt: skip
    """S_ij -= W_i V^-1 W_j' for all pairs of a point's blocks."""
    dof = 6 + len(inner_places)
    for i in range(b1 - b0):
        block = blocks[b0 + i]
        for a in range(6 if block < num_units else dof):
            y[a, 0], y[a, 1], y[a, 2] = multiply3(inv, w[i, 0, a], w[i, 1, a], w[i, 2, a])
        for j in range(i + 1):
            other = blocks[b0 + j]
            if block < num_units:
                _subtract_product(y, 6, w, j, s_units, places[place + i * (i + 1) // 2 + j])
            elif other < num_units:
                _subtract_product(y, dof, w, j, s_border[block - num_units], other)
            else:
                target = s_cameras[block - num_units, other - num_units]
                for a in range(dof):
                    for b in range(dof):
                        target[dof * a + b] -= y[a, 0] * w[j, 0, b] + y[a, 1] * w[j, 1, b] + y[a, 2] * w[j, 2, b]


@uncounted(forceinline=True)
def _subtract_product(y: Any, rows: int, w: Any, j: int, out: Any, at: int) -> None:
    """Subtract Y W_j' (rows, 6) from the block out[at], which holds its entries row by row.

    All of W_j is read before the first row is written: written out like this, LLVM keeps it in vector registers, as
    it need not ask whether the block is a part of it.
    """
    a0, a1, a2, a3, a4, a5 = w[j, 0, 0], w[j, 0, 1], w[j, 0, 2], w[j, 0, 3], w[j, 0, 4], w[j, 0, 5]
    b0, b1, b2, b3, b4, b5 = w[j, 1, 0], w[j, 1, 1], w[j, 1, 2], w[j, 1, 3], w[j, 1, 4], w[j, 1, 5]
    c0, c1, c2, c3, c4, c5 = w[j, 2, 0], w[j, 2, 1], w[j, 2, 2], w[j, 2, 3], w[j, 2, 4], w[j, 2, 5]
    for row in range(rows):
        y0, y1, y2, k = y[row, 0], y[row, 1], y[row, 2], 6 * row
        out[at, k] -= y0 * a0 + y1 * b0 + y2 * c0
        out[at, k + 1] -= y0 * a1 + y1 * b1 + y2 * c1
        out[at, k + 2] -= y0 * a2 + y1 * b2 + y2 * c2
        out[at, k + 3] -= y0 * a3 + y1 * b3 + y2 * c3
        out[at, k + 4] -= y0 * a4 + y1 * b4 + y2 * c4
        out[at, k + 5] -= y0 * a5 + y1 * b5 + y2 * c5
