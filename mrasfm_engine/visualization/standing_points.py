"""Ground that things hide from a view, by the scene's points that stand above it.

A camera that looks at a car sees the car where the ground behind it would be. A point above the ground tells how far
that goes: from below the point, on which the thing stands, to where the ray through the point meets the ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Floats, Ints
from mrasfm_engine.visualization.views import VIEW_M, PlacedView, height_at

STANDING_M = 0.3  # above the ground: kerbs and the error of the ground's height stay below
OVERHEAD = 0.9  # of the camera's height: what is higher hides no ground, and may be a wire or a branch
TALL = 0.6  # of the camera's height: what reaches that is taken to go on upwards, as walls and cars do
STEP_M = 0.1  # of the raster
SIDE = 2 * round(VIEW_M / STEP_M) + 1
HALF_WIDTH_M = 0.15  # of the strip that a point hides, where it stands: about the distance of points on one thing


class StandingPoints:
    """Points above the ground, by the views that see them.

    A view is hidden from by what it sees itself: a car that moves slowly enough to have points is elsewhere for others.

    Parameters
    ----------
    points_m
        Points (n, 3) of the plan frame.
    seen_by
        For every view the points that it sees, in its camera or in another one at the same time.
    """

    def __init__(self, points_m: Floats, seen_by: Sequence[Ints]) -> None:
        self._points_m, self._seen_by = points_m, seen_by

    def hidden_from(self, view: int, placed: PlacedView) -> Bools:
        """Raster (301, 301) of `STEP_M` around a view's camera, y growing with the rows: whether things hide the
        ground."""
        hidden = np.zeros((SIDE, SIDE), np.bool_)
        _hide_by_points(
            self._points_m, self._seen_by[view], placed.centre_m, placed.above_ground_m, placed.heights_m,
            placed.first_m, hidden,
        )  # fmt: skip
        return hidden


@njit(cache=True, nogil=True, error_model="numpy")
def _hide_by_points(
    points: Any, seen: Any, centre: Any, camera_above: float, heights: Any, first: Any, hidden: Any
) -> None:
    """Mark every place of the raster that one of the points `seen` hides, by the ground's heights around the camera."""
    for p in seen:
        x, y = points[p, 0], points[p, 1]
        distance = math.hypot(x - centre[0], y - centre[1])
        if not STEP_M <= distance < VIEW_M:
            continue
        above = points[p, 2] - height_at(heights, x - first[0], y - first[1])
        share = above / camera_above
        if above <= STANDING_M or share >= OVERHEAD:
            continue
        # By similar triangles, the ray over the point meets the ground that many times as far away.
        reach = min(distance / (1.0 - share), VIEW_M) if share < TALL else VIEW_M
        _hide((x - centre[0]) / distance, (y - centre[1]) / distance, distance, reach, hidden)


@uncounted()
def _hide(along_x: float, along_y: float, distance: float, reach: float, hidden: Any) -> None:
    """Mark a strip of the raster from a distance in a direction on, as far as `reach`."""
    rows, columns = hidden.shape
    middle = rows // 2
    r = distance
    while r <= reach:
        half = int(HALF_WIDTH_M * r / distance / STEP_M + 0.5)
        i, j = round(middle + along_y * r / STEP_M), round(middle + along_x * r / STEP_M)
        left, right = max(j - half, 0), min(j + half + 1, columns)
        for a in range(max(i - half, 0), min(i + half + 1, rows)):
            hidden[a, left:right] = True
        r += STEP_M
