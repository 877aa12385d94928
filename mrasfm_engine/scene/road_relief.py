"""Relief of a road: what is left of its bumps, crowns and bays when plane patches of many metres are taken off."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.types import Floats

BLEND_M = 2.0  # from a node, up to which it counts: there is one for every square metre
BLENDED = 12  # nearest nodes that count at one place
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

    @cached_property
    def _kd_tree(self) -> cKDTree:
        return cKDTree(self.node_m)

    def at(self, foot_m: Floats, *, threads: int = 1) -> tuple[Floats, Floats]:
        """Heights (p,) above the patches at places (p, 3) on them, and their standard deviations (p,).

        Where no node is near, the height is zero and its standard deviation NaN.
        """
        height, sigma = np.zeros(len(foot_m)), np.full(len(foot_m), np.nan)
        if not len(self) or not len(foot_m):
            return height, sigma
        count = min(BLENDED, len(self))
        reach_m = float(np.hypot(BLEND_M, LEVEL_M))
        found = self._kd_tree.query(foot_m, k=count, distance_upper_bound=reach_m, workers=threads)
        distance, node = (np.asarray(a).reshape(len(foot_m), count) for a in found)
        node = np.where(np.isfinite(distance), node, 0)
        away = foot_m[:, None] - self.node_m[node]
        counts = np.isfinite(distance) & (np.abs(away[..., 2]) < LEVEL_M)
        reach = np.minimum((away[..., 0] ** 2 + away[..., 1] ** 2) / BLEND_M**2, 1.0)
        weight = np.where(counts, (1.0 - reach) ** 2, 0.0)
        value = self.height_m[node] + (away[..., :2] * self.slope[node]).sum(2)
        total = weight.sum(1)
        height = (weight * value).sum(1) / (total + NO_RELIEF)
        some = total > 0
        sigma[some] = (weight * self.sigma_m[node]).sum(1)[some] / total[some]
        return height, sigma
