"""Sums of observations by image, and the blocks of units and cameras that follow from them.

Derivatives of one observation are those of `kernels`. Their products need not be formed one observation at a time. With
d = X - t_u and V = N' N all that an observation adds to its unit's block follows from V and V [d]x, and as d/dcamera =
d/dunit T with a T that all observations of an image share (`add_images`), these sums by image make the unreduced matrix
of units and cameras.

An image's sums are, one after another: its unit's block by its lower triangle; the unit's gradient; the products of the
camera's unknowns besides its pose (`kernels.Slots.inner`) with the unit, 6 of each; these unknowns with one another by
the lower triangle; their gradient.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.kernels import (
    Bands,
    Motion,
    Slots,
    Views,
    follows_trajectory,
    num_supports,
    support,
)
from mrasfm_engine.jit import njit, uncounted

UNIT_SUMS = 27  # of an image: its unit's block by its lower triangle, and gradient


def num_image_sums(inner: int) -> int:
    """Number of an image's sums, of a camera with so many `inner` unknowns."""
    return UNIT_SUMS + 6 * inner + inner * (inner + 1) // 2 + inner


@uncounted(forceinline=True)
def _inner_sums(inner: int) -> tuple[int, int]:
    """Places of the products of a camera's `inner` unknowns with one another, and of their gradient."""
    own = UNIT_SUMS + 6 * inner
    return own, own + inner * (inner + 1) // 2


@uncounted(forceinline=True)
def as_tuples(jx: Any, d: Any, res: Any) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...], tuple[float, ...]]:
    """Rows of N, X - t_u and the residual of an observation.

    Numbers, unlike elements of arrays, are not read again after each sum that is written: it may be the same array.
    """
    rows = (jx[0, 0], jx[0, 1], jx[0, 2]), (jx[1, 0], jx[1, 1], jx[1, 2])
    return rows, (d[0], d[1], d[2]), (res[0], res[1])


@uncounted(forceinline=True)
def observation_products(n_rows: Any, d: Any, r: Any) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """V = N' N by its upper triangle, V [d]x row by row, and N' r of an observation."""
    (a0, a1, a2), (c0, c1, c2) = n_rows
    d0, d1, d2 = d
    r0, r1 = r
    v00, v01, v02 = a0 * a0 + c0 * c0, a0 * a1 + c0 * c1, a0 * a2 + c0 * c2
    v11, v12, v22 = a1 * a1 + c1 * c1, a1 * a2 + c1 * c2, a2 * a2 + c2 * c2
    return (
        (v00, v01, v02, v11, v12, v22),
        (
            v01 * d2 - v02 * d1, v02 * d0 - v00 * d2, v00 * d1 - v01 * d0,
            v11 * d2 - v12 * d1, v12 * d0 - v01 * d2, v01 * d1 - v11 * d0,
            v12 * d2 - v22 * d1, v22 * d0 - v02 * d2, v02 * d1 - v12 * d0,
        ),
        (a0 * r0 + c0 * r1, a1 * r0 + c1 * r1, a2 * r0 + c2 * r1),
    )  # fmt: skip


@uncounted(forceinline=True)
def add_unit_sums(s: Any, d: Any, v: Any, t: Any, e: Any) -> None:
    """Add an observation with the `observation_products` v, t and e to the unit's sums of its image."""
    v00, v01, v02, v11, v12, v22 = v
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = t
    e0, e1, e2 = e
    d0, d1, d2 = d
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


@uncounted(forceinline=True)
def add_inner_sums(s: Any, d: Any, n_rows: Any, jc: Any, r: Any, inner_places: Any) -> None:
    """Add an observation to the sums of its image with the camera's unknowns besides its pose."""
    own, own_gradient = _inner_sums(len(inner_places))
    (a0, a1, a2), (c0, c1, c2) = n_rows
    r0, r1 = r
    d0, d1, d2 = d
    for k in range(len(inner_places)):
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


@njit(cache=True, nogil=True)
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
    _add_images(
        views, bands, motion, image_unit, image_camera, image_band, free_slots, first_row, rows, images,
        s_units, s_border, s_cameras, diagonal, g,
        np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6)), np.empty((3, 3)), np.empty(3),
    )  # fmt: skip


@uncounted()
def _add_images(
    views: Views, bands: Bands | None, motion: Motion | None, image_unit: Any, image_camera: Any, image_band: Any,
    free_slots: Slots, first_row: Any, rows: Any, images: Any, s_units: Any, s_border: Any, s_cameras: Any,
    diagonal: Any, g: Any, h: Any, t: Any, th: Any, r: Any, q: Any,
) -> None:  # fmt: skip
    unit_slot, camera_slot, num_units, inner_places = free_slots
    dof = 6 + len(inner_places)
    for image in range(len(images)):
        u, c, band = image_unit[image], image_camera[image], image_band[image]
        s = images[image]
        _unit_block(s, h)
        sc = camera_slot[c]
        if sc >= 0:
            _camera_from_unit(views.unit_r[u], bands, motion, band, views.cam_t[c], r, q, t)
            _multiply_transposed(t, h, th)
            _add_camera(s, t, th, inner_places, s_cameras[sc, sc], 6 * num_units + dof * sc, diagonal, g)
        for a in range(num_supports(motion)):
            sa, wa = support(motion, unit_slot, u, band, a)
            if sa < 0:
                continue
            for i in range(6):
                g[6 * sa + i] += wa * s[21 + i]
                diagonal[6 * sa + i] += wa * wa * h[i, i]
            if sc >= 0:
                _add_border(s, th, wa, inner_places, s_border[sc, sa])
            for b in range(num_supports(motion)):
                sb, wb = support(motion, unit_slot, u, band, b)
                if sb < 0 or sb > sa:
                    continue
                at = first_row[sb] + np.searchsorted(rows[first_row[sb] : first_row[sb + 1]], sa)
                if at >= first_row[sb + 1] or rows[at] != sa:
                    continue  # only where points have more units than they may couple
                block = s_units[at]
                for i in range(6):
                    for j in range(6):
                        block[6 * i + j] += wa * wb * h[i, j]


@uncounted(forceinline=True)
def _unit_block(s: Any, h: Any) -> None:
    """Unit's block h (6, 6) of an image's sums."""
    k = 0
    for i in range(6):
        for j in range(i + 1):
            h[i, j] = h[j, i] = s[k]
            k += 1


@uncounted()
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
        follows = follows_trajectory(motion, band)
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


@uncounted(forceinline=True)
def _multiply_transposed(t: Any, h: Any, th: Any) -> None:
    """T' H of 6x6 matrices."""
    for i in range(6):
        for j in range(6):
            x = 0.0
            for k in range(6):
                x += t[k, i] * h[k, j]
            th[i, j] = x


@uncounted(forceinline=True)
def _add_camera(s: Any, t: Any, th: Any, inner_places: Any, square: Any, o: int, diagonal: Any, g: Any) -> None:
    """Add an image to its camera's block with itself, and to the diagonal and gradient from the camera's first place o.

    Places that hold the pose get T' H T, T' times the unit's products with `inner` unknowns and T' times its gradient.
    """
    inner = len(inner_places)
    dof = 6 + inner
    own, own_gradient = _inner_sums(inner)
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


@uncounted(forceinline=True)
def _add_border(s: Any, th: Any, weight: float, inner_places: Any, border: Any) -> None:
    """Add an image to the block of its camera with a unit that moves it by a weight."""
    for j in range(6):
        for i in range(6):
            border[6 * i + j] += weight * th[i, j]
        for f in range(len(inner_places)):
            border[36 + 6 * f + j] += weight * s[UNIT_SUMS + 6 * f + j]
