"""Pixels of the cells of a piece of ground, interpolated between the corners of small squares.

A projection takes as long as all else that is done with a cell, and over a few decimetres of ground it is nearly
linear. In a square of `NODE_CELLS` cells of 2.5 cm the deviation is largest straight below a camera, where it is a
fraction of s^2 / (8 h) for a side s and a height h: 4 mm on the ground at 1.6 m, a sixth of a cell.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.visualization.views import MIN_RESOLUTION_PX, OWN_CAR_LEVEL, VIEW_M, height_at

NODE_CELLS = 8  # of a square's side
MAX_NODE_M = 0.2  # the same, where cells are larger
ROUNDING_M = 1e-9  # the two sides of a comparison are summed in different orders
SKIPPED, EXACT, LINEAR = 0, 1, 2  # a square: nothing is seen, cell by cell, interpolated


def node_step(cell_m: float) -> int:
    """Cells of a square's side."""
    return max(1, min(NODE_CELLS, int(MAX_NODE_M / cell_m + 1e-9)))


@njit(cache=True, nogil=True)
def place_nodes(
    x_first: float, y_first: float, cell: float, bounds: Any, step: int, cam_from_plan: Any, centre: Any, kind: int,
    params: Any, heights: Any, first: Any,
) -> Any:  # fmt: skip
    """Pixel u, v, height z and distance d of the corners of the squares that cover rows and columns within `bounds`.

    Parameters
    ----------
    x_first, y_first
        Centre of the cell in row 0 and column 0; y falls with the rows.

    Returns
    -------
    tuple
        Rows (r,) and columns (c,) of the corners, the last ones after the last cells; nodes (r, c, 4), u of NaN where
        the camera does not show the place.
    """
    rows = _nodes(bounds[0], bounds[1], step)
    columns = _nodes(bounds[2], bounds[3], step)
    nodes = np.empty((len(rows), len(columns), 4))
    _place_each(
        x_first, y_first, cell, cam_from_plan, centre, kind, params, heights, first, rows, columns,
        np.empty(6), np.empty(8), nodes,
    )  # fmt: skip
    return rows, columns, nodes


@uncounted()
def _place_each(
    x_first: float, y_first: float, cell: float, m: Any, centre: Any, kind: int, params: Any, heights: Any, first: Any,
    rows: Any, columns: Any, work: Any, pixel: Any, nodes: Any,
) -> None:  # fmt: skip
    for i in range(len(rows)):
        y = y_first - rows[i] * cell
        for j in range(len(columns)):
            x = x_first + columns[j] * cell
            z = height_at(heights, x - first[0], y - first[1])
            dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
            a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            nodes[i, j, 0] = nodes[i, j, 1] = np.nan
            if project(kind, params, a, b, c, work, pixel):
                nodes[i, j, 0], nodes[i, j, 1] = pixel[0], pixel[1]
            nodes[i, j, 2], nodes[i, j, 3] = z, math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True, forceinline=True, error_model="numpy")
def _nodes(begin: int, end: int, step: int) -> Any:
    count = (end - begin + step - 1) // step
    result = begin + step * np.arange(count + 1)
    result[count] = end
    return result


@uncounted(forceinline=True)
def square_kind(nodes: Any, i: int, j: int, width: int, height: int, focal: float, centre_z: float) -> int:
    """Treatment of a square: see `SKIPPED`."""
    shown, nearest, farthest = 0, 1e300, 0.0
    lowest = 1e300
    u_low, u_high, v_low, v_high = 1e300, -1e300, 1e300, -1e300
    for a in range(2):
        for b in range(2):
            node = nodes[i + a, j + b]
            nearest, farthest = min(nearest, node[3]), max(farthest, node[3])
            lowest = min(lowest, node[2])
            if node[0] == node[0]:
                shown += 1
                u_low, u_high = min(u_low, node[0]), max(u_high, node[0])
                v_low, v_high = min(v_low, node[1]), max(v_high, node[1])
    diagonal = math.sqrt(2.0) * MAX_NODE_M  # no place of the square is nearer than the nearest corner by more
    near = max(nearest - diagonal, 1e-3)
    if near > VIEW_M or focal * (centre_z - lowest) < MIN_RESOLUTION_PX * near * near:
        return SKIPPED
    if shown == 0:
        return SKIPPED if nearest > 2.0 * diagonal else EXACT
    if shown < 4:
        return EXACT
    if u_high < 0.0 or v_high < 0.0 or u_low >= width or v_low >= height:
        return SKIPPED
    return LINEAR


@uncounted(forceinline=True)
def all_shown(nodes: Any, i: int, j: int) -> bool:
    """Return whether the camera shows all corners of a square."""
    total = nodes[i, j, 0] + nodes[i, j + 1, 0] + nodes[i + 1, j, 0] + nodes[i + 1, j + 1, 0]
    return bool(total == total)


@uncounted(forceinline=True)
def along_row(
    nodes: Any, rows: Any, columns: Any, i: int, j: int, row: int
) -> tuple[float, float, float, float, float, float]:
    """Pixel u, v and height z of a row's first cell in a square, and what they grow by from one cell to the next.

    They are bilinear between the corners of the square.
    """
    b = (row - rows[i]) / (rows[i + 1] - rows[i])
    a, width = 1.0 - b, columns[j + 1] - columns[j]
    p, q, r, s = nodes[i, j], nodes[i, j + 1], nodes[i + 1, j], nodes[i + 1, j + 1]
    u, v, z = a * p[0] + b * r[0], a * p[1] + b * r[1], a * p[2] + b * r[2]
    return (
        u,
        v,
        z,
        (a * q[0] + b * s[0] - u) / width,
        (a * q[1] + b * s[1] - v) / width,
        (a * q[2] + b * s[2] - z) / width,
    )


@uncounted()
def meets_car(
    rig_from_plan: Any, own_car: Any, x_first: float, y_first: float, cell: float, rows: Any, columns: Any,
    nodes: Any, i: int, j: int, centre: Any,
) -> bool:  # fmt: skip
    """Return whether `hidden_by_car` may hold for a cell of a square."""
    if not own_car[0, 0] < own_car[1, 0]:
        return False
    z_low, z_high = 1e300, -1e300
    for a in range(2):
        for b in range(2):
            z_low, z_high = min(z_low, nodes[i + a, j + b, 2]), max(z_high, nodes[i + a, j + b, 2])
    for lift in (0.0, OWN_CAR_LEVEL):
        apart = False
        for k in range(2):
            m = rig_from_plan[k]
            low, high = 1e300, -1e300
            for corner in range(8):
                x = x_first + columns[j + (corner & 1)] * cell
                y = y_first - rows[i + (corner >> 1 & 1)] * cell
                z = z_low if corner & 4 else z_high
                at = m[3]
                at += m[0] * (x + lift * (centre[0] - x)) + m[1] * (y + lift * (centre[1] - y))
                at += m[2] * (z + lift * (centre[2] - z))
                low, high = min(low, at), max(high, at)
            apart = apart or high < own_car[0, k] - ROUNDING_M or low > own_car[1, k] + ROUNDING_M
        if not apart:
            return True
    return False
