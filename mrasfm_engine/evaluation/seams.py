"""Error of the relative pose of two scenes of a map, at the seam between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

OVERLAP_M = 5.0  # units of two scenes nearer than that are in the overlap
LEAST_UNITS = 3  # the nearest ones that are compared where none are


@dataclass(frozen=True, kw_only=True)
class SeamErrors:
    """Medians over units of scene a and their nearest unit of scene b."""

    units: int
    translation_m: float
    rotation_deg: float


def compare_seam(a: Floats, b: Floats, true_a: Floats, true_b: Floats) -> SeamErrors | None:
    """The error of inverse(world_from_a) * world_from_b against truth; None where either scene has no pose.

    It is only meaningful inside the overlap: far from it, a rotation or a scale that is a little off becomes metres.

    Parameters
    ----------
    a, b
        Estimated poses (n, 4, 4) and (m, 4, 4) of units, in one world.
    true_a, true_b
        True poses of the same units, in one world.
    """
    if not len(a) or not len(b):
        return None
    away = np.linalg.norm(true_a[:, None, :3, 3] - true_b[None, :, :3, 3], axis=2)
    nearest, distance = away.argmin(1), away.min(1)
    rows = np.flatnonzero(distance <= OVERLAP_M)
    if len(rows) < LEAST_UNITS:
        rows = np.argsort(distance, kind="stable")[:LEAST_UNITS]
    found = se3.inverse(a[rows]) @ b[nearest[rows]]
    true = se3.inverse(true_a[rows]) @ true_b[nearest[rows]]
    shift = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    turn = se3.rotation_angle_deg(found[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
    return SeamErrors(units=len(rows), translation_m=float(np.median(shift)), rotation_deg=float(np.median(turn)))
