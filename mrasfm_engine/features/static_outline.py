"""The outline of what stays at its pixels, from the lower border of an image upwards.

The outline has one height above the border at every column, zero where nothing stays. It is the best path through the
image: each pixel of its length is worth as much as the edge there is one that stays, and costs as much as it is none.
Columns follow one another, so that dynamic programming finds the best path in time proportional to the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bools, Floats, Floats32, Ints

# Share of a gradient's energy that stays. An edge whose contrast varies by three times its mean keeps a tenth; of n
# gradients without anything in common up to 2/n remains. Twice as much is an edge for sure.
MIN_LASTING_SHARE = 0.12
NOISE_SHARES = 2.0
RESOLUTION = 0.5  # of gradients, in grey levels: what 8 bits resolve
LEAST_PART = 0.5  # of the mean contrast, that an edge has in every part of the way
WINDOW_PX = 0.7  # sigma of the neighbourhood whose gradients count together
# Paint mirrors the world smaller and fainter than it is, so that its detail changes less than that of what is behind.
# Half of the change or less is another surface for sure, and half of the gradient's share is enough for an edge there:
# world that is rich in contrast hides the edge of dark paint in front of it.
CHANGE_WINDOW_PX = 1.5  # sigma
CHANGE_RATIO = 2.0
SURE_RISE = (CHANGE_RATIO - 1) / (CHANGE_RATIO + 1)  # difference of the changes above and below over their sum
NO_CHANGE = 1e-3  # relative to the brightness; less is a constant pixel
MIN_CHANGE_STEP = 0.3  # of that ratio, on a logarithmic scale; less is how much the change of one surface varies
STEP_SIGMAS = 3.0  # of a step that few images alone make, in which one pixel in ninety has more
RIM_PX = 5  # from the outline, where the surfaces on its two sides are compared

ALONG_MOTION = 0.6  # worth of an edge along the motion, which the world has too, against one across it
NO_EDGE = 0.5  # cost of a pixel of outline without an edge: half of what is won by one with an edge
AREA = 0.01  # worth of a pixel between outline and border that changes little: decides between equal outlines
GROUND_QUANTILE = 0.75  # of the changes below the horizon: that of ground, if it fills a quarter of them or more
# A second outline outside the first is sought, as a mirrored skyline stays as well as the edge of the paint. It is held
# to more: edges along the motion are worth nothing, and its sides cost more.
OUTER_PASSES = 3
OUTER_WORTH = 3.0
OUTER_ALONG_MOTION = 0.05  # share across the motion below which an edge is a kerb's: 13 degrees off its direction
OUTER_NO_SIDE = 2.0
OUTER_FALL = 0.17  # beyond the least fall, from which on the evidence counts in full: traffic is nearer the horizon
SAME_EDGE_PX = 3
SNAP_PX = 3  # an edge is blurred by that much; its middle is the outline
GAP_SHARE, SPIKE_SHARE = 1 / 20, 1 / 70  # of the width: narrower gaps and spikes of the area are none
SUPPORTED = 0.5  # of an edge, and of a column's neighbours, as the outline that makes a hull


@dataclass(frozen=True, kw_only=True)
class StaticEdges:
    """Judgement of every pixel (h, w) by the gradients of one camera's images."""

    lasting: Floats32  # share of the gradient that stays, over the least that an edge keeps
    edge: Floats32  # 0 to 1: an edge stays here
    across: Floats32  # 0 to 1: the gradient is along the motion, an edge across it
    always: Floats32  # 0 to 1: the edge is there in every part of the way
    step: Floats32  # 0 to 1: what is outside changes more
    step_evidence: Floats32  # 0 to 1: as well, across the motion
    strength: Floats32  # of the mean gradient
    change: Floats32  # standard deviation of fine detail over time
    fall: Floats32  # of the ray, beyond the least

    @classmethod
    def from_sums(
        cls, gradients: Floats32, energy: Floats32, changes: Floats32, count: int, *, fall: Floats, flow: Floats
    ) -> StaticEdges:
        """Judge mean gradients.

        Parameters
        ----------
        gradients, energy
            Means (parts, 2, h, w, channels) over parts of the way, and mean square (h, w) over all of it, of the
            gradients of a number `count` of images.
        changes
            Standard deviations (2, h, w) of fine detail over time, of every other image and of those between.
        fall, flow
            See `StaticEdges.fall`; directions (h, w, 2) in which the world moves.
        """
        gradient = gradients.mean(0)
        constant = _windowed((gradient**2).sum((0, 3)))
        share = constant / (_windowed(energy) + RESOLUTION**2)
        share = (count * share - 1) / (count - 1)  # what remains of gradients without anything in common is taken off
        least = max(MIN_LASTING_SHARE, NOISE_SHARES / count)
        lasting = _without_rim(np.asarray(share / least, dtype=np.float32))
        near = fall > 0
        change = np.asarray(np.sqrt((changes**2).mean(0)), dtype=np.float32)
        slope = _change_slope(change)
        least_step = _least_step(changes, near & (change > NO_CHANGE))
        step = _without_rim(np.clip(np.hypot(*slope) - least_step, 0, 1) * near)
        return cls(
            lasting=lasting,
            edge=np.clip(lasting - 1, 0, 1),
            across=_across(gradient, flow),
            always=_always(gradients),
            step=step,
            step_evidence=step * _across(slope[..., None], flow),
            strength=np.sqrt(constant),
            change=np.asarray(cv2.blur(change, (5, 5)), dtype=np.float32),
            fall=fall.astype(np.float32),
        )

    def without(self, area: Bools) -> StaticEdges:
        """The same without edges in an area (h, w)."""
        names = ("lasting", "edge", "always", "step", "step_evidence")
        cleared = {name: np.where(area, np.float32(0), getattr(self, name)) for name in names}
        return replace(self, **cleared)

    def turned(self, quarters: int) -> StaticEdges:
        """The same after quarter turns counterclockwise."""
        turned = {f.name: np.ascontiguousarray(np.rot90(getattr(self, f.name), quarters)) for f in fields(self)}
        return StaticEdges(**turned)


@dataclass(frozen=True, kw_only=True)
class Part:
    """One connected area below the best outline, and how sure it is."""

    mask: Bools  # (h, w)
    evidence_px: float  # length of the outline that the world cannot have
    evidence_share: float  # of the outline's length


def trace_outline(edges: StaticEdges) -> list[Part]:
    """Find the outlines of what stays at the lower border of an image."""
    near = edges.fall > 0
    # Only what changes more above than below is the upper edge of a surface that changes little.
    above, below = _shifted(edges.change, RIM_PX), _shifted(edges.change, -RIM_PX)
    rises = np.clip((above - below) / (above + below + 1e-6), 0, 1)
    lasting = np.clip(edges.lasting * (1 + np.clip(rises / SURE_RISE, 0, 1)) - 1, 0, 1)
    lasting_evidence = lasting * near * edges.across
    edge = np.maximum(lasting, edges.step * (rises > 0))
    evidence = np.maximum(lasting_evidence, edges.step_evidence * (rises > 0))
    ground = float(np.quantile(edges.change[near], GROUND_QUANTILE)) if near.any() else float(edges.change.max())
    area = AREA * np.clip(1 - 2 * edges.change / max(ground, 1e-6), -1, 1)
    missing = NO_EDGE * (1 - edge)
    worth = near * (ALONG_MOTION * edge + (1 - ALONG_MOTION) * evidence) * (1 + NO_EDGE * rises)
    heights = _best_heights(worth - missing, area, missing)
    sure = np.clip(edges.fall / OUTER_FALL, 0, 1)
    outer = OUTER_WORTH * sure * (evidence - OUTER_ALONG_MOTION * edge) - missing
    heights = _outermost(heights, outer, area, OUTER_NO_SIDE * (1 - edge))
    heights = _snapped(heights, edges.strength)
    is_edge = _along(heights, edge) > SUPPORTED
    along = np.where(heights > 0, _along(heights, lasting_evidence * edges.always), 0.0)
    tidied = _tidied(_below(heights, len(edge)), is_edge)
    count, labels = cv2.connectedComponents(tidied.astype(np.uint8), connectivity=4)
    of_column = labels[-1]
    return [
        Part(
            mask=labels == label,
            evidence_px=float(along[of_column == label].sum()),
            evidence_share=float(along[of_column == label].mean()) if (of_column == label).any() else 0.0,
        )
        for label in range(1, count)
    ]


def _outermost(heights: Ints, crossing: NDArray[Any], area: NDArray[Any], side: NDArray[Any]) -> Ints:
    """Heights (w,) of the outermost outline that pays outside of the one with some heights, see `_best_heights`."""
    for _ in range(OUTER_PASSES):
        reach = 2 * SAME_EDGE_PX + 1
        known = cv2.dilate(_below(heights, len(area)).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        found = _best_heights(*(np.where(known, np.float32(0), cost) for cost in (crossing, area, side)))
        farther = (found > heights + SAME_EDGE_PX) & heights.any()
        if not farther.any():
            break
        heights = np.where(farther, found, heights)
    return heights


def _windowed(values: Floats32) -> Floats32:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), WINDOW_PX), dtype=np.float32)


def gradients_of(image: Floats32) -> Floats32:
    """Gradients (2, h, w, ...) of an image (h, w, ...) along x and y, per pixel."""
    return np.stack([cv2.Sobel(image, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1))])


def _least_step(changes: Floats32, asked: Bools) -> float:
    """Least step that counts, by how much halves (2, h, w) of the images differ in the pixels (h, w) that are asked."""
    # Halves differ by twice the error of the whole; the median length of two normal errors is 1.18 sigmas.
    differences = np.hypot(*(_change_slope(changes[0]) - _change_slope(changes[1])))[asked]
    error = float(np.median(differences)) / (2 * 1.18) if len(differences) else 0.0
    return math.hypot(MIN_CHANGE_STEP, STEP_SIGMAS * error)


def _change_slope(change: Floats32) -> Floats32:
    """Slope (2, h, w) of a logarithm of the change, in steps of `CHANGE_RATIO` across the window."""
    smooth = np.log(cv2.GaussianBlur(change, (0, 0), CHANGE_WINDOW_PX) + NO_CHANGE)
    return np.asarray(gradients_of(smooth) * (2 * CHANGE_WINDOW_PX / math.log(CHANGE_RATIO)), dtype=np.float32)


def _without_rim(values: Floats32) -> Floats32:
    """The same without the outermost pixels, whose gradients are halved."""
    values = np.array(values, dtype=np.float32)
    values[[0, -1]] = 0
    values[:, [0, -1]] = 0
    return values


def _across(gradient: Floats32, flow: Floats) -> Floats32:
    """Share (h, w) of the energy of gradients (2, h, w, channels) that is along the flow: of edges across it."""
    xx, xy, yy = (_windowed((gradient[i] * gradient[j]).sum(-1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = flow[..., 0], flow[..., 1]
    along = (xx * x**2 + 2 * xy * x * y + yy * y**2) / (xx + yy + 1e-9)
    return np.asarray(along, dtype=np.float32)


def _always(gradients: Floats32) -> Floats32:
    """Share (h, w) of the mean of gradients (parts, 2, h, w, channels) that the part with least of it has."""
    mean = gradients.mean(0)
    energy = _windowed((mean**2).sum((0, 3))) + 1e-6
    least = np.min([_windowed((part * mean).sum((0, 3))) / energy for part in gradients], axis=0)
    return np.asarray(np.clip(least / LEAST_PART, 0, 1), dtype=np.float32)


def _shifted(values: Floats32, rows: int) -> Floats32:
    """Values (h, w) of the pixels some rows above (or below, if negative), of the first or last row beyond that."""
    index = np.clip(np.arange(len(values)) - rows, 0, len(values) - 1)
    return values[index]


def _below(heights: Ints, rows: int) -> Bools:
    """Pixels (rows, w) within heights (w,) of the lower border."""
    return np.asarray(np.arange(rows)[:, None] >= rows - heights[None])


def _snapped(heights: Ints, strength: Floats32) -> Ints:
    """Heights moved inwards to the middle of their edge."""
    rows = len(strength)
    result = heights.copy()
    for column in np.flatnonzero(heights):
        top = rows - heights[column]
        result[column] = heights[column] - int(np.argmax(strength[top : top + SNAP_PX + 1, column]))
    return result


def _along(heights: Ints, values: NDArray[Any]) -> NDArray[Any]:
    """Largest value (w,) within a pixel of an outline."""
    rows = len(values)
    at = np.clip(rows - heights[None] + np.array([-1, 0, 1])[:, None], 0, rows - 1)
    return np.asarray(values[at, np.arange(values.shape[1])[None]].max(0))


def _tidied(mask: Bools, is_edge: Bools) -> Bools:
    """The area without narrow gaps and spikes, and without dents: sheet metal is convex.

    A dent is where the paint mirrors what looks like the ground beside it. Spikes (an aerial) make no hull, nor do
    columns most of whose neighbourhood has no edge at the outline (`is_edge`, (w,)).
    """
    width = mask.shape[1]
    gap, spike = (max(3, round(share * width) // 2 * 2 + 1) for share in (GAP_SHARE, SPIKE_SHARE))
    area = cv2.copyMakeBorder(mask.astype(np.uint8), gap, gap, gap, gap, cv2.BORDER_REPLICATE)
    supported = cv2.blur(np.pad(is_edge, gap, mode="edge").astype(np.float32)[None], (gap, 1)) > SUPPORTED
    closed, body = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)) for side in (gap, spike))
    area = cv2.morphologyEx(cv2.morphologyEx(area, cv2.MORPH_CLOSE, closed), cv2.MORPH_OPEN, body)
    hulls, bodies = np.zeros_like(area), area.copy()
    bodies[-gap:] = 0  # low strips beside the car are no part of its body
    bodies = cv2.morphologyEx(bodies, cv2.MORPH_OPEN, closed) * supported.astype(np.uint8)
    count, labels = cv2.connectedComponents(area)
    for label in range(1, count):
        body = cv2.findNonZero(bodies * (labels == label))
        if body is not None:
            cv2.fillConvexPoly(hulls, cv2.convexHull(body), 1)
    return np.asarray((area | hulls)[gap:-gap, gap:-gap] > 0)


def _best_heights(crossing: NDArray[Any], area: NDArray[Any], side: NDArray[Any]) -> Ints:
    """Heights (w,) of the outline with the largest sum.

    Parameters
    ----------
    crossing
        Worth (h, w) of an outline whose uppermost pixel of the column is this one.
    area
        Worth of the pixels below it.
    side
        Cost of the pixels that the outline passes between two columns of different height.
    """
    heights = np.zeros(crossing.shape[1], np.int64)
    _find_path(*(np.ascontiguousarray(v, dtype=np.float32) for v in (crossing, area, side)), heights)
    return heights


@njit(cache=True, nogil=True)
def _find_path(crossing: Any, area: Any, side: Any, heights: Any) -> None:
    """Viterbi over columns: a change of height costs the sides passed, so that two sweeps find all predecessors."""
    rows, columns = crossing.shape
    value, passed = np.zeros(rows + 1), np.zeros(rows + 1)
    best_value = np.zeros(rows + 1)
    came_from = np.zeros((columns, rows + 1), np.int32)
    for column in range(columns):
        for height in range(1, rows + 1):
            passed[height] = passed[height - 1] + side[rows - height, column]
        for height in range(rows + 1):
            came_from[column, height] = height
            best_value[height] = value[height]
        if column > 0:
            lower = 0
            for height in range(rows + 1):
                if value[height] + passed[height] > value[lower] + passed[lower]:
                    lower = height
                best_value[height] = value[lower] + passed[lower] - passed[height]
                came_from[column, height] = lower
            upper = rows
            for height in range(rows, -1, -1):
                if value[height] - passed[height] > value[upper] - passed[upper]:
                    upper = height
                other = value[upper] - passed[upper] + passed[height]
                if other > best_value[height]:
                    best_value[height] = other
                    came_from[column, height] = upper
        total = 0.0
        value[0] = best_value[0]
        for height in range(1, rows + 1):
            total += area[rows - height, column]
            value[height] = best_value[height] + total + crossing[rows - height, column]
    heights[columns - 1] = np.argmax(value)
    for column in range(columns - 1, 0, -1):
        heights[column - 1] = came_from[column, heights[column]]
