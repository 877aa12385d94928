"""The ground seen from above: every cell coloured by the two cameras that see it best, under two calibrations.

Nothing is blended: blending would hide exactly what the picture is to show. A cell keeps, apart from one another, what
its best two cameras see, under the given and under the refined calibration; which images these are is decided once, so
that the pictures differ by nothing but the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrasfm_engine.geometry.camera_model import project
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32, Ints
from mrasfm_engine.visualization.ground import GroundTiles
from mrasfm_engine.visualization.pixel_lattice import (
    LINEAR,
    SKIPPED,
    all_shown,
    along_row,
    meets_car,
    node_step,
    place_nodes,
    square_kind,
)
from mrasfm_engine.visualization.views import (
    MIN_RESOLUTION_PX,
    VIEW_M,
    View,
    find_pixel,
    height_at,
    hidden_by_car,
    place_view,
    sample,
    shows,
)

RADIUS_M = 12.0  # beside the trajectory
MIN_CELL_M = 0.025
MAX_CELLS = 12_000_000  # bounds the picture, and what a mosaic holds to 22 bytes times that
MAX_SIDE_CELLS = 16_000  # with its frame it stays below 16384 pixels: browsers and graphics cards show no more


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Cells of the ground in the plan frame: x along the picture's rows, y up its columns, z up."""

    left_m: float
    top_m: float
    cell_m: float
    rows: int
    columns: int

    @staticmethod
    def around(position_m: Floats, *, max_cells: int = MAX_CELLS) -> Grid:
        """The grid that covers the ground up to `RADIUS_M` around positions (n, 2).

        Its cells are as small as `max_cells` in all and `MAX_SIDE_CELLS` a side permit.
        """
        low, high = position_m.min(0) - RADIUS_M, position_m.max(0) + RADIUS_M
        size = high - low
        cell = max(MIN_CELL_M, float(np.sqrt(np.prod(size) / max_cells)), float(size.max()) / MAX_SIDE_CELLS)
        columns, rows = np.maximum(np.floor(size / cell).astype(int), 1)
        return Grid(left_m=float(low[0]), top_m=float(high[1]), cell_m=cell, rows=int(rows), columns=int(columns))

    @staticmethod
    def square(centre_m: Floats, *, side_m: float) -> Grid:
        """The finest grid around a place (2,)."""
        cells = round(side_m / MIN_CELL_M)
        left, top = float(centre_m[0]) - side_m / 2, float(centre_m[1]) + side_m / 2
        return Grid(left_m=left, top_m=top, cell_m=MIN_CELL_M, rows=cells, columns=cells)

    def within(self, low_m: Floats, high_m: Floats) -> Ints:
        """Cells in a rectangle between two corners (2,): [first row, row after the last, first column, column after
        the last]."""
        first = (self.top_m - high_m[1]) / self.cell_m, (low_m[0] - self.left_m) / self.cell_m
        last = (self.top_m - low_m[1]) / self.cell_m, (high_m[0] - self.left_m) / self.cell_m
        sides = zip(first, last, (self.rows, self.columns), strict=True)
        return np.concatenate([np.clip([lo, hi], 0, n) for lo, hi, n in sides]).astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class Mosaic:
    """Views of every cell by the two best cameras.

    Attributes
    ----------
    owner
        (2, rows, columns) number of the best and of the second best camera plus one, 0 where there is none.
    score
        (2, rows, columns) resolution of their images on the ground, pixels a metre.
    color
        (2, 2, rows, columns, 3) by calibration (given, refined) and by layer (best, second best).
    """

    grid: Grid
    owner: Bytes
    score: Floats32
    color: Bytes
    images_used: int

    def seen(self) -> tuple[slice, slice]:
        """Rows and columns of the smallest rectangle that holds all cells that are seen; there must be one."""
        rows, columns = (np.flatnonzero((self.owner[0] > 0).any(axis=k)) for k in (1, 0))
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


class MosaicPainter:
    """Paints the ground of every grid; see `views.Painter`.

    Parameters
    ----------
    own_car_m
        Rectangle (2, 2) of the rig's x and y, lowest first, that the car itself covers; None where masks know the car.
    """

    def __init__(self, grids: Sequence[Grid], ground: GroundTiles, *, own_car_m: Floats | None) -> None:
        self._mosaics = [_empty(grid) for grid in grids]
        self._ground, self._own_car_m = ground, own_car_m
        self._used = np.zeros(len(grids), dtype=np.int64)

    def paint(self, index: int, view: View, rgb: Bytes, usable: Bools | None) -> None:
        """Paint one view; see `views.Painter`."""
        coarsest_m = max((mosaic.grid.cell_m for mosaic in self._mosaics), default=0.0)
        placed = place_view(view, self._ground, margin_m=coarsest_m)
        if placed is None:
            return
        for k, mosaic in enumerate(self._mosaics):
            grid, bounds = mosaic.grid, mosaic.grid.within(placed.low_m, placed.high_m)
            if bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
                continue
            painted = _paint(
                rgb,
                np.ones((1, 1), np.bool_) if usable is None else usable,
                usable is not None,
                placed.cam_from_plan,
                placed.centre_m,
                placed.rig_from_plan,
                np.zeros((2, 2)) if self._own_car_m is None else self._own_car_m,
                view.kind,
                view.params,
                view.gain,
                view.camera + 1,
                placed.heights_m,
                np.array([grid.left_m, grid.top_m, grid.cell_m, *placed.first_m]),
                bounds,
                node_step(grid.cell_m),
                mosaic.owner,
                mosaic.score,
                mosaic.color,
            )
            self._used[k] += painted > 0

    def mosaics(self) -> list[Mosaic]:
        """The mosaics of all grids, of what has been painted."""
        return [replace(mosaic, images_used=int(n)) for mosaic, n in zip(self._mosaics, self._used, strict=True)]


def _empty(grid: Grid) -> Mosaic:
    shape = (2, grid.rows, grid.columns)
    return Mosaic(
        grid=grid,
        owner=np.zeros(shape, np.uint8),
        score=np.zeros(shape, np.float32),
        color=np.zeros((2, *shape, 3), np.uint8),
        images_used=0,
    )


@uncounted(forceinline=True)
def _layer_for(owner: Any, score: Any, row: int, column: int, camera: int, s: float) -> int:
    """Layer that a camera's view of this score belongs to, -1 if to none; the best is moved down where it must."""
    if owner[0, row, column] == camera:
        return 0 if s > score[0, row, column] else -1
    if s > score[0, row, column]:
        return 2  # becomes the best, and what was best becomes second
    return 1 if s > score[1, row, column] else -1


@njit(cache=True, nogil=True)
def _paint(
    rgb: Any, usable: Any, has_mask: bool, cam_from_plan: Any, centre: Any, rig_from_plan: Any, own_car: Any,
    kind: int, params: Any, gain: Any, camera: int, heights: Any, place: Any, bounds: Any,
    step: int, owner: Any, score: Any, color: Any,
) -> int:  # fmt: skip
    """Colour the cells that the image sees better than what is there; how many."""
    cell, first = place[2], place[3:5]
    x_first, y_first = place[0] + 0.5 * cell, place[1] - 0.5 * cell
    rows, columns, nodes = place_nodes(
        x_first, y_first, cell, bounds, step, cam_from_plan[1], centre, kind, params[1], heights, first
    )
    given = place_nodes(
        x_first, y_first, cell, bounds, step, cam_from_plan[0], centre, kind, params[0], heights, first
    )[2]
    return _paint_squares(  # type: ignore[no-any-return]
        rgb, usable, has_mask, cam_from_plan, centre, rig_from_plan, own_car, kind, params, gain, camera, heights,
        x_first, y_first, cell, first, rows, columns, nodes, given, owner, score, color,
        np.empty(6), np.empty(8), np.empty(3),
    )  # fmt: skip


@uncounted()
def _paint_squares(
    rgb: Any, usable: Any, has_mask: bool, cam_from_plan: Any, centre: Any, rig_from_plan: Any, own_car: Any,
    kind: int, params: Any, gain: Any, camera: int, heights: Any, x_first: float, y_first: float, cell: float,
    first: Any, rows: Any, columns: Any, nodes: Any, given: Any, owner: Any, score: Any, color: Any,
    work: Any, pixel: Any, cam: Any,
) -> int:  # fmt: skip
    focal = math.sqrt(params[1, 0] * params[1, 1])
    painted = 0
    for i, j in np.ndindex(len(rows) - 1, len(columns) - 1):
        square = square_kind(nodes, i, j, rgb.shape[1], rgb.shape[0], focal, centre[2])
        if square == SKIPPED:
            continue
        at_car = meets_car(rig_from_plan, own_car, x_first, y_first, cell, rows, columns, nodes, i, j, centre)
        is_given_linear = all_shown(given, i, j)
        for row in range(rows[i], rows[i + 1]):
            y = y_first - row * cell
            row_u, row_v, row_z, step_u, step_v, step_z = along_row(nodes, rows, columns, i, j, row)
            given_u = given_v = given_step_u = given_step_v = 0.0
            if is_given_linear:
                given_u, given_v, _, given_step_u, given_step_v, _ = along_row(given, rows, columns, i, j, row)
            for column in range(columns[j], columns[j + 1]):
                x, along = x_first + column * cell, column - columns[j]
                z = row_z + along * step_z if square == LINEAR else height_at(heights, x - first[0], y - first[1])
                dx, dy, above = x - centre[0], y - centre[1], centre[2] - z
                d2 = dx * dx + dy * dy + above * above
                if d2 > VIEW_M * VIEW_M:
                    continue
                s = focal * above / d2  # foreshortening h / d times focal length over distance
                if s < MIN_RESOLUTION_PX:
                    continue
                layer = _layer_for(owner, score, row, column, camera, s)
                if layer < 0:
                    continue
                if square == LINEAR:
                    u, v = row_u + along * step_u, row_v + along * step_v
                    if not shows(rgb, usable, has_mask, u, v):
                        continue
                    if at_car and hidden_by_car(rig_from_plan, own_car, x, y, z, dx, dy, above):
                        continue
                elif find_pixel(
                    rgb, usable, has_mask, cam_from_plan[1], rig_from_plan, own_car, kind, params[1], x, y, z, dx,
                    dy, above, work, pixel,
                ):  # fmt: skip
                    u, v = pixel[0], pixel[1]
                else:
                    continue
                if layer == 2:
                    owner[1, row, column], score[1, row, column] = owner[0, row, column], score[0, row, column]
                    for c in range(2):
                        for k in range(3):
                            color[c, 1, row, column, k] = color[c, 0, row, column, k]
                    layer = 0
                owner[layer, row, column], score[layer, row, column] = camera, s
                sample(rgb, u, v, gain, color[1, layer, row, column])
                if is_given_linear:
                    u, v = given_u + along * given_step_u, given_v + along * given_step_v
                    sample(rgb, u, v, gain, color[0, layer, row, column])
                else:
                    m = cam_from_plan[0]
                    for k in range(3):
                        cam[k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
                    if project(kind, params[0], cam[0], cam[1], cam[2], work, pixel):
                        sample(rgb, pixel[0], pixel[1], gain, color[0, layer, row, column])
                painted += 1
    return painted
