"""Visibility: which primitive each sample of an image sees, by z-buffer.

A flat primitive `origin + a u + b v` seen along the ray `d = (x, y, 1)` at depth t obeys `G (a, b, 1) = t d` with
`G = [u v origin - centre]`, so that `(a / t, b / t, 1 / t) = inverse(G) d` is linear in the ray: the four numbers
A, B, W and the depth key D that the kernels speak of. For a parallel projection W is 1 and D grows towards the viewer.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.jit import njit

NEAR_M = 0.15

# Only parts of D that are positive are drawn; this is 1 / 5 km.
_FARTHEST = 2e-4


@njit(cache=True, nogil=True, error_model="numpy")
def prepare_perspective(
    origin: Any, u: Any, v: Any, is_triangle: Any, cam_from_world: Any, window: Any, plane: Any, bounds: Any, key: Any
) -> None:
    """Fill `plane` (n, 4, 3), rows A B W D, `bounds` (n, 4) in ideal coordinates (empty: unseen) and sort keys `key`.

    `window` is xmin, ymin, xmax, ymax of the image in ideal coordinates (x / z, y / z).
    """
    n = origin.shape[0]
    corner = np.empty((4, 3))
    e = np.empty((3, 3))
    for i in range(n):
        for r in range(3):
            cx, cy, cz = cam_from_world[r, 0], cam_from_world[r, 1], cam_from_world[r, 2]
            e[0, r] = cx * u[i, 0] + cy * u[i, 1] + cz * u[i, 2]
            e[1, r] = cx * v[i, 0] + cy * v[i, 1] + cz * v[i, 2]
            e[2, r] = cx * origin[i, 0] + cy * origin[i, 1] + cz * origin[i, 2] + cam_from_world[r, 3]
        corners = 3 if is_triangle[i] else 4
        for r in range(3):
            corner[0, r] = e[2, r]
            corner[1, r] = e[2, r] + e[0, r]
            if corners == 3:
                corner[2, r] = e[2, r] + e[1, r]
            else:
                corner[2, r] = e[2, r] + e[0, r] + e[1, r]
                corner[3, r] = e[2, r] + e[1, r]
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = 1.0, 1.0, 0.0, 0.0
        key[i] = 1e30
        x0, y0, x1, y1 = 1e30, 1e30, -1e30, -1e30
        nearest = 1e30
        for k in range(corners):
            m = (k + 1) % corners
            za, zb = corner[k, 2], corner[m, 2]
            nearest = min(nearest, za)
            if za >= NEAR_M:
                x, y = corner[k, 0] / za, corner[k, 1] / za
                x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
            if (za >= NEAR_M) != (zb >= NEAR_M):
                f = (NEAR_M - za) / (zb - za)
                x = (corner[k, 0] + f * (corner[m, 0] - corner[k, 0])) / NEAR_M
                y = (corner[k, 1] + f * (corner[m, 1] - corner[k, 1])) / NEAR_M
                x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
        if x0 > window[2] or x1 < window[0] or y0 > window[3] or y1 < window[1]:
            continue
        # Rows of inverse(G).
        ax = e[1, 1] * e[2, 2] - e[1, 2] * e[2, 1]
        ay = e[1, 2] * e[2, 0] - e[1, 0] * e[2, 2]
        az = e[1, 0] * e[2, 1] - e[1, 1] * e[2, 0]
        det = e[0, 0] * ax + e[0, 1] * ay + e[0, 2] * az
        if abs(det) < 1e-9:
            continue
        plane[i, 0, 0], plane[i, 0, 1], plane[i, 0, 2] = ax / det, ay / det, az / det
        plane[i, 1, 0] = (e[2, 1] * e[0, 2] - e[2, 2] * e[0, 1]) / det
        plane[i, 1, 1] = (e[2, 2] * e[0, 0] - e[2, 0] * e[0, 2]) / det
        plane[i, 1, 2] = (e[2, 0] * e[0, 1] - e[2, 1] * e[0, 0]) / det
        plane[i, 2, 0] = (e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1]) / det
        plane[i, 2, 1] = (e[0, 2] * e[1, 0] - e[0, 0] * e[1, 2]) / det
        plane[i, 2, 2] = (e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0]) / det
        for r in range(3):
            plane[i, 3, r] = plane[i, 2, r]
        bounds[i, 0], bounds[i, 1] = max(x0, window[0]), max(y0, window[1])
        bounds[i, 2], bounds[i, 3] = min(x1, window[2]), min(y1, window[3])
        key[i] = nearest


@njit(cache=True, nogil=True, error_model="numpy")
def _opaque(
    i: int, a: float, b: float, level: int, texture: Any, uv: Any, texels: Any, offset: Any, log2_w: Any, log2_h: Any
) -> bool:
    t = texture[i]
    w, h = max(1, 1 << log2_w[t] >> level), max(1, 1 << log2_h[t] >> level)
    tu = uv[i, 0] + a * uv[i, 2] + b * uv[i, 4]
    tv = uv[i, 1] + a * uv[i, 3] + b * uv[i, 5]
    x = int(np.floor(tu * w)) & (w - 1)
    y = int(np.floor(tv * h)) & (h - 1)
    opaque: bool = (texels[offset[t, level] + y * w + x] >> 24) >= 128
    return opaque


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise_linear(
    order: Any,
    plane: Any,
    pixel_bounds: Any,
    is_triangle: Any,
    has_alpha: Any,
    alpha_level: Any,
    texture: Any,
    texture_uv: Any,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    ideal: Any,
    depth: Any,
    index: Any,
) -> None:
    """Draw into `depth` (h, w) float32 and `index` (h, w) int32 where ideal coordinates are linear in the sample.

    `ideal` holds x0, dx, y0, dy: sample (j, i) is at (x0 + dx i, y0 + dy j). `pixel_bounds` (n, 4) int: first column,
    first row, last column, last row.
    """
    x0, dx, y0, dy = ideal[0], ideal[1], ideal[2], ideal[3]
    for k in range(order.shape[0]):
        i = order[k]
        a1, b1, w1, d1 = plane[i, 0, 0] * dx, plane[i, 1, 0] * dx, plane[i, 2, 0] * dx, plane[i, 3, 0] * dx
        level = alpha_level[i]
        for row in range(pixel_bounds[i, 1], pixel_bounds[i, 3] + 1):
            y = y0 + dy * row
            a0 = plane[i, 0, 0] * x0 + plane[i, 0, 1] * y + plane[i, 0, 2]
            b0 = plane[i, 1, 0] * x0 + plane[i, 1, 1] * y + plane[i, 1, 2]
            w0 = plane[i, 2, 0] * x0 + plane[i, 2, 1] * y + plane[i, 2, 2]
            d0 = plane[i, 3, 0] * x0 + plane[i, 3, 1] * y + plane[i, 3, 2]
            first, last = float(pixel_bounds[i, 0]), float(pixel_bounds[i, 2])
            # Each edge is a linear inequality c0 + c1 x >= 0 and cuts the span of this row.
            for edge in range(5):
                if edge == 0:
                    c0, c1 = a0, a1
                elif edge == 1:
                    c0, c1 = b0, b1
                elif edge == 2:
                    c0, c1 = d0 - _FARTHEST, d1
                elif is_triangle[i]:
                    c0, c1 = w0 - a0 - b0, w1 - a1 - b1
                elif edge == 3:
                    c0, c1 = w0 - a0, w1 - a1
                else:
                    c0, c1 = w0 - b0, w1 - b1
                if c1 > 0:
                    first = max(first, -c0 / c1)
                elif c1 < 0:
                    last = min(last, -c0 / c1)
                elif c0 < 0:
                    last = -1.0
            if not first <= last:
                continue
            if has_alpha[i]:
                for col in range(int(np.ceil(first)), int(np.floor(last)) + 1):
                    d = d0 + d1 * col
                    if d > depth[row, col]:
                        w = w0 + w1 * col
                        a, b = (a0 + a1 * col) / w, (b0 + b1 * col) / w
                        if _opaque(i, a, b, level, texture, texture_uv, texels, offset, log2_w, log2_h):
                            depth[row, col] = d
                            index[row, col] = i
            else:
                for col in range(int(np.ceil(first)), int(np.floor(last)) + 1):
                    d = d0 + d1 * col
                    if d > depth[row, col]:
                        depth[row, col] = d
                        index[row, col] = i


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise_mapped(
    order: Any,
    plane: Any,
    pixel_bounds: Any,
    is_triangle: Any,
    has_alpha: Any,
    alpha_level: Any,
    texture: Any,
    texture_uv: Any,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    ideal_map: Any,
    depth: Any,
    index: Any,
) -> None:
    """Draw like `rasterise_linear` where `ideal_map` (h, w, 2) gives every sample's own ideal coordinates."""
    for k in range(order.shape[0]):
        i = order[k]
        level = alpha_level[i]
        for row in range(pixel_bounds[i, 1], pixel_bounds[i, 3] + 1):
            for col in range(pixel_bounds[i, 0], pixel_bounds[i, 2] + 1):
                x, y = ideal_map[row, col, 0], ideal_map[row, col, 1]
                d = plane[i, 3, 0] * x + plane[i, 3, 1] * y + plane[i, 3, 2]
                if d <= depth[row, col] or d < _FARTHEST:
                    continue
                a = plane[i, 0, 0] * x + plane[i, 0, 1] * y + plane[i, 0, 2]
                b = plane[i, 1, 0] * x + plane[i, 1, 1] * y + plane[i, 1, 2]
                w = plane[i, 2, 0] * x + plane[i, 2, 1] * y + plane[i, 2, 2]
                if a < 0 or b < 0 or (a + b > w if is_triangle[i] else (a > w or b > w)):
                    continue
                if has_alpha[i] and not _opaque(
                    i, a / w, b / w, level, texture, texture_uv, texels, offset, log2_w, log2_h
                ):
                    continue
                depth[row, col] = d
                index[row, col] = i
