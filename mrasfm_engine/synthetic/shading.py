"""Colour: mip-mapped, anisotropically filtered textures under sun, sky light, shadows and haze.

Everything is computed in square-root ("gamma 2") intensities, as textures are stored, because they are multiplied only.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit, uncounted

MAX_TAPS = 4

_SKY = 10
_DONE = -2

# Depth of the sky.
_SKY_DEPTH = 1e9


@uncounted(forceinline=True)
def _bilinear(
    t: int, level: int, u: float, v: float, texels: Any, offset: Any, log2_w: Any, log2_h: Any
) -> tuple[float, float, float]:
    """Red, green and blue (0..255) of a texture's level at texture coordinates, which repeat with period 1."""
    w, h = max(1, 1 << log2_w[t] >> level), max(1, 1 << log2_h[t] >> level)
    x, y = u * w - 0.5, v * h - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    c0, r0 = int(fx) & (w - 1), int(fy) & (h - 1)
    c1, r1 = (c0 + 1) & (w - 1), (r0 + 1) & (h - 1)
    base = offset[t, level]
    t00, t01 = texels[base + r0 * w + c0], texels[base + r0 * w + c1]
    t10, t11 = texels[base + r1 * w + c0], texels[base + r1 * w + c1]
    w00, w01, w10, w11 = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    red = w00 * (t00 & 255) + w01 * (t01 & 255) + w10 * (t10 & 255) + w11 * (t11 & 255)
    green = w00 * ((t00 >> 8) & 255) + w01 * ((t01 >> 8) & 255) + w10 * ((t10 >> 8) & 255) + w11 * ((t11 >> 8) & 255)
    blue = w00 * ((t00 >> 16) & 255) + w01 * ((t01 >> 16) & 255) + w10 * ((t10 >> 16) & 255) + w11 * ((t11 >> 16) & 255)
    return red, green, blue


@uncounted(forceinline=True)
def _bilinear_grey(t: int, level: int, u: float, v: float, texels: Any, offset: Any, log2_w: Any, log2_h: Any) -> float:
    """The first channel of `_bilinear`."""
    w, h = max(1, 1 << log2_w[t] >> level), max(1, 1 << log2_h[t] >> level)
    x, y = u * w - 0.5, v * h - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    c0, r0 = int(fx) & (w - 1), int(fy) & (h - 1)
    c1, r1 = (c0 + 1) & (w - 1), (r0 + 1) & (h - 1)
    base = offset[t, level]
    upper = (1 - ax) * (texels[base + r0 * w + c0] & 255) + ax * (texels[base + r0 * w + c1] & 255)
    lower = (1 - ax) * (texels[base + r1 * w + c0] & 255) + ax * (texels[base + r1 * w + c1] & 255)
    return float((1 - ay) * upper + ay * lower)


@uncounted(forceinline=True)
def _footprint(
    t: int, ux: float, vx: float, uy: float, vy: float, log2_w: Any, log2_h: Any, levels: Any
) -> tuple[int, float, float, int, float]:
    """Number of taps, the edge along which they lie, the mip level and the share of the next coarser one.

    The footprint has the edges (ux, vx) and (uy, vy) in texture coordinates.
    """
    w, h = float(1 << log2_w[t]), float(1 << log2_h[t])
    length_x = math.sqrt((ux * w) ** 2 + (vx * h) ** 2)
    length_y = math.sqrt((uy * w) ** 2 + (vy * h) ** 2)
    if length_x >= length_y:
        major, minor, du, dv = length_x, length_y, ux, vx
    else:
        major, minor, du, dv = length_y, length_x, uy, vy
    taps = max(1, min(MAX_TAPS, int(np.ceil(major / max(minor, 1.0) - 0.25))))
    exact = min(math.log2(max(major / taps, 1.0)), float(levels[t] - 1))
    level = int(exact)
    # Between 1/4 and 3/4 two levels are mixed; elsewhere one is near enough, at half the price.
    fraction = min(max(2.0 * (exact - level) - 0.5, 0.0), 1.0)
    if fraction == 1.0:
        level, fraction = level + 1, 0.0
    return taps, du, dv, level, fraction


@uncounted(forceinline=True)
def _filtered(
    t: int,
    u: float,
    v: float,
    ux: float,
    vx: float,
    uy: float,
    vy: float,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    levels: Any,
) -> tuple[float, float, float]:
    """The texture's mean colour over a pixel, by trilinear taps."""
    taps, du, dv, level, fraction = _footprint(t, ux, vx, uy, vy, log2_w, log2_h, levels)
    red, green, blue = 0.0, 0.0, 0.0
    for k in range(taps):
        f = (k + 0.5) / taps - 0.5
        r, g, b = _bilinear(t, level, u + f * du, v + f * dv, texels, offset, log2_w, log2_h)
        if fraction > 0.0:
            r2, g2, b2 = _bilinear(t, level + 1, u + f * du, v + f * dv, texels, offset, log2_w, log2_h)
            r, g, b = r + fraction * (r2 - r), g + fraction * (g2 - g), b + fraction * (b2 - b)
        red, green, blue = red + r, green + g, blue + b
    return red / taps, green / taps, blue / taps


@uncounted(forceinline=True)
def _filtered_grey(
    t: int,
    u: float,
    v: float,
    ux: float,
    vx: float,
    uy: float,
    vy: float,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    levels: Any,
) -> float:
    """The first channel of `_filtered`."""
    taps, du, dv, level, fraction = _footprint(t, ux, vx, uy, vy, log2_w, log2_h, levels)
    total = 0.0
    for k in range(taps):
        f = (k + 0.5) / taps - 0.5
        value = _bilinear_grey(t, level, u + f * du, v + f * dv, texels, offset, log2_w, log2_h)
        if fraction > 0.0:
            coarse = _bilinear_grey(t, level + 1, u + f * du, v + f * dv, texels, offset, log2_w, log2_h)
            value += fraction * (coarse - value)
        total += value
    return float(total / taps)


@uncounted(forceinline=True)
def _sun_reaches(
    x: float,
    y: float,
    z: float,
    light: Any,
    sun_from_world: Any,
    shadow_map: Any,
    shadow_frame: Any,
    boxes: Any,
    casters: int,
) -> float:
    """Share of the sun that a world point sees: 0 in full shadow, 1 in none.

    `shadow_frame` is the map's x0, y0 and cell size in the sun's frame. The first `casters` rows of `boxes` (k, 8)
    move: centre x, y, lower and upper z, cosine and sine of the heading, half length, half width.
    """
    # How far a shadow reaches for every metre that its caster is higher.
    level = math.sqrt(light[0, 0] * light[0, 0] + light[0, 1] * light[0, 1]) / max(light[0, 2], 0.05)
    for k in range(casters):
        above = boxes[k, 3] - z
        if above <= 0.0:
            continue
        px, py = x - boxes[k, 0], y - boxes[k, 1]
        reach = boxes[k, 6] + boxes[k, 7] + level * above
        if px * px + py * py > reach * reach:
            continue
        c, s = boxes[k, 4], boxes[k, 5]
        ox, oy = c * px + s * py, -s * px + c * py
        dx, dy, dz = c * light[0, 0] + s * light[0, 1], -s * light[0, 0] + c * light[0, 1], light[0, 2]
        t0, t1 = (boxes[k, 2] - z) / dz, (boxes[k, 3] - z) / dz
        t0 = max(t0, 0.0)
        if abs(dx) > 1e-6:
            ta, tb = (-boxes[k, 6] - ox) / dx, (boxes[k, 6] - ox) / dx
            t0, t1 = max(t0, min(ta, tb)), min(t1, max(ta, tb))
        elif abs(ox) > boxes[k, 6]:
            continue
        if abs(dy) > 1e-6:
            ta, tb = (-boxes[k, 7] - oy) / dy, (boxes[k, 7] - oy) / dy
            t0, t1 = max(t0, min(ta, tb)), min(t1, max(ta, tb))
        elif abs(oy) > boxes[k, 7]:
            continue
        if t0 < t1:
            return 0.0
    sx = sun_from_world[0, 0] * x + sun_from_world[0, 1] * y + sun_from_world[0, 2] * z + sun_from_world[0, 3]
    sy = sun_from_world[1, 0] * x + sun_from_world[1, 1] * y + sun_from_world[1, 2] * z + sun_from_world[1, 3]
    sz = sun_from_world[2, 0] * x + sun_from_world[2, 1] * y + sun_from_world[2, 2] * z + sun_from_world[2, 3]
    cx, cy = (sx - shadow_frame[0]) / shadow_frame[2] - 0.5, (sy - shadow_frame[1]) / shadow_frame[2] - 0.5
    col, row = int(np.floor(cx)), int(np.floor(cy))
    if col < 0 or row < 0 or col + 1 >= shadow_map.shape[1] or row + 1 >= shadow_map.shape[0]:
        return 1.0
    ax, ay = cx - col, cy - row
    lit = 0.0
    if shadow_map[row, col] <= sz:
        lit += (1 - ax) * (1 - ay)
    if shadow_map[row, col + 1] <= sz:
        lit += ax * (1 - ay)
    if shadow_map[row + 1, col] <= sz:
        lit += (1 - ax) * ay
    if shadow_map[row + 1, col + 1] <= sz:
        lit += ax * ay
    return lit


@uncounted(forceinline=True)
def _sky(
    x: float,
    y: float,
    world_from_cam: Any,
    light: Any,
    texture: int,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
) -> tuple[float, float, float]:
    """Colour of the sky along the ray (x, y, 1): haze below, blue above, clouds, and a glow around the sun."""
    d0 = world_from_cam[0, 0] * x + world_from_cam[0, 1] * y + world_from_cam[0, 2]
    d1 = world_from_cam[1, 0] * x + world_from_cam[1, 1] * y + world_from_cam[1, 2]
    d2 = world_from_cam[2, 0] * x + world_from_cam[2, 1] * y + world_from_cam[2, 2]
    norm = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2 = d0 / norm, d1 / norm, d2 / norm
    up = min(max(d2, 0.0) * 1.6, 1.0)
    glow = max(0.0, d0 * light[0, 0] + d1 * light[0, 1] + d2 * light[0, 2]) ** 24
    spread = 0.12 / (max(d2, 0.0) + 0.15)
    cloud = _bilinear_grey(texture, 1, 0.5 + d0 * spread, 0.5 + d1 * spread, texels, offset, log2_w, log2_h)
    cover = light[5, 2] * cloud / 255.0 * min(1.0, max(d2, 0.0) * 6.0)
    red = (1 - up) * light[3, 0] + up * light[4, 0] + cover * 0.5 + glow * light[6, 0]
    green = (1 - up) * light[3, 1] + up * light[4, 1] + cover * 0.42 + glow * light[6, 1]
    blue = (1 - up) * light[3, 2] + up * light[4, 2] + cover * 0.3 + glow * light[6, 2]
    return red, green, blue


@uncounted(forceinline=True)
def _surface(
    i: int,
    x: float,
    y: float,
    xx: float,
    yx: float,
    xy: float,
    yy: float,
    plane: Any,
    world_from_cam: Any,
    texture: Any,
    texture_uv: Any,
    detail: Any,
    detail_uv: Any,
    tint: Any,
    normal: Any,
    is_moving: Any,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    levels: Any,
    light: Any,
    sun_from_world: Any,
    shadow_map: Any,
    shadow_frame: Any,
    boxes: Any,
) -> tuple[float, float, float, float]:
    """Colour and depth of primitive i along the ray (x, y, 1), which changes by (xx, yx) a column, (xy, yy) a row."""
    a = plane[i, 0, 0] * x + plane[i, 0, 1] * y + plane[i, 0, 2]
    b = plane[i, 1, 0] * x + plane[i, 1, 1] * y + plane[i, 1, 2]
    z = 1.0 / max(plane[i, 2, 0] * x + plane[i, 2, 1] * y + plane[i, 2, 2], 1e-5)
    a, b = a * z, b * z
    # Change of a and b from pixel to pixel, by the quotient rule.
    wx, wy = plane[i, 2, 0] * xx + plane[i, 2, 1] * yx, plane[i, 2, 0] * xy + plane[i, 2, 1] * yy
    ax = (plane[i, 0, 0] * xx + plane[i, 0, 1] * yx - a * wx) * z
    ay = (plane[i, 0, 0] * xy + plane[i, 0, 1] * yy - a * wy) * z
    bx = (plane[i, 1, 0] * xx + plane[i, 1, 1] * yx - b * wx) * z
    by = (plane[i, 1, 0] * xy + plane[i, 1, 1] * yy - b * wy) * z
    a, b = min(max(a, 0.0), 1.0), min(max(b, 0.0), 1.0)
    ua, va, ub, vb = texture_uv[i, 2], texture_uv[i, 3], texture_uv[i, 4], texture_uv[i, 5]
    red, green, blue = _filtered(
        texture[i],
        texture_uv[i, 0] + a * ua + b * ub,
        texture_uv[i, 1] + a * va + b * vb,
        ua * ax + ub * bx,
        va * ax + vb * bx,
        ua * ay + ub * by,
        va * ay + vb * by,
        texels,
        offset,
        log2_w,
        log2_h,
        levels,
    )
    scale = 1.0 / 255.0
    if detail[i] >= 0:
        ua, va, ub, vb = detail_uv[i, 2], detail_uv[i, 3], detail_uv[i, 4], detail_uv[i, 5]
        scale *= 0.0078125 * _filtered_grey(
            detail[i],
            detail_uv[i, 0] + a * ua + b * ub,
            detail_uv[i, 1] + a * va + b * vb,
            ua * ax + ub * bx,
            va * ax + vb * bx,
            ua * ay + ub * by,
            va * ay + vb * by,
            texels,
            offset,
            log2_w,
            log2_h,
            levels,
        )
    dx = world_from_cam[0, 0] * x + world_from_cam[0, 1] * y + world_from_cam[0, 2]
    dy = world_from_cam[1, 0] * x + world_from_cam[1, 1] * y + world_from_cam[1, 2]
    dz = world_from_cam[2, 0] * x + world_from_cam[2, 1] * y + world_from_cam[2, 2]
    nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
    # Two-sided surfaces show the viewer their lit or unlit face.
    if nx * dx + ny * dy + nz * dz > 0:
        nx, ny, nz = -nx, -ny, -nz
    sun = max(0.0, nx * light[0, 0] + ny * light[0, 1] + nz * light[0, 2])
    if sun > 0:
        # A moving object would otherwise stand in the shadow of its own box.
        casters = 0 if is_moving[i] else boxes.shape[0]
        reach = _sun_reaches(
            world_from_cam[0, 3] + z * dx + 0.09 * nx,
            world_from_cam[1, 3] + z * dy + 0.09 * ny,
            world_from_cam[2, 3] + z * dz + 0.09 * nz,
            light,
            sun_from_world,
            shadow_map,
            shadow_frame,
            boxes,
            casters,
        )
        sun *= 1.0 - light[5, 1] * (1.0 - reach)
    ambient = 0.75 + 0.25 * nz
    clear = light[5, 0] / (light[5, 0] + z)
    scale *= clear
    red = scale * tint[i, 0] * red * math.sqrt(sun * light[1, 0] + ambient * light[2, 0]) + (1 - clear) * light[3, 0]
    green = (
        scale * tint[i, 1] * green * math.sqrt(sun * light[1, 1] + ambient * light[2, 1]) + (1 - clear) * light[3, 1]
    )
    blue = scale * tint[i, 2] * blue * math.sqrt(sun * light[1, 2] + ambient * light[2, 2]) + (1 - clear) * light[3, 2]
    return red, green, blue, z


@njit(cache=True, nogil=True)
def shade(
    index: Any,
    ideal: Any,
    plane: Any,
    world_from_cam: Any,
    texture: Any,
    texture_uv: Any,
    detail: Any,
    detail_uv: Any,
    tint: Any,
    normal: Any,
    label: Any,
    is_moving: Any,
    texels: Any,
    offset: Any,
    log2_w: Any,
    log2_h: Any,
    levels: Any,
    light: Any,
    sun_from_world: Any,
    shadow_map: Any,
    shadow_frame: Any,
    boxes: Any,
    sky_texture: int,
    image: Any,
    labels: Any,
    depth: Any,
) -> None:
    """Fill `image` (h, w, 3) in 0..1, `labels` (h, w) and `depth` (h, w; metres along z, 1e9 for sky).

    `index` (2h, 2w) are the primitives that a pixel's four samples see, -1 for sky; `ideal` (h, w, 2) the ideal
    coordinates of pixel centres. `light` (7, 3): direction to the sun, sun, sky light, haze colour, zenith colour,
    (haze distance, shadow strength, cloudiness), sun's glow. A pixel's class and depth are those of most samples.
    """
    _shade_pixels(
        index, ideal, plane, world_from_cam, texture, texture_uv, detail, detail_uv, tint, normal, label, is_moving,
        texels, offset, log2_w, log2_h, levels, light, sun_from_world, shadow_map, shadow_frame, boxes, sky_texture,
        image, labels, depth, np.zeros(4, np.int64),
    )  # fmt: skip


@uncounted()
def _shade_pixels(
    index: Any, ideal: Any, plane: Any, world_from_cam: Any, texture: Any, texture_uv: Any, detail: Any, detail_uv: Any,
    tint: Any, normal: Any, label: Any, is_moving: Any, texels: Any, offset: Any, log2_w: Any, log2_h: Any, levels: Any,
    light: Any, sun_from_world: Any, shadow_map: Any, shadow_frame: Any, boxes: Any, sky_texture: int,
    image: Any, labels: Any, depth: Any, ids: Any,
) -> None:  # fmt: skip
    height, width = image.shape[0], image.shape[1]
    for row in range(height):
        for col in range(width):
            x, y = ideal[row, col, 0], ideal[row, col, 1]
            cn = col + 1 if col + 1 < width else col - 1
            rn = row + 1 if row + 1 < height else row - 1
            sc, sr = float(cn - col), float(rn - row)
            xx, yx = (ideal[row, cn, 0] - x) * sc, (ideal[row, cn, 1] - y) * sc
            xy, yy = (ideal[rn, col, 0] - x) * sr, (ideal[rn, col, 1] - y) * sr
            ids[0], ids[1] = index[2 * row, 2 * col], index[2 * row, 2 * col + 1]
            ids[2], ids[3] = index[2 * row + 1, 2 * col], index[2 * row + 1, 2 * col + 1]
            red, green, blue = 0.0, 0.0, 0.0
            most = 0
            # One evaluation for each different primitive among the four samples, in the middle of its samples.
            alike = ids[0] == ids[1] and ids[0] == ids[2] and ids[0] == ids[3]
            for k in range(1 if alike else 4):
                i = ids[k]
                if i == _DONE:
                    continue
                count, px, py = 4, x, y
                if not alike:
                    count, off_x, off_y = 0, 0.0, 0.0
                    for m in range(k, 4):
                        if ids[m] == i:
                            count += 1
                            off_x += 0.25 if m & 1 else -0.25
                            off_y += 0.25 if m & 2 else -0.25
                            ids[m] = _DONE
                    off_x, off_y = off_x / count, off_y / count
                    px, py = x + off_x * xx + off_y * xy, y + off_x * yx + off_y * yy
                weight = 0.25 * count
                if i < 0:
                    r, g, b = _sky(px, py, world_from_cam, light, sky_texture, texels, offset, log2_w, log2_h)
                    z = _SKY_DEPTH
                else:
                    r, g, b, z = _surface(
                        i,
                        px,
                        py,
                        xx,
                        yx,
                        xy,
                        yy,
                        plane,
                        world_from_cam,
                        texture,
                        texture_uv,
                        detail,
                        detail_uv,
                        tint,
                        normal,
                        is_moving,
                        texels,
                        offset,
                        log2_w,
                        log2_h,
                        levels,
                        light,
                        sun_from_world,
                        shadow_map,
                        shadow_frame,
                        boxes,
                    )
                red, green, blue = red + weight * r, green + weight * g, blue + weight * b
                if count > most:
                    most = count
                    labels[row, col] = label[i] if i >= 0 else _SKY
                    depth[row, col] = z
            image[row, col, 0], image[row, col, 1], image[row, col, 2] = red, green, blue
