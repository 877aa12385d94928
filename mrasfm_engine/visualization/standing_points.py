"""Ground that things hide from a view, by the scene's points that stand above it.

A camera that looks at a car sees the car where the ground behind it would be. A point above the ground tells how far
that goes: from below the point, on which the thing stands, to where the ray through the point meets the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Floats, Ints
from mrasfm_engine.visualization.ground import GroundHeights
from mrasfm_engine.visualization.views import VIEW_M, PlacedView

STANDING_M = 0.3  # above the ground: kerbs and the error of the ground's height stay below
OVERHEAD = 0.9  # of the camera's height: what is higher hides no ground, and may be a wire or a branch
TALL = 0.6  # of the camera's height: what reaches that is taken to go on upwards, as walls and cars do
STEP_M = 0.1  # of the raster
SIDE = 2 * round(VIEW_M / STEP_M) + 1
HALF_WIDTH_M = 0.15  # of the strip that a point hides, where it stands: about the distance of points on one thing


class StandingPoints:
    """Points above the ground, by the views that see them.

    A view is hidden from by what it sees itself: a car that moves slowly enough to have points is elsewhere for others.
    One thread asks at a time.

    Parameters
    ----------
    points_m
        Points (n, 3) of the plan frame.
    seen_by
        For every view the points that it sees, in its camera or in another one at the same time.
    """

    def __init__(self, points_m: Floats, seen_by: Sequence[Ints], ground: GroundHeights) -> None:
        self._points_m, self._seen_by, self._ground = points_m, seen_by, ground
        self._above_m = np.full(len(points_m), np.nan)  # the ground, where a view has asked for it

    def hidden_from(self, view: int, placed: PlacedView) -> Bools:
        """Raster (301, 301) of `STEP_M` around a view's camera, y growing with the rows: whether things hide the
        ground."""
        hidden = np.zeros((SIDE, SIDE), np.bool_)
        seen = self._seen_by[view]
        foot_m = self._points_m[seen, :2] - placed.centre_m[:2]
        near = np.hypot(*foot_m.T) < VIEW_M
        if near.any():
            above_m = self._above_ground_m(seen[near])
            share = above_m / placed.above_ground_m
            stands = (above_m > STANDING_M) & (share < OVERHEAD)
            # By similar triangles, the ray over the point meets the ground that many times as far away.
            times = np.where(share < TALL, 1 / (1 - np.minimum(share, TALL)), np.inf)
            _hide(foot_m[near][stands], times[stands], hidden)
        return hidden

    def _above_ground_m(self, points: Ints) -> Floats:
        """Heights (n,) of points above the ground, each computed once: tens of views see a point."""
        unknown = points[np.isnan(self._above_m[points])]
        if len(unknown):
            xyz_m = self._points_m[unknown]
            self._above_m[unknown] = xyz_m[:, 2] - self._ground.height_m(xyz_m[:, :2])
        return self._above_m[points]


@njit(cache=True, nogil=True)
def _hide(foot: Any, times: Any, hidden: Any) -> None:
    """Mark every place of the raster that a point hides."""
    rows, columns = hidden.shape
    middle = rows // 2
    for p in range(len(foot)):
        distance = np.hypot(foot[p, 0], foot[p, 1])
        if distance < STEP_M:
            continue
        along_x, along_y = foot[p, 0] / distance, foot[p, 1] / distance
        reach = min(distance * times[p], VIEW_M)
        r = distance
        while r <= reach:
            half = int(HALF_WIDTH_M * r / distance / STEP_M + 0.5)
            i, j = round(middle + along_y * r / STEP_M), round(middle + along_x * r / STEP_M)
            left, right = max(j - half, 0), min(j + half + 1, columns)
            for a in range(max(i - half, 0), min(i + half + 1, rows)):
                hidden[a, left:right] = True
            r += STEP_M
