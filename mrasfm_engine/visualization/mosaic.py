"""The ground seen from above: every cell coloured by the two cameras that see it best, under two calibrations.

Nothing is blended: blending would hide exactly what the picture is to show. A cell keeps, apart from one another, what
its best two cameras see, under the given and under the refined calibration; which images these are is decided once, so
that the pictures differ by nothing but the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numba import njit

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project, unproject_pixels
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32, Ints
from mrasfm_engine.visualization.ground import HEIGHT_STEP_M, GroundHeights, GroundTiles

GIVEN, REFINED = 0, 1
RADIUS_M = 12.0  # beside the trajectory
VIEW_M = 15.0  # how far from a camera its image is used
MIN_CELL_M = 0.025
MAX_CELLS = 12_000_000  # bounds the picture, and what a mosaic holds to 22 bytes times that
MAX_SIDE_CELLS = 16_000  # with its frame it stays below 16384 pixels: browsers and graphics cards show no more
MIN_RESOLUTION_PX = 5.0  # of an image on the ground, pixels a metre along the line of sight
OWN_CAR_LEVEL = 0.5  # of the cameras' height: up to there the car's body hides the ground
FOOTPRINT_MARGIN_M = 1.0  # around where the corners of an image meet the ground: it is not level
PREFETCHED = 3  # images that wait decoded


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
class View:
    """One image that may see the ground; poses are `plan_from_cam` (2, 4, 4) as given and as refined."""

    camera: int
    plan_from_cam: Floats
    params: Floats  # (2, 8) as given and as refined
    kind: int
    size_px: tuple[int, int]  # width, height
    plan_from_rig: Floats  # (4, 4)
    gain: Floats  # (3,)


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


def make_mosaics(
    views: Sequence[View],
    grids: Sequence[Grid],
    ground: GroundHeights,
    read: Callable[[int], tuple[Bytes, Bools | None]],
    *,
    own_car_m: Floats | None,
    step: Callable[[int], None] = lambda done: None,
) -> list[Mosaic]:
    """Paint the ground of every grid with all views; every image is read once.

    Parameters
    ----------
    read
        Image (h, w, 3) and usable pixels (h, w), or None where all are, of a view by its position in `views`.
    own_car_m
        Rectangle (2, 2) of the rig's x and y, lowest first, that the car itself covers; None where masks know the car.
    step
        Called after every view with how many are done; may raise.
    """
    mosaics = [_empty(grid) for grid in grids]
    heights = GroundTiles(ground)
    used = np.zeros(len(grids), dtype=np.int64)
    for done, (index, rgb, usable) in enumerate(_read_ahead(len(views), read), 1):
        used += _paint_view(mosaics, views[index], rgb, usable, heights, own_car_m)
        step(done)
    return [replace(mosaic, images_used=int(n)) for mosaic, n in zip(mosaics, used, strict=True)]


def _empty(grid: Grid) -> Mosaic:
    shape = (2, grid.rows, grid.columns)
    return Mosaic(
        grid=grid,
        owner=np.zeros(shape, np.uint8),
        score=np.zeros(shape, np.float32),
        color=np.zeros((2, *shape, 3), np.uint8),
        images_used=0,
    )


def _read_ahead(
    count: int, read: Callable[[int], tuple[Bytes, Bools | None]]
) -> Iterator[tuple[int, Bytes, Bools | None]]:
    """Images in order, decoded while others are painted, never more than a few at a time."""
    with ThreadPoolExecutor(1) as pool:
        todo = iter(range(count))
        waiting = [(i, pool.submit(read, i)) for i in islice(todo, PREFETCHED)]
        try:
            while waiting:
                index, image = waiting.pop(0)
                rgb, usable = image.result()
                waiting += [(i, pool.submit(read, i)) for i in islice(todo, 1)]
                yield index, rgb, usable
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def widest_angle(kind: int, params: Floats, size_px: tuple[int, int]) -> float:
    """Tangent of the largest angle between the axis and a pixel of the image's border.

    Beyond it distortion polynomials fold back, and points far outside the view seem to lie inside.
    """
    width, height = size_px
    u, v = np.linspace(0, width, 17), np.linspace(0, height, 17)
    border = np.concatenate(
        [np.column_stack([u, np.full(17, e)]) for e in (0, height)]
        + [np.column_stack([np.full(17, e), v]) for e in (0, width)]
    )
    rays = unproject_pixels(kind, params, border)
    return float((np.hypot(rays[:, 0], rays[:, 1]) / np.maximum(rays[:, 2], 1e-3)).max())


def _paint_view(
    mosaics: Sequence[Mosaic],
    view: View,
    rgb: Bytes,
    usable: Bools | None,
    ground: GroundTiles,
    own_car_m: Floats | None,
) -> Ints:
    """Paint one view; for every mosaic 1 where it sees any of its ground, else 0."""
    centre = view.plan_from_cam[REFINED][:3, 3]
    coarsest_m = max((mosaic.grid.cell_m for mosaic in mosaics), default=0.0)
    heights, first = ground.around(centre[:2], VIEW_M + FOOTPRINT_MARGIN_M + coarsest_m)
    used = np.zeros(len(mosaics), dtype=np.int64)
    footprint = _footprint(view, float(heights.min()))
    if footprint is None:
        return used
    cam_from_plan = np.ascontiguousarray(se3.inverse(view.plan_from_cam)[:, :3])
    rig_from_plan = np.ascontiguousarray(se3.inverse(view.plan_from_rig)[:2])
    widest = widest_angle(view.kind, view.params[REFINED], view.size_px)
    for k, mosaic in enumerate(mosaics):
        grid, bounds = mosaic.grid, mosaic.grid.within(*footprint)
        if bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
            continue
        painted = _paint(
            rgb,
            np.ones((1, 1), np.bool_) if usable is None else usable,
            usable is not None,
            cam_from_plan,
            centre,
            rig_from_plan,
            np.zeros((2, 2)) if own_car_m is None else own_car_m,
            view.kind,
            view.params,
            widest,
            view.gain,
            view.camera + 1,
            heights,
            np.array([grid.left_m, grid.top_m, grid.cell_m, *first]),
            bounds,
            mosaic.owner,
            mosaic.score,
            mosaic.color,
        )
        used[k] = painted > 0
    return used


def _footprint(view: View, lowest_m: float) -> tuple[Floats, Floats] | None:
    """Corners (2,) of the rectangle of ground, nowhere below `lowest_m`, that the image may show; None for none."""
    width, height = view.size_px
    u, v = np.meshgrid(np.linspace(0, width, 25), np.linspace(0, height, 17))
    rays = unproject_pixels(view.kind, view.params[REFINED], np.column_stack([u.ravel(), v.ravel()]))
    pose = view.plan_from_cam[REFINED]
    rays = rays @ pose[:3, :3].T
    rays = rays[rays[:, 2] < 0]
    if not len(rays):
        return None
    above = max(float(pose[2, 3]) - lowest_m, 0.1)
    flat = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    reach = np.minimum(above * flat / -rays[:, 2], VIEW_M)
    at = pose[:2, 3] + rays[:, :2] * (reach / flat)[:, None]
    return at.min(0) - FOOTPRINT_MARGIN_M, at.max(0) + FOOTPRINT_MARGIN_M


@njit(cache=True, inline="always")
def _height_at(heights: Any, right_m: float, up_m: float) -> float:
    """Bilinear between the corners of the height grid."""
    a, b = up_m / HEIGHT_STEP_M, right_m / HEIGHT_STEP_M
    i, j = int(a), int(b)
    a, b = a - i, b - j
    here = heights[i, j] * (1 - b) + heights[i, j + 1] * b
    next_up = heights[i + 1, j] * (1 - b) + heights[i + 1, j + 1] * b
    return float(here * (1 - a) + next_up * a)


@njit(cache=True, inline="always")
def _layer_for(owner: Any, score: Any, row: int, column: int, camera: int, s: float) -> int:
    """Layer that a camera's view of this score belongs to, -1 if to none; the best is moved down where it must."""
    if owner[0, row, column] == camera:
        return 0 if s > score[0, row, column] else -1
    if s > score[0, row, column]:
        return 2  # becomes the best, and what was best becomes second
    return 1 if s > score[1, row, column] else -1


@njit(cache=True, inline="always")
def _inside_car(rig_from_plan: Any, own_car: Any, x: float, y: float, z: float) -> bool:
    for i in range(2):
        m = rig_from_plan[i]
        if not own_car[0, i] < m[0] * x + m[1] * y + m[2] * z + m[3] < own_car[1, i]:
            return False
    return True


@njit(cache=True, inline="always")
def _sample(rgb: Any, u: float, v: float, gain: Any, out: Any) -> None:
    """Bilinear colour at a pixel position whose top left pixel has its centre at (0.5, 0.5)."""
    height, width = rgb.shape[0], rgb.shape[1]
    x = min(max(u - 0.5, 0.0), width - 1.001)
    y = min(max(v - 0.5, 0.0), height - 1.001)
    i, j = int(y), int(x)
    a, b = y - i, x - j
    for k in range(3):
        top = rgb[i, j, k] * (1 - b) + rgb[i, j + 1, k] * b
        bottom = rgb[i + 1, j, k] * (1 - b) + rgb[i + 1, j + 1, k] * b
        value = gain[k] * (top * (1 - a) + bottom * a) + 0.5
        out[k] = int(min(max(value, 1.0), 255.0))


@njit(cache=True, nogil=True)
def _paint(
    rgb: Any, usable: Any, has_mask: bool, cam_from_plan: Any, centre: Any, rig_from_plan: Any, own_car: Any,
    kind: int, params: Any, widest: float, gain: Any, camera: int, heights: Any, place: Any, bounds: Any,
    owner: Any, score: Any, color: Any,
) -> int:  # fmt: skip
    """Colour the cells that the image sees better than what is there; how many."""
    left, top, cell, first_x, first_y = place[0], place[1], place[2], place[3], place[4]
    height, width = rgb.shape[0], rgb.shape[1]
    focal = math.sqrt(params[1, 0] * params[1, 1])
    work, pixel, cam = np.empty(6), np.empty(8), np.empty(3)
    painted = 0
    for row in range(bounds[0], bounds[1]):
        y = top - (row + 0.5) * cell
        for column in range(bounds[2], bounds[3]):
            x = left + (column + 0.5) * cell
            z = _height_at(heights, x - first_x, y - first_y)
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
            m = cam_from_plan[1]
            for i in range(3):
                cam[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]
            if cam[2] < 1e-3 or cam[0] * cam[0] + cam[1] * cam[1] > (widest * cam[2]) ** 2:
                continue
            project(kind, params[1], cam[0], cam[1], cam[2], work, pixel)
            u, v = pixel[0], pixel[1]
            if not (0.0 <= u < width and 0.0 <= v < height):
                continue
            if has_mask and not usable[int(v), int(u)]:
                continue
            if _inside_car(rig_from_plan, own_car, x, y, z) or _inside_car(
                rig_from_plan, own_car, x - OWN_CAR_LEVEL * dx, y - OWN_CAR_LEVEL * dy, z + OWN_CAR_LEVEL * above
            ):
                continue
            if layer == 2:
                owner[1, row, column], score[1, row, column] = owner[0, row, column], score[0, row, column]
                for c in range(2):
                    for k in range(3):
                        color[c, 1, row, column, k] = color[c, 0, row, column, k]
                layer = 0
            owner[layer, row, column], score[layer, row, column] = camera, s
            _sample(rgb, u, v, gain, color[1, layer, row, column])
            m = cam_from_plan[0]
            for i in range(3):
                cam[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]
            if cam[2] > 1e-3:
                project(kind, params[0], cam[0], cam[1], cam[2], work, pixel)
                _sample(rgb, pixel[0], pixel[1], gain, color[0, layer, row, column])
            painted += 1
    return painted
