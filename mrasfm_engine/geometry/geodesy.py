"""Geodetic, earth-centred and local east-north-up coordinates.

Geodetic coordinates are arrays (..., 3) of latitude (deg), longitude (deg) and ellipsoidal height (m) on WGS84
(EPSG:4979); earth-centred ones (ECEF, EPSG:4978) and local ones (x east, y north, z up) are metres. The arguments are
always latitude first, whatever order a projection library prefers.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer
from pyproj.exceptions import ProjError

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

# Nothing that drives is farther from the earth's centre than this; the deepest mine is not nearer than half of it.
MAX_RADIUS_M = 7.0e6
MIN_RADIUS_M = 6.0e6


def ecef_from_geodetic(geodetic: ArrayLike) -> Floats:
    """Earth-centred coordinates (..., 3) of geodetic ones (..., 3).

    Raises
    ------
    ValueError
        Where a coordinate is not finite, or a latitude or longitude is outside its range (are they swapped?).
    """
    g = _checked(geodetic)
    x, y, z = _ecef().transform(g[..., 1], g[..., 0], g[..., 2])
    return np.stack([x, y, z], -1)


def geodetic_from_ecef(points_ecef: ArrayLike) -> Floats:
    """Geodetic coordinates (..., 3) of earth-centred ones (..., 3).

    Raises
    ------
    ValueError
        Where a point is not finite or not near the earth's surface.
    """
    p = np.asarray(points_ecef, dtype=np.float64)
    radius = np.linalg.norm(p, axis=-1)
    if not np.all((radius > MIN_RADIUS_M) & (radius < MAX_RADIUS_M)):
        raise ValueError("earth-centred points must be finite and near the earth's surface")
    longitude, latitude, height = _ecef().transform(p[..., 0], p[..., 1], p[..., 2], direction="INVERSE")
    return np.stack([latitude, longitude, height], -1)


def ecef_from_local(origin_geodetic: ArrayLike) -> Floats:
    """The transform (4, 4) of the east-north-up frame at a geodetic origin (3,)."""
    origin = _checked(origin_geodetic)
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return se3.transform(np.array([east, north, up]).T, ecef_from_geodetic(origin))


def local_from_geodetic(geodetic: ArrayLike, ecef_from_local: ArrayLike) -> Floats:
    """Local coordinates (..., 3) of geodetic ones (..., 3) in the frame with the given transform (4, 4)."""
    m = np.asarray(ecef_from_local, dtype=np.float64)
    # The difference first: a product with 6.4e6 m would cost precision.
    result: Floats = (ecef_from_geodetic(geodetic) - m[:3, 3]) @ m[:3, :3]
    return result


def geodetic_from_local(points_local: ArrayLike, ecef_from_local: ArrayLike) -> Floats:
    """Geodetic coordinates (..., 3) of local ones (..., 3) in the frame with the given transform (4, 4)."""
    m = np.asarray(ecef_from_local, dtype=np.float64)
    return geodetic_from_ecef(np.asarray(points_local, dtype=np.float64) @ m[:3, :3].T + m[:3, 3])


def ellipsoidal_from_datum(geodetic: ArrayLike, height_datum: str) -> Floats:
    """Geodetic coordinates (..., 3) whose heights count from `height_datum`, with ellipsoidal heights instead.

    Parameters
    ----------
    geodetic
        Latitude, longitude and height above the datum.
    height_datum
        `ellipsoidal`, or a vertical reference system as `EPSG:5773`.

    Raises
    ------
    InputError
        Where the datum is unknown or the geoid grid that it needs is not installed: never a silent zero.
    """
    g = _checked(geodetic)
    if height_datum == "ellipsoidal":
        return g
    remedy = (
        "Give ellipsoidal heights and the height datum 'ellipsoidal', or install PROJ's grid of this datum "
        "(projsync, or the folder named by PROJ_DATA)."
    )
    try:
        transformer = Transformer.from_crs(
            f"EPSG:4326+{height_datum.removeprefix('EPSG:')}", "EPSG:4979", always_xy=True, only_best=True
        )
        if "ballpark" in transformer.description.lower():
            raise InputError(f"heights in {height_datum} cannot be converted without its grid", remedy=remedy)
        longitude, latitude, height = transformer.transform(g[..., 1], g[..., 0], g[..., 2], errcheck=True)
    except ProjError as error:
        raise InputError(f"heights in {height_datum} cannot be converted: {error}", remedy=remedy) from error
    result = np.stack([latitude, longitude, height], -1)
    if not np.isfinite(result).all():
        raise InputError(f"heights in {height_datum} cannot be converted at these places", remedy=remedy)
    return result


@cache
def _ecef() -> Transformer:
    return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def _checked(geodetic: ArrayLike) -> Floats:
    g = np.asarray(geodetic, dtype=np.float64)
    if g.shape[-1:] != (3,):
        raise ValueError(f"geodetic coordinates must be (..., 3): latitude, longitude, height; got {g.shape}")
    if not np.isfinite(g).all():
        raise ValueError("geodetic coordinates must be finite")
    if np.any(np.abs(g[..., 0]) > 90) or np.any(np.abs(g[..., 1]) > 180):
        raise ValueError("latitude must be in -90..90 and longitude in -180..180 deg, in this order")
    return g
