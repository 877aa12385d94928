"""Universal Transverse Mercator: the projected coordinates that geographic information systems work in.

Coordinates are arrays (..., 3) of easting, northing and height above the WGS84 ellipsoid, in metres.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Proj

from mrasfm_engine.geometry import geodesy
from mrasfm_engine.types import Floats

NORTH, SOUTH = 32600, 32700  # EPSG codes of the zones on WGS84, less their number
ZONES = 60

_ELLIPSOIDAL_HEIGHT = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


def epsg_code(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the zone that a place is in; the exceptions of Norway and Svalbard are not made."""
    zone = int((longitude_deg + 180.0) // 6.0) % ZONES + 1
    return (NORTH if latitude_deg >= 0 else SOUTH) + zone


def utm_from_local(points_local: ArrayLike, ecef_from_local: ArrayLike, code: int) -> Floats:
    """Coordinates in the zone `code` of local ones (n, 3) in the frame with the given transform (4, 4)."""
    geodetic = geodesy.geodetic_from_local(points_local, ecef_from_local)
    easting, northing = _projection(code)(geodetic[..., 1], geodetic[..., 0])
    return np.stack([easting, northing, geodetic[..., 2]], -1)


def well_known_text(code: int) -> str:
    """The zone with ellipsoidal heights as WKT 1 (OGC 01-009), which LAS asks for.

    A projected system of three axes has no such form: it is the system of two axes beside one of heights.
    """
    return with_ellipsoidal_heights(CRS.from_epsg(code))


def with_ellipsoidal_heights(system: CRS) -> str:
    """A projected system of two axes beside one of ellipsoidal heights in metres, as WKT 1."""
    return f'COMPD_CS["{system.name} + Ellipsoid (metre)",{system.to_wkt("WKT1_GDAL")},{_ELLIPSOIDAL_HEIGHT}]'


@cache
def _projection(code: int) -> Proj:
    is_south = code > SOUTH
    return Proj(proj="utm", zone=code - (SOUTH if is_south else NORTH), south=is_south, ellps="WGS84")
