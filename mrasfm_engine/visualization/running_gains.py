"""Exposure of every view against the ground that earlier views painted.

The gains of `exposure_gains` come from points that images share, and different cameras share few. What a view sees of
ground that is painted already says how bright its camera is, and how bright it is itself.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.types import Floats

MIN_COMPARED = 50  # cells, below which a comparison says nothing
MAX_LOG = 0.35  # of a camera's gain: a factor of 1.4, as `camera_gains` allows
CAMERA_WEIGHT = 0.15  # of one view's comparison in its camera's mean: a memory of about seven views
# Of a view's own deviation from its camera, half is taken: a view compares itself with what was painted with earlier
# ones, and a whole correction would let errors add up along the path.
VIEW_WEIGHT = 0.5


class RunningGains:
    """Factors on the colours of views, as they come."""

    def __init__(self, cameras: int) -> None:
        self._log_gain = np.zeros(cameras)
        self._compared = np.zeros(cameras, dtype=np.int64)

    def factor(self, camera: int, log_ratios: Floats) -> float:
        """The factor for a view, from how much brighter than it the ground is (n,) where both see it."""
        if len(log_ratios) < MIN_COMPARED:
            return float(np.exp(self._log_gain[camera]))
        found = float(np.clip(np.median(log_ratios), -MAX_LOG, MAX_LOG))
        self._compared[camera] += 1
        weight = max(CAMERA_WEIGHT, 1.0 / self._compared[camera])
        self._log_gain[camera] += weight * (found - self._log_gain[camera])
        # All cameras together stay as bright as they are.
        known = self._compared > 0
        self._log_gain[known] -= weight * self._log_gain[known].mean()
        return float(np.exp(self._log_gain[camera] + VIEW_WEIGHT * (found - self._log_gain[camera])))
