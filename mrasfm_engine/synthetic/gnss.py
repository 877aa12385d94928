"""Measurements of a simulated GNSS receiver, and the place of a world on Earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.types import Floats, Ints
from schemas import Gnss, GnssSample

ANTENNA_IN_RIG_M = (0.55, 0.12, 1.62)
VERTICAL_FACTOR = 1.5  # satellites are above only, so heights are worse
_DRIFT_TIME_S = 20.0


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Geodetic origin of the world's ENU frame; height above the WGS84 ellipsoid."""

    latitude_deg: float = 48.137
    longitude_deg: float = 11.575
    height_m: float = 567.0

    def geodetic(self, enu_m: Floats) -> Floats:
        """Latitude, longitude (degrees) and ellipsoidal height (metres) (n, 3) of ENU positions (n, 3)."""
        pipeline = (
            "+proj=pipeline "
            f"+step +inv +proj=topocentric +ellps=WGS84 +lat_0={self.latitude_deg} +lon_0={self.longitude_deg} "
            f"+h_0={self.height_m} "
            "+step +inv +proj=cart +ellps=WGS84 "
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        lon, lat, height = Transformer.from_pipeline(pipeline).transform(enu_m[:, 0], enu_m[:, 1], enu_m[:, 2])
        return np.stack([lat, lon, height], -1)


def antenna_positions(world_from_rig: Floats) -> Floats:
    """Positions (n, 3) of the antenna in the world."""
    return se3.apply(world_from_rig, np.array([ANTENNA_IN_RIG_M]))[:, 0]


def receive(
    options: SynthOptions,
    world_from_rig: Floats,
    timestamps_us: Ints,
    rng: np.random.Generator,
    *,
    off_m: tuple[float, float] = (0.0, 0.0),
) -> Gnss:
    """Samples at the given poses (n, 4, 4) and instants (n,), with the errors that the options ask for.

    All positions are `off_m` to the east and north besides. The declared sigmas cover white noise, drift and bias
    together, but neither that, nor outliers, nor a clock's offset.
    """
    n = len(world_from_rig)
    axes = np.array([1.0, 1.0, VERTICAL_FACTOR])
    error = options.gnss_noise_m * rng.normal(size=(n, 3)) + options.gnss_bias_m * rng.normal(size=3)
    # A Gauss-Markov process, started in its stationary state.
    keep = np.exp(-1 / (options.rate_hz * _DRIFT_TIME_S))
    drift = rng.normal(size=3)
    for k in range(n):
        error[k] += options.gnss_drift_m * drift
        drift = keep * drift + np.sqrt(1 - keep**2) * rng.normal(size=3)
    error *= axes
    gross = rng.random(n) < options.gnss_outliers
    direction = rng.normal(size=(n, 3)) * [1.0, 1.0, 0.5]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    error += np.where(gross[:, None], direction * rng.uniform(5.0, 40.0, (n, 1)), 0.0)
    error[:, :2] += off_m
    place = Origin().geodetic(antenna_positions(world_from_rig) + error)
    sigma = max(0.01, float(np.hypot(np.hypot(options.gnss_noise_m, options.gnss_drift_m), options.gnss_bias_m)))
    offset_us = round(options.gnss_offset_s * 1e6)
    return Gnss(
        height_datum="ellipsoidal",
        antenna_in_rig_m=list(ANTENNA_IN_RIG_M),
        samples=[
            GnssSample(
                timestamp_us=int(t) + offset_us,
                latitude_deg=float(lat),
                longitude_deg=float(lon),
                height_m=float(height),
                sigma_horizontal_m=sigma,
                sigma_vertical_m=sigma * VERTICAL_FACTOR,
            )
            for t, (lat, lon, height) in zip(timestamps_us, place, strict=True)
        ],
    )
