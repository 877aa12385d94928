"""Candidates for the colour of every cell of a block of road: the best views of it, from places apart.

What stands or drives in the way of one view also stands in the way of the views from beside it, so that a cell keeps
one view of every camera from every `PLACE_M` of the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Bytes, Floats, Ints
from mrasfm_engine.visualization.pixel_lattice import (
    LINEAR,
    SKIPPED,
    along_row,
    meets_car,
    node_step,
    place_nodes,
    square_kind,
)
from mrasfm_engine.visualization.standing_points import STEP_M
from mrasfm_engine.visualization.views import (
    MIN_RESOLUTION_PX,
    REFINED,
    VIEW_M,
    PlacedView,
    View,
    find_pixel,
    height_at,
    hidden_by_car,
    sample,
    shows,
)

CANDIDATES = 10  # of a cell: most of 15 m of path in steps of `PLACE_M`, for a camera that looks along it
PLACE_M = 2.0  # half a small car's length: what stands beside the path is before no more than a few such views
RIM_SHARE = 0.08  # of an image's shorter side: towards its rim a view counts less, so that it has no hard end
SATURATED, DARK = 250.0, 6.0  # grey levels beyond which a pixel has lost what it saw
LOST_SHARE = 0.3  # of the quality of a view that is saturated or dark
QUALITY_UNIT = 16.0  # a stored quality is pixels a metre times that: 0 to 4095 in 16 bits
HIDDEN = 0  # colour of a view from which something hides the cell: `sample` gives none below 1
COMPARED_CELLS = 6  # every so many rows and columns, a view is compared with what is there

Quality = NDArray[np.uint16]


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Views of the cells of a rectangle of ground.

    Attributes
    ----------
    row, column
        Of the first cell, on the lattice that the whole plan shares: its centre is at x = (column + 0.5) cells,
        y = -(row + 0.5) cells.
    count
        (h, w) how many views a cell has.
    color
        (h, w, k, 3), of equal exposure; `HIDDEN` for a view from which something hides the cell.
    quality
        (h, w, k) resolution on the ground, less towards an image's rim; see `QUALITY_UNIT`.
    place
        (h, w, k) from which camera and which part of the path, see `View.place`.
    """

    row: int
    column: int
    count: Bytes
    color: Bytes
    quality: Quality
    place: Quality

    @staticmethod
    def empty(*, row: int, column: int, side: int) -> Candidates:
        """A square of cells without views."""
        shape = (side, side, CANDIDATES)
        return Candidates(
            row=row,
            column=column,
            count=np.zeros((side, side), np.uint8),
            color=np.zeros((*shape, 3), np.uint8),
            quality=np.zeros(shape, np.uint16),
            place=np.zeros(shape, np.uint16),
        )

    def within(self, placed: PlacedView, cell_m: float, margin: int = 0) -> Ints | None:
        """Cells that a view may see: [first row, row after the last, first column, column after the last].

        None where there are none. Those within `margin` of the border do not count.
        """
        (left_m, bottom_m), (right_m, top_m) = placed.low_m.tolist(), placed.high_m.tolist()
        height, width = self.count.shape
        rows, columns = (margin, height - margin), (margin, width - margin)
        first_row, last_row = (_clipped(-y / cell_m - self.row, *rows) for y in (top_m, bottom_m))
        first_column, last_column = (_clipped(x / cell_m - self.column, *columns) for x in (left_m, right_m))
        if first_row >= last_row or first_column >= last_column:
            return None
        return np.array([first_row, last_row, first_column, last_column])


def _clipped(value: float, low: int, high: int) -> int:
    """The whole number below, within bounds; plain numbers, as numpy's take most of the time for so few."""
    return int(min(max(value, low), high))


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A view as the kernels take it."""

    view: View
    placed: PlacedView
    rgb: Bytes
    usable: Bools | None
    hidden: Bools  # see `StandingPoints.hidden_from`
    own_car_m: Floats | None

    @cached_property
    def arguments(self) -> tuple[Any, ...]:
        """Arguments that both kernels share, for every block."""
        return (
            self.rgb,
            np.ones((1, 1), np.bool_) if self.usable is None else self.usable,
            self.usable is not None,
            self.hidden,
            self.placed.cam_from_plan[REFINED],
            self.placed.centre_m,
            self.placed.rig_from_plan,
            np.zeros((2, 2)) if self.own_car_m is None else self.own_car_m,
            self.view.kind,
            self.view.params[REFINED],
            self.placed.heights_m,
            self.placed.first_m,
        )


def add_view(candidates: Candidates, shot: Shot, gain: Floats, cell_m: float) -> int:
    """Add a view to the cells where it is among the best, with factors (3,) on its colours; to how many cells."""
    bounds = candidates.within(shot.placed, cell_m)
    if bounds is None:
        return 0
    return int(
        _add(
            *shot.arguments,
            gain,
            shot.view.place,
            cell_m,
            candidates.row,
            candidates.column,
            bounds,
            node_step(cell_m),
            candidates.count,
            candidates.color,
            candidates.quality,
            candidates.place,
        )
    )


def log_ratios(candidates: Candidates, shot: Shot, gain: Floats, cell_m: float, margin: int) -> Floats:
    """Logarithms (n,) of how much brighter than a view, with its gain (3,), the cells are that have a view already.

    Of every few cells, those within `margin` of the border left out: they belong to another block as well.
    """
    bounds = candidates.within(shot.placed, cell_m, margin)
    if bounds is None:
        return np.zeros(0)
    rows, columns = (math.ceil((bounds[k] - bounds[j]) / COMPARED_CELLS) + 1 for j, k in ((0, 1), (2, 3)))
    found = np.empty(rows * columns)
    count = _ratios(
        *shot.arguments,
        gain,
        cell_m,
        candidates.row,
        candidates.column,
        bounds,
        candidates.count,
        candidates.color,
        candidates.quality,
        found,
    )
    return found[:count]


@njit(cache=True, nogil=True)
def _add(
    rgb: Any, usable: Any, has_mask: bool, hidden: Any, cam_from_plan: Any, centre: Any, rig_from_plan: Any,
    own_car: Any, kind: int, params: Any, heights: Any, first: Any, gain: Any, place: int, cell: float,
    first_row: int, first_column: int, bounds: Any, step: int, count: Any, color: Any, quality: Any, places: Any,
) -> int:  # fmt: skip
    """Offer the view to every cell; to how many it is added."""
    x_first, y_first = (first_column + 0.5) * cell, -(first_row + 0.5) * cell
    rows, columns, nodes = place_nodes(
        x_first, y_first, cell, bounds, step, cam_from_plan, centre, kind, params, heights, first
    )
    return _add_to_squares(  # type: ignore[no-any-return]
        rgb, usable, has_mask, hidden, cam_from_plan, centre, rig_from_plan, own_car, kind, params, heights, first,
        gain, place, cell, x_first, y_first, rows, columns, nodes, count, color, quality, places,
        np.empty(6), np.empty(8), np.empty(3, np.uint8),
    )  # fmt: skip


@uncounted()
def _add_to_squares(
    rgb: Any, usable: Any, has_mask: bool, hidden: Any, cam_from_plan: Any, centre: Any, rig_from_plan: Any,
    own_car: Any, kind: int, params: Any, heights: Any, first: Any, gain: Any, place: int, cell: float,
    x_first: float, y_first: float, rows: Any, columns: Any, nodes: Any, count: Any, color: Any, quality: Any,
    places: Any, work: Any, pixel: Any, seen: Any,
) -> int:  # fmt: skip
    height, width = rgb.shape[0], rgb.shape[1]
    most, middle = quality.shape[2], hidden.shape[0] // 2
    focal = math.sqrt(params[0] * params[1])
    rim = RIM_SHARE * min(width, height)
    added = 0
    for i, j in np.ndindex(len(rows) - 1, len(columns) - 1):
        square = square_kind(nodes, i, j, width, height, focal, centre[2])
        if square == SKIPPED:
            continue
        at_car = meets_car(rig_from_plan, own_car, x_first, y_first, cell, rows, columns, nodes, i, j, centre)
        for row in range(rows[i], rows[i + 1]):
            y = y_first - row * cell
            row_u, row_v, row_z, step_u, step_v, step_z = along_row(nodes, rows, columns, i, j, row)
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
                n: Any = np.int64(count[row, column])  # of unsigned numbers numba makes floats
                at, worst = -1, 0
                for k in range(n):
                    if places[row, column, k] == place:
                        at = k
                    if quality[row, column, k] < quality[row, column, worst]:
                        worst = k
                if at < 0:
                    at = n if n < most else worst
                beaten = 0.0 if at == n else quality[row, column, at] / QUALITY_UNIT
                if s <= beaten:
                    continue
                if square == LINEAR:
                    u, v = row_u + along * step_u, row_v + along * step_v
                    if not shows(rgb, usable, has_mask, u, v):
                        continue
                    if at_car and hidden_by_car(rig_from_plan, own_car, x, y, z, dx, dy, above):
                        continue
                elif find_pixel(
                    rgb, usable, has_mask, cam_from_plan, rig_from_plan, own_car, kind, params, x, y, z, dx, dy,
                    above, work, pixel,
                ):  # fmt: skip
                    u, v = pixel[0], pixel[1]
                else:
                    continue
                inwards = min(min(u, width - u), min(v, height - v)) / rim
                if inwards < 1.0:
                    s *= inwards * inwards * (3.0 - 2.0 * inwards)
                if s <= beaten:
                    continue
                if hidden[round(middle + dy / STEP_M), round(middle + dx / STEP_M)]:
                    seen[:] = HIDDEN
                else:
                    sample(rgb, u, v, gain, seen)
                    raw = rgb[int(v), int(u)]
                    brightest = max(max(raw[0], raw[1]), raw[2])
                    if brightest > SATURATED or brightest < DARK:
                        s *= LOST_SHARE
                        if s <= beaten:
                            continue
                if at == n:
                    count[row, column] = n + 1
                for k in range(3):
                    color[row, column, at, k] = seen[k]
                quality[row, column, at] = int(min(max(s * QUALITY_UNIT, 1.0), 65535.0))
                places[row, column, at] = place
                added += 1
    return added


@njit(cache=True, nogil=True)
def _ratios(
    rgb: Any, usable: Any, has_mask: bool, hidden: Any, cam_from_plan: Any, centre: Any, rig_from_plan: Any,
    own_car: Any, kind: int, params: Any, heights: Any, first: Any, gain: Any, cell: float,
    first_row: int, first_column: int, bounds: Any, count: Any, color: Any, quality: Any, found: Any,
) -> int:  # fmt: skip
    """Compare the view with the best one of every few cells; of how many."""
    return _compare(  # type: ignore[no-any-return]
        rgb, usable, has_mask, hidden, cam_from_plan, centre, rig_from_plan, own_car, kind, params, heights, first,
        gain, cell, first_row, first_column, bounds, count, color, quality, found,
        np.empty(6), np.empty(8), np.empty(3, np.uint8),
    )  # fmt: skip


@uncounted()
def _compare(
    rgb: Any, usable: Any, has_mask: bool, hidden: Any, cam_from_plan: Any, centre: Any, rig_from_plan: Any,
    own_car: Any, kind: int, params: Any, heights: Any, first: Any, gain: Any, cell: float,
    first_row: int, first_column: int, bounds: Any, count: Any, color: Any, quality: Any, found: Any,
    work: Any, pixel: Any, seen: Any,
) -> int:  # fmt: skip
    filled, middle = 0, hidden.shape[0] // 2
    for row in range(bounds[0] + (-(first_row + bounds[0])) % COMPARED_CELLS, bounds[1], COMPARED_CELLS):
        y = -(first_row + row + 0.5) * cell
        for column in range(bounds[2] + (-(first_column + bounds[2])) % COMPARED_CELLS, bounds[3], COMPARED_CELLS):
            n: Any = np.int64(count[row, column])  # of unsigned numbers numba makes floats
            if n == 0:
                continue
            x = (first_column + column + 0.5) * cell
            z = height_at(heights, x - first[0], y - first[1])
            dx, dy, above = x - centre[0], y - centre[1], centre[2] - z
            if dx * dx + dy * dy + above * above > VIEW_M * VIEW_M:
                continue
            if hidden[round(middle + dy / STEP_M), round(middle + dx / STEP_M)]:
                continue
            if not find_pixel(
                rgb, usable, has_mask, cam_from_plan, rig_from_plan, own_car, kind, params, x, y, z, dx, dy,
                above, work, pixel,
            ):  # fmt: skip
                continue
            sample(rgb, pixel[0], pixel[1], gain, seen)
            best = 0
            for k in range(1, n):
                if quality[row, column, k] > quality[row, column, best]:
                    best = k
            there, here = 0.0, 0.0
            clear = True
            for k in range(3):
                a, b = color[row, column, best, k], seen[k]
                clear = clear and 8 < a < 247 and 8 < b < 247
                there += a
                here += b
            if clear:
                found[filled] = math.log(there / here)
                filled += 1
    return filled
