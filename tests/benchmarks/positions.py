"""GNSS of a manifest, made from true positions of the antenna with errors of known kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.synthetic.gnss import Origin
from mrasfm_engine.types import Floats, Ints


@dataclass(frozen=True, kw_only=True)
class Receiver:
    """A receiver's errors, by axis.

    Attributes
    ----------
    white_m
        Standard deviation of what differs from sample to sample.
    wander_m
        Standard deviation of a Gauss-Markov error, in its stationary state.
    wander_time_s
        Its correlation time.
    walk_m
        Standard deviation of a random walk after `wander_time_s`.
    declared_m
        Sigma in the manifest.
    """

    white_m: float
    wander_m: float = 0.0
    walk_m: float = 0.0
    wander_time_s: float = 60.0
    declared_m: float

    def gnss(
        self, timestamps_us: Ints, antenna_m: Floats, antenna_in_rig_m: Floats, rng: np.random.Generator
    ) -> dict[str, Any]:
        """The manifest's `gnss` of positions (n, 3) in an ENU frame, a sample each."""
        places = Origin().geodetic(antenna_m + self.errors_m(timestamps_us, rng))
        return {
            "height_datum": "ellipsoidal",
            "antenna_in_rig_m": antenna_in_rig_m.tolist(),
            "samples": [
                {
                    "timestamp_us": time_us,
                    "latitude_deg": latitude,
                    "longitude_deg": longitude,
                    "height_m": height,
                    "sigma_horizontal_m": self.declared_m,
                    "sigma_vertical_m": self.declared_m,
                }
                for time_us, (latitude, longitude, height) in zip(timestamps_us.tolist(), places.tolist(), strict=True)
            ],
        }

    def errors_m(self, timestamps_us: Ints, rng: np.random.Generator) -> Floats:
        """Errors (n, 3) at instants (n,)."""
        result: Floats = rng.normal(0.0, self.white_m, (len(timestamps_us), 3))
        wander_m, walk_m = rng.normal(0.0, self.wander_m, 3), np.zeros(3)
        for i, elapsed_s in enumerate(np.diff(timestamps_us, prepend=timestamps_us[0]) / 1e6):
            kept = np.exp(-elapsed_s / self.wander_time_s)
            wander_m = kept * wander_m + rng.normal(0.0, self.wander_m, 3) * np.sqrt(1.0 - kept**2)
            walk_m += rng.normal(0.0, self.walk_m, 3) * np.sqrt(elapsed_s / self.wander_time_s)
            result[i] += wander_m + walk_m
        return result
