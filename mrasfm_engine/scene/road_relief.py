"""Relief of a road: what is left of its bumps, crowns and bays when plane patches of many metres are taken off."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.parallel import in_ranges
from mrasfm_engine.types import Floats, Ints

NODE_M = 1.0  # between nodes: a speed bump is some metres long
BLEND_M = 2.0  # from a node, up to which it counts
NO_RELIEF = 0.05  # weight of no relief at all: where no node is near, the relief fades out
LEVEL_M = 1.0  # nodes farther above or below belong to other roads


@dataclass(frozen=True, kw_only=True)
class Relief:
    """Planes at nodes, in the horizontal frame of the road's surface, whose weighted mean is the height above patches.

    A node counts with `(1 - (d / BLEND_M)^2)^2` at the horizontal distance d.
    """

    node_m: Floats  # (n, 3) on the patches' surface: horizontal coordinates and height
    height_m: Floats  # (n,) of the road above that surface, there
    slope: Floats  # (n, 2) of the road against that surface
    sigma_m: Floats  # (n,) of the height

    def __len__(self) -> int:
        return len(self.node_m)

    @staticmethod
    def none() -> Relief:
        """No nodes: the patches alone are the surface."""
        return Relief(node_m=np.zeros((0, 3)), height_m=np.zeros(0), slope=np.zeros((0, 2)), sigma_m=np.zeros(0))

    def at(self, foot_m: Floats, *, threads: int = 1) -> tuple[Floats, Floats]:
        """Heights (p,) above the patches at places (p, 3) on them, and their standard deviations (p,).

        Where no node is near, the height is zero and its standard deviation NaN.
        """
        height, sigma = np.zeros(len(foot_m)), np.full(len(foot_m), np.nan)
        if len(self):
            in_ranges(threads, len(foot_m), partial(_at, *self._by_square, foot_m, height, sigma))
        return height, sigma

    @cached_property
    def _by_square(self) -> tuple[Ints, Ints, int, Floats]:
        """Squares of NODE_M with nodes, in the order of their numbers: the numbers (n,), of a corner (2,) and a row.

        And what the nodes are (n, 7): position, height, slope, standard deviation.
        """
        square = np.floor(self.node_m[:, :2] / NODE_M).astype(np.int64)
        corner = square.min(axis=0)
        row = int(square[:, 1].max() - corner[1]) + 1
        number = (square[:, 0] - corner[0]) * row + square[:, 1] - corner[1]
        order = np.argsort(number, kind="stable")
        nodes = np.column_stack([self.node_m, self.height_m, self.slope, self.sigma_m])
        return number[order], corner, row, np.ascontiguousarray(nodes[order])


@njit(cache=True, nogil=True, error_model="numpy")
def _at(number: Any, corner: Any, row: int, node: Any, foot: Any, height: Any, sigma: Any, lo: int, hi: int) -> None:
    """Heights and standard deviations at places lo to hi; the nodes around each are runs of squares, one by column."""
    reach = math.ceil(BLEND_M / NODE_M)
    for i in range(lo, hi):
        x, y, z = foot[i, 0], foot[i, 1], foot[i, 2]
        column, line = math.floor(x / NODE_M) - corner[0], math.floor(y / NODE_M) - corner[1]
        first, last = max(line - reach, 0), min(line + reach, row - 1)
        total, value, deviation = 0.0, 0.0, 0.0
        for c in range(column - reach, column + reach + 1):
            if c < 0 or first > last:
                continue
            n = np.searchsorted(number, c * row + first)
            while n < len(number) and number[n] <= c * row + last:
                dx, dy = x - node[n, 0], y - node[n, 1]
                far = (dx * dx + dy * dy) / (BLEND_M * BLEND_M)
                if far < 1.0 and abs(z - node[n, 2]) < LEVEL_M:
                    w = (1.0 - far) ** 2
                    total += w
                    value += w * (node[n, 3] + dx * node[n, 4] + dy * node[n, 5])
                    deviation += w * node[n, 6]
                n += 1
        if total > 0.0:
            height[i], sigma[i] = value / (total + NO_RELIEF), deviation / total
