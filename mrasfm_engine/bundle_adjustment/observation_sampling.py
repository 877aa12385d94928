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
MOST_UNITS = 256  # that see one point: an adjustment takes all of their pairs


def solve_with_chosen_points(
    problem: Problem, image_size_px: Floats, *, an_image: int, cancel: Cancel | None = None
) -> tuple[State, Report]:
    """As `solve`, with poses and calibration from the chosen points (see `choose_points`), which all others follow.

    With `an_image` zero it is `solve` with all of them.
    """
    problem = replace(problem, observations=thinned(problem.observations))
    if not an_image:
        return solve(problem, cancel=cancel)
    chosen = choose_points(problem.observations, problem.layout.unit_slot >= 0, image_size_px, an_image=an_image)
    solution, report = solve(problem.of_points(chosen), cancel=cancel)
    points_m = problem.state.points_m.copy()
    points_m[chosen] = solution.points_m
    return problem.with_points_refined(replace(solution, points_m=points_m)), report


def thinned(observations: Observations) -> Observations:
    """The observations with at most `MOST_UNITS` units of each point, evenly spread over all that see it.

    What is left out is not known to the adjustment: poses get less certain, never more. Taken for a point that is known
    already, it would tie them to it.
    """
    o = observations
    keep = np.ones(len(o.unit), dtype=np.bool_)
    for p in np.flatnonzero(np.diff(o.first_of_point) > MOST_UNITS).tolist():
        rows = slice(o.first_of_point[p], o.first_of_point[p + 1])
        units = np.unique(o.unit[rows])
        if len(units) > MOST_UNITS:
            spread = np.linspace(0, len(units) - 1, MOST_UNITS).round().astype(np.int64)
            keep[rows] = np.isin(o.unit[rows], units[spread])
    if keep.all():
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
    o, (columns, rows) = observations, GRID
    cell_px = image_size_px[o.camera] / GRID
    place = np.clip((o.xy_px / cell_px).astype(np.int64), 0, np.array(GRID) - 1)
    slot = np.where(free_units, np.cumsum(free_units) - 1, -1)[o.unit]
    bucket = ((slot * len(image_size_px) + o.camera) * rows + place[:, 1]) * columns + place[:, 0]
    cells = int(free_units.sum()) * len(image_size_px) * rows * columns
    wanted = np.full(cells, -(-an_image // (rows * columns)), dtype=np.int64)
    length = np.diff(o.first_of_point)
    result: Bools = _choose(np.argsort(-length, kind="stable"), o.first_of_point, bucket, wanted)
    return result


@njit(cache=True, nogil=True)
def _choose(order: Any, first: Any, bucket: Any, wanted: Any) -> Any:
    chosen = np.zeros(len(order), np.bool_)
    for p in order:
        for n in range(first[p], first[p + 1]):
            if bucket[n] >= 0 and wanted[bucket[n]] > 0:  # below: images of units that are held
                chosen[p] = True
        if chosen[p]:
            for n in range(first[p], first[p + 1]):
                if bucket[n] >= 0:
                    wanted[bucket[n]] -= 1
    return chosen
