"""Sampling of the points from which poses are estimated, where there are far more than needed.

Long tracks tie a unit to others; observations all over an image hold its rotation and position apart. So tracks
are tried in the order of their number of observations. A track is chosen if one of its images has no observation yet in
the cell of its grid where it is seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.problem import Observations
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, solve
from mrasfm_engine.jit import njit
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Cancel, Floats

GRID = (8, 5)  # columns and rows of cells of an image
MOST_UNITS = 256  # free ones that see one point: an adjustment takes all of their pairs


def solve_with_chosen_points(
    problem: Problem, image_size_px: Floats, *, an_image: int, cancel: Cancel | None = None
) -> tuple[State, Report]:
    """As `solve`, with poses and calibration from the chosen points (see `choose_points`), which all others follow.

    With `an_image` zero it is `solve` with all of them.
    """
    problem = replace(problem, observations=thinned(problem.observations, problem.layout.unit_slot >= 0))
    if not an_image:
        return solve(problem, cancel=cancel)
    chosen = choose_points(problem.observations, problem.layout.unit_slot >= 0, image_size_px, an_image=an_image)
    solution, report = solve(problem.of_points(chosen), cancel=cancel)
    points_m = problem.state.points_m.copy()
    points_m[chosen] = solution.points_m
    return problem.with_points_refined(replace(solution, points_m=points_m)), report


def thinned(observations: Observations, free_units: Bools) -> Observations:
    """The observations with those of at most `MOST_UNITS` free units (u,) of each point, spread over all that see it.

    What is left out is not known to the adjustment: poses get less certain, never more. Taken for a point that is known
    already, it would tie them to it. All points choose in one order of the units: the pairs of units that any of them
    couples stay few.
    """
    o = observations
    # Of a row band whose motion follows from the trajectory, three units take part.
    most = MOST_UNITS if o.band is None else MOST_UNITS // 3
    keep = _spread(o.first_of_point, o.unit, free_units, most)
    if keep is None:
        return o
    return Observations(
        unit=o.unit[keep],
        camera=o.camera[keep],
        point=o.point[keep],
        xy_px=o.xy_px[keep],
        num_points=o.num_points,
        band=None if o.band is None else o.band[keep],
        fixed=o.fixed,
    )


@njit(cache=True, nogil=True)
def _spread(first: Any, unit: Any, free: Any, most: int) -> Any:
    """Mask (n,) of observations that stay, those of the first units in the spreading order; None where all do."""
    bits = 1
    while 1 << bits < len(free):
        bits += 1
    keep, is_whole = np.ones(len(unit), np.bool_), True
    for p in range(len(first) - 1):
        begin, end = first[p], first[p + 1]
        if end - begin <= most:
            continue
        places = np.empty(end - begin, np.int64)
        count = 0
        for n in range(begin, end):
            if free[unit[n]]:
                places[count] = _reversed(unit[n], bits)
                count += 1
        different = np.unique(places[:count])
        if len(different) <= most:
            continue
        is_whole = False
        last = different[most - 1]
        for n in range(begin, end):
            keep[n] = not free[unit[n]] or _reversed(unit[n], bits) <= last
    return None if is_whole else keep


@njit(cache=True, nogil=True)
def _reversed(number: int, bits: int) -> int:
    """Place of a number in an order whose beginning is spread over all of them, however much of it is taken.

    It is the number with its bits reversed [van der Corput's sequence].
    """
    place = 0
    for _ in range(bits):
        place = 2 * place + number % 2
        number = number // 2
    return place


def choose_points(observations: Observations, free_units: Bools, image_size_px: Floats, *, an_image: int) -> Bools:
    """Points (p,) that give every image of a free unit about so many observations, spread over it.

    Parameters
    ----------
    observations
        Of all points.
    free_units
        Which units (u,) are to be estimated: images of others want nothing.
    image_size_px
        Width and height of every camera's images (c, 2).
    an_image
        Observations an image wants. It gets fewer where it has fewer, and more where its points serve other images.
    """
    o, cells = observations, GRID[0] * GRID[1]
    slot = np.where(free_units, np.cumsum(free_units) - 1, -1)
    cell = _cells(o.unit, o.camera, o.xy_px, slot, image_size_px / GRID)
    wanted = np.full(int(free_units.sum()) * len(image_size_px) * cells, -(-an_image // cells), dtype=np.int64)
    # numpy sorts integers of 16 bits by their digits, in a tenth of the time.
    length = np.minimum(np.diff(o.first_of_point), np.iinfo(np.int16).max).astype(np.int16)
    result: Bools = _choose(np.argsort(-length, kind="stable"), o.first_of_point, cell, wanted)
    return result


@njit(cache=True, nogil=True)
def _cells(unit: Any, camera: Any, xy: Any, slot: Any, size: Any) -> Any:
    """Number (n,) of the cell of an image of a free unit in which each observation is; below zero of other units."""
    result, (columns, rows) = np.empty(len(unit), np.int64), GRID
    for n in range(len(unit)):
        c = camera[n]
        column = min(max(int(xy[n, 0] / size[c, 0]), 0), columns - 1)
        row = min(max(int(xy[n, 1] / size[c, 1]), 0), rows - 1)
        result[n] = ((slot[unit[n]] * len(size) + c) * rows + row) * columns + column
    return result


@njit(cache=True, nogil=True)
def _choose(order: Any, first: Any, cell: Any, wanted: Any) -> Any:
    chosen = np.zeros(len(order), np.bool_)
    for p in order:
        for n in range(first[p], first[p + 1]):
            if cell[n] >= 0 and wanted[cell[n]] > 0:  # below: images of units that are held
                chosen[p] = True
        if chosen[p]:
            for n in range(first[p], first[p + 1]):
                if cell[n] >= 0:
                    wanted[cell[n]] -= 1
    return chosen
