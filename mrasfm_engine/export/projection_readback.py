"""Coordinates on the earth as PROJ has them, by another path than the writers', to compare written ones with."""

from __future__ import annotations

from functools import cache

import numpy as np
from pyproj import CRS, Transformer

from mrasfm_engine.geometry.earth_system import area_around
from mrasfm_engine.scene.scene import Georeference
from mrasfm_engine.types import Floats


def geodetic(place: Georeference, points_m: Floats) -> Floats:
    """Longitudes, latitudes and ellipsoidal heights (n, 3) of local points (n, 3)."""
    matrix = place.ecef_from_local
    return np.stack(_to_geodetic().transform(*(points_m @ matrix[:3, :3].T + matrix[:3, 3]).T), -1)


def projected(place: Georeference, points_m: Floats, system: CRS) -> Floats:
    """Local points (n, 3) in a system of coordinates, by the transformation that is best around the place.

    They go over geodetic coordinates: PROJ would put earth-centred ones on the system's ellipsoid, 0.1 mm off.
    """
    return np.stack(_to_system(system, *place.origin_deg).transform(*geodetic(place, points_m).T), -1)


@cache
def _to_geodetic() -> Transformer:
    return Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


@cache
def _to_system(system: CRS, latitude_deg: float, longitude_deg: float) -> Transformer:
    area = area_around(latitude_deg, longitude_deg)
    return Transformer.from_crs("EPSG:4979", system, always_xy=True, area_of_interest=area)  # type: ignore[arg-type]
