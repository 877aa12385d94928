"""Ellipsoidal heights of GNSS samples, whatever their heights count from."""

from __future__ import annotations

import warnings

import numpy as np
import pyproj
import pyproj.datadir
import pyproj.network
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry.geodesy import ellipsoidal_from_datum
from mrasfm_engine.types import Floats
from schemas import Gnss
from schemas.findings import listed


def ellipsoidal_heights(gnss: Gnss) -> Floats:
    """Heights (samples,) above WGS84's ellipsoid, metres.

    Grids are looked up on this machine only, never over the network; a conversion without its grid is refused, not
    taken for zero.

    Raises
    ------
    InputError
        If the height datum is unknown, is not a vertical one, or needs a geoid grid that is not installed.
    """
    geodetic = np.array([(s.latitude_deg, s.longitude_deg, s.height_m) for s in gnss.samples]).reshape(-1, 3)
    if gnss.height_datum == "ellipsoidal" or len(geodetic) == 0:
        return geodetic[:, 2]
    code = gnss.height_datum.removeprefix("EPSG:")
    _require_vertical(code)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missing grids, which become an error here
        # pyproj documents these functions but re-exports them from its private modules.
        networked = pyproj.network.is_network_enabled()  # type: ignore[attr-defined]
        pyproj.network.set_network_enabled(False)  # type: ignore[attr-defined]
        try:
            heights: Floats = ellipsoidal_from_datum(geodetic, gnss.height_datum)[:, 2]
        except InputError as error:
            raise _without_grid(code, geodetic, error) from None
        finally:
            pyproj.network.set_network_enabled(networked)  # type: ignore[attr-defined]
    return heights


def _require_vertical(code: str) -> None:
    remedy = "Give the EPSG code of a vertical datum, such as EPSG:5773 (EGM96), or 'ellipsoidal'."
    try:
        crs = pyproj.CRS.from_epsg(int(code))
    except CRSError:
        raise InputError(f"gnss.height_datum EPSG:{code} is not known", remedy=remedy, code="height-datum") from None
    if not crs.is_vertical or crs.is_compound:
        raise InputError(
            f"gnss.height_datum EPSG:{code} ({crs.name}) is not a vertical datum", remedy=remedy, code="height-datum"
        )


def _without_grid(code: str, geodetic: Floats, error: InputError) -> InputError:
    south, west = geodetic[:, :2].min(0)
    north, east = geodetic[:, :2].max(0)
    name = pyproj.CRS.from_epsg(int(code)).name
    grid_folder = pyproj.datadir.get_user_data_dir()  # type: ignore[attr-defined]
    try:
        group = TransformerGroup(
            f"EPSG:4326+{code}",
            "EPSG:4979",
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=AreaOfInterest(west, south, east, north),  # type: ignore[arg-type]
        )
        options = [[grid.short_name for grid in op.grids] for op in group.unavailable_operations]
    except ProjError:
        options = []
    grids = min((names for names in options if names), key=len, default=[])
    if not grids:
        return InputError(
            f"gnss heights above {name} (EPSG:{code}) cannot be converted at these places: {error.what}",
            remedy="Check that the drive lies in the datum's area, or give ellipsoidal heights.",
            code="height-datum",
        )
    return InputError(
        f"gnss heights above {name} (EPSG:{code}) need the geoid grid {listed(grids)}, which is not installed",
        remedy=f"Install it (projsync --file {grids[0]}, or copy it from https://cdn.proj.org into {grid_folder}), or "
        "give ellipsoidal heights.",
        code="missing-geoid-grid",
    )
