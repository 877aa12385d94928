"""The colour of a piece of road, from what its views agree on.

A car that moved on, and what stands above the ground, look different in the views of one cell: most views decide, and
where they do not agree on anything the cell is left out. A view from which something hides the cell votes against all
colours: what most views cannot see may be a gap between the points of the thing itself.

Colours are blended only between views that agree, so that nothing is seen twice: at the edge of a marking that two
views have in different places, one of them decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Bytes, Floats32
from mrasfm_engine.visualization.road_candidates import HIDDEN, QUALITY_UNIT, Candidates

# Views agree if no colour differs by more: noise and JPEG leave some grey levels, exposures are even to a tenth.
TOLERANCE, TOLERANCE_SHARE = 5.0, 0.10
FULL_VOTE_PX = 20.0  # pixels a metre: a view whose pixels are 5 cm shows markings; what shows less has less of a vote
BLEND_POWER = 4  # of quality: between views of about equal quality a band, else the best
MIN_SHARE = 0.5  # of the votes, that agree on what is shown
COHERENCE_CELLS = 8  # to all sides, over which the agreement is averaged: single cells are no holes


@dataclass(frozen=True, kw_only=True)
class Consensus:
    """A square of road.

    Attributes
    ----------
    color
        (h, w, 3)
    seen
        (h, w) whether any view sees the cell.
    agreed
        (h, w) whether its views and those of its surroundings agree on what is there; a single view does with itself.
    single
        (h, w) whether all its views are from one place.
    """

    color: Bytes
    seen: Bools
    agreed: Bools
    single: Bools


def find_consensus(candidates: Candidates, *, cameras: int) -> Consensus:
    """Decide on every cell; all but `COHERENCE_CELLS` at the border are decided as within a larger square.

    Parameters
    ----------
    cameras
        How many consecutive numbers a place has, one for every camera.
    """
    shape = candidates.count.shape
    color, share, places = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    _decide(candidates.count, candidates.color, candidates.quality, candidates.place, cameras, color, share, places)
    seen = candidates.count > 0
    return Consensus(
        color=color, seen=seen, agreed=(places > 0) & (_mean(share, seen) >= MIN_SHARE), single=seen & (places == 1)
    )


def _mean(share: Floats32, seen: Bools) -> Floats32:
    """Mean over the surroundings of every cell that are seen."""
    side = 2 * COHERENCE_CELLS + 1
    total, count = (
        cv2.boxFilter(a, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for a in (share * seen, seen.astype(np.float32))
    )
    result: Floats32 = total / np.maximum(count, 1.0)
    return result


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp"})
def _decide(
    count: Any, color: Any, quality: Any, place: Any, cameras: int, result: Any, share: Any, places: Any
) -> None:
    """Fill colour, share of votes for it, and number of places that see it, of every cell."""
    most = quality.shape[2]
    vote, support, blended = np.empty(most), np.empty(most), np.empty(3)
    piece = np.empty(most, np.int64)
    for row in range(count.shape[0]):
        for column in range(count.shape[1]):
            n = np.int64(count[row, column])
            if n == 0:
                continue
            apart = 0
            for i in range(n):
                piece[i] = place[row, column, i] // cameras
            for i in range(n):
                beside, first = 0, True
                for j in range(n):
                    if piece[j] == piece[i]:
                        beside += 1
                        first = first and j >= i
                apart += first
                vote[i] = min(1.0, quality[row, column, i] / (QUALITY_UNIT * FULL_VOTE_PX)) / beside
            total = 0.0
            for i in range(n):
                total += vote[i]
                support[i] = vote[i]
            for i in range(n):
                for j in range(i):
                    if color[row, column, i, 0] != HIDDEN and color[row, column, j, 0] != HIDDEN:
                        like = _likeness(color, row, column, i, j)
                        support[i] += vote[j] * like
                        support[j] += vote[i] * like
            chosen = -1
            for i in range(n):
                if color[row, column, i, 0] != HIDDEN and (chosen < 0 or support[i] > support[chosen] + 1e-9):
                    chosen = i
            if chosen < 0:
                continue
            weights = 0.0
            blended[:] = 0.0
            highest = 1.0
            for i in range(n):
                if color[row, column, i, 0] != HIDDEN:
                    highest = max(highest, float(quality[row, column, i]))
            for i in range(n):
                like = 0.0 if color[row, column, i, 0] == HIDDEN else _likeness(color, row, column, chosen, i)
                if like <= 0.0:
                    continue
                weight = like * (quality[row, column, i] / highest) ** BLEND_POWER
                weights += weight
                for k in range(3):
                    blended[k] += weight * color[row, column, i, k]
            for k in range(3):
                result[row, column, k] = int(blended[k] / weights + 0.5)
            share[row, column] = support[chosen] / total
            places[row, column] = apart


@njit(cache=True, forceinline=True, error_model="numpy")
def _likeness(color: Any, row: int, column: int, i: int, j: int) -> float:
    """1 for views that agree, 0 for views that differ by twice the tolerance, linear between."""
    apart, level = 0.0, 0.0
    for k in range(3):
        a, b = float(color[row, column, i, k]), float(color[row, column, j, k])
        apart = max(apart, abs(a - b))
        level = max(level, max(a, b))
    return min(max(2.0 - apart / (TOLERANCE + TOLERANCE_SHARE * level), 0.0), 1.0)
