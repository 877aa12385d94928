"""Projected coordinate reference systems that users name, as `EPSG:25832` or, with a vertical datum, `EPSG:25832+7837`.

A system without a vertical datum has heights above the ellipsoid. Transformations whose grids are not installed are
refused with the grid's name: PROJ would take another one, metres off, without a word. Nothing is fetched over the
network.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import geodesy, utm
from mrasfm_engine.types import Floats
from schemas.earth_systems import REMEDY, EarthSystemError, NamedSystem, parse_system
from schemas.findings import listed

_SOURCE = "EPSG:4979"
_NEAR_DEG = 6.0  # of a system's area
_SCENE_DEG = 0.05  # that a scene's area reaches from its origin: some kilometres


@dataclass(frozen=True, kw_only=True)
class EarthSystem:
    """A coordinate reference system of points on the earth.

    Attributes
    ----------
    well_known_text
        WKT 1 (OGC 01-009), with a system of heights.
    horizontal
        EPSG code of the system without heights.
    has_vertical
        Whether heights are in a vertical datum, not above the ellipsoid.
    code
        UTM's zone where the scene's own is meant, else None.
    """

    name: str
    well_known_text: str
    horizontal: int
    has_vertical: bool = False
    code: int | None = None
    transformer: Transformer | None = None

    def projected(self, points_local: Floats, ecef_from_local: Floats) -> Floats:
        """Easting, northing and height (n, 3), in the system's units, of local points (n, 3).

        Raises
        ------
        InputError
            Where a point has none.
        """
        if self.code is not None:
            return utm.utm_from_local(points_local, ecef_from_local, self.code)
        assert self.transformer is not None
        geodetic = geodesy.geodetic_from_local(points_local, ecef_from_local)
        try:
            xyz = self.transformer.transform(geodetic[..., 1], geodetic[..., 0], geodetic[..., 2], errcheck=True)
        except ProjError as error:
            raise self._outside(str(error)) from error
        result = np.stack(xyz, -1)
        if not np.isfinite(result).all():
            raise self._outside("points have no coordinates in it")
        return result

    def notes(self) -> list[str]:
        """Words on how good the transformation from WGS84 is, where it is not exact."""
        accuracy_m = None if self.transformer is None else self.transformer.accuracy
        if not accuracy_m or accuracy_m < 0.0:
            return []
        return [f"the transformation from WGS84 to {self.name} has an accuracy of {accuracy_m:g} m, as EPSG states it"]

    def _outside(self, why: str) -> InputError:
        return InputError(
            f"the scene cannot be given in {self.name}: {why}",
            remedy="Give a system whose area the scene lies in.",
            code="outside-crs",
        )


def utm_system(latitude_deg: float, longitude_deg: float) -> EarthSystem:
    """The UTM zone of a place, with ellipsoidal heights."""
    code = utm.epsg_code(latitude_deg, longitude_deg)
    return EarthSystem(name=f"EPSG:{code}", well_known_text=utm.well_known_text(code), horizontal=code, code=code)


def system_of_name(name: str) -> NamedSystem:
    """The parts of the system that a user names, wherever the scene is.

    Raises
    ------
    InputError
        Where there is none of this name, or it is not a projected one.
    """
    try:
        return parse_system(name)
    except EarthSystemError as error:
        raise InputError(str(error), remedy=REMEDY, code="bad-crs") from None


def named_system(name: str, *, at: tuple[float, float]) -> EarthSystem:
    """The system that a user names.

    Parameters
    ----------
    at
        Latitude and longitude of the scene's origin.

    Raises
    ------
    InputError
        Where there is none of this name, it is not a projected one, the scene is far from its area, or its grid is not
        installed.
    """
    named = system_of_name(name)
    horizontal, vertical = named.horizontal, named.vertical
    _require_near(name, horizontal, at)
    target = horizontal.to_3d() if vertical is None else CRS.from_user_input(name)
    text = utm.with_ellipsoidal_heights(horizontal) if vertical is None else target.to_wkt("WKT1_GDAL")
    return EarthSystem(
        name=name,
        well_known_text=text,
        horizontal=named.code,
        has_vertical=vertical is not None,
        transformer=best_transformer(CRS.from_user_input(_SOURCE), target, at=at, name=name),
    )


def _require_near(name: str, system: CRS, at: tuple[float, float]) -> None:
    if not is_near(system, at):
        assert system.area_of_use is not None, "one without an area is near everywhere"
        raise InputError(
            f"{name} is for {system.area_of_use.name}, and the scene lies at {at[0]:.3f}, {at[1]:.3f}",
            remedy="Give a system whose area the scene lies in.",
            code="outside-crs",
        )


def is_near(system: CRS, at: tuple[float, float]) -> bool:
    """Return whether a place, latitude and longitude, is in a system's area or not far from it, if it has one.

    Elsewhere a projection gives numbers that mean nothing. The next zone is often used on purpose.
    """
    area = system.area_of_use
    if area is None:
        return True
    south, north = area.south - _NEAR_DEG, area.north + _NEAR_DEG
    east_of_west = (at[1] - area.west + _NEAR_DEG) % 360.0
    width = (area.east - area.west) % 360.0 or 360.0
    return south <= at[0] <= north and east_of_west <= width + 2.0 * _NEAR_DEG


def area_around(latitude_deg: float, longitude_deg: float) -> AreaOfInterest:
    """The area that a transformation must be good in: old datums have one for each country, metres apart elsewhere."""
    south, north = max(latitude_deg - _SCENE_DEG, -90.0), min(latitude_deg + _SCENE_DEG, 90.0)
    west, east = (((longitude_deg + side * _SCENE_DEG + 180.0) % 360.0) - 180.0 for side in (-1, 1))
    return AreaOfInterest(west, south, east, north)


def best_transformer(source: CRS, target: CRS, *, at: tuple[float, float], name: str) -> Transformer:
    """The best transformation that is known around a place, and no other.

    Parameters
    ----------
    at
        Latitude and longitude.
    name
        What messages call the system that is not WGS84.

    Raises
    ------
    InputError
        Where its grid is not installed, or none is known.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missing grids, which become an error here
        group = TransformerGroup(
            source,
            target,
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=area_around(*at),  # type: ignore[arg-type]
        )
    if not group.best_available:
        grids = [grid.short_name for operation in group.unavailable_operations for grid in operation.grids]
        named = listed(list(dict.fromkeys(grids))[:3]) or "a grid"
        raise InputError(
            f"{name} needs {named}, which is not installed",
            remedy="Install it (projsync --file NAME, or the folder named by PROJ_DATA), or give another system; "
            "without a vertical datum heights are above the ellipsoid.",
            code="missing-geoid-grid",
        )
    if not group.transformers:
        raise InputError(
            f"no transformation from WGS84 to {name} is known where the scene lies", remedy=REMEDY, code="bad-crs"
        )
    return group.transformers[0]
