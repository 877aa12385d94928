"""Positions and times of images: EXIF's, and OpenDroneMap's `geo.txt`.

Source: EXIF 3.0 (CIPA DC-008), and OpenDroneMap's documentation of its image geolocation file: the first line names a
coordinate reference system, the others have an image, x, y, optionally z, three angles and two accuracies.
"""

from __future__ import annotations

import datetime
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import utm
from mrasfm_engine.geometry.earth_system import best_transformer, is_near
from mrasfm_engine.importers.tables import read_lines

EXIF, GPS = 0x8769, 0x8825
TIME, SUBSECOND, OFFSET = 0x9003, 0x9291, 0x9011  # of EXIF: DateTimeOriginal and what belongs to it
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE, ERROR = 1, 2, 3, 4, 5, 6, 31
HORIZONTAL, VERTICAL = 6, 7  # columns of geo.txt after the image: x, y, z, three angles, two accuracies
BELOW = (1, 3)  # of the altitude's reference: below the sea, below the ellipsoid
_UTM = re.compile(r"WGS84\s+UTM\s+([0-9]{1,2})\s*([NS])", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class GeoTag:
    """Position of an image on WGS84."""

    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    sigma_horizontal_m: float | None
    sigma_vertical_m: float | None


def read_exif(path: Path) -> tuple[int | None, GeoTag | None]:
    """Time in microseconds since 1970 and position of an image, where its EXIF has them.

    A time without an offset is taken as UTC.

    Raises
    ------
    InputError
        If the file is no image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            times, gps = exif.get_ifd(EXIF), exif.get_ifd(GPS)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        said = " ".join(str(error).split())[:200]
        raise InputError(f"image {path}: {said}", remedy="Copy it again from its source.") from None
    return _time_us(times), _position(gps)


def _time_us(exif: dict[int, Any]) -> int | None:
    text = f"{exif.get(TIME, '')}".strip("\0 ")
    subsecond, offset = f"{exif.get(SUBSECOND, '')}".strip("\0 "), f"{exif.get(OFFSET, '')}".strip("\0 ")
    try:
        moment = datetime.datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=datetime.UTC)
        if match := re.fullmatch(r"([+-])([0-9]{2}):([0-9]{2})", offset):
            minutes = int(match[2]) * 60 + int(match[3])
            moment -= datetime.timedelta(minutes=minutes if match[1] == "+" else -minutes)
        fraction = float(f"0.{subsecond}") if re.fullmatch("[0-9]{1,9}", subsecond) else 0.0
        return round(moment.timestamp()) * 1_000_000 + round(fraction * 1e6)
    except (ValueError, OverflowError):
        return None


def _position(gps: dict[int, Any]) -> GeoTag | None:
    try:
        latitude = _degrees(gps[LATITUDE]) * _sign(gps[LATITUDE_REF], "NS")
        longitude = _degrees(gps[LONGITUDE]) * _sign(gps[LONGITUDE_REF], "EW")
        height = (
            float(gps[ALTITUDE]) * (-1 if _byte(gps.get(ALTITUDE_REF)) in BELOW else 1) if ALTITUDE in gps else None
        )
        error = float(gps[ERROR]) if ERROR in gps else None
    except (KeyError, TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    if not all(math.isfinite(value) for value in (latitude, longitude, height or 0.0, error or 0.0)):
        return None
    sigma_m = error if error is not None and error > 0 else None
    return GeoTag(
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        sigma_horizontal_m=sigma_m,
        sigma_vertical_m=None,
    )


def _degrees(value: Any) -> float:
    degrees, minutes, seconds = (float(part) for part in value)
    return degrees + minutes / 60 + seconds / 3600


def _sign(reference: Any, letters: str) -> int:
    """1 or -1 by the hemisphere's letter; a position without one may be on another continent, and is none."""
    text = reference.decode("ascii", "replace") if isinstance(reference, bytes) else f"{reference}"
    letter = text.strip("\0 ").upper()[:1]
    if not letter:
        raise ValueError("no hemisphere")
    return (1, -1)[letters.index(letter)]


def _byte(value: Any) -> int:
    return value[0] if isinstance(value, bytes) and value else int(value or 0)


def read_geo_txt(path: Path) -> dict[str, GeoTag]:
    """Positions by the image as the file names it.

    Heights stay as they are: what they count from is up to whoever wrote the file.

    Raises
    ------
    InputError
        That names the line at fault.
    """
    lines = read_lines(path, what="image positions")
    rows: dict[str, list[float]] = {}
    numbers: list[int] = []  # of the rows' lines
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words:
            continue
        values = _numbers(words[1:10], f"image positions {path}, line {number}")
        if words[0] in rows:
            raise InputError(
                f"image positions {path}, line {number}: {words[0]} has two lines", remedy="Keep one.", code="bad-table"
            )
        rows[words[0]] = values
        numbers.append(number)
    if not rows:
        raise InputError(f"image positions {path} has no rows", remedy="Remove the file, or fill it.", code="bad-table")
    places = _geodetic(lines[0].strip(), np.array([values[:2] for values in rows.values()]), path, numbers)
    return {
        name: GeoTag(
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            height_m=values[2] if len(values) > 2 else None,
            sigma_horizontal_m=_accuracy(values, HORIZONTAL),
            sigma_vertical_m=_accuracy(values, VERTICAL),
        )
        for (name, values), (longitude, latitude) in zip(rows.items(), places, strict=True)
    }


def _transformer(system: Any, points: Any, name: str) -> Any:
    """The best transformation to WGS84 where the points are; another one may be metres off without a word."""
    import pyproj

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missing grids, which become an error below
        rough = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
        longitude, latitude = rough.transform(float(np.median(points[:, 0])), float(np.median(points[:, 1])))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return rough  # whose results are refused
    return best_transformer(system, pyproj.CRS.from_epsg(4326), at=(latitude, longitude), name=name)


def _accuracy(values: list[float], column: int) -> float | None:
    return values[column] if len(values) > column and values[column] > 0 else None


def _numbers(words: list[str], where: str) -> list[float]:
    values: list[float] = []
    for word in words[:8]:
        try:
            value = float(word)
        except ValueError:
            break  # labels may follow
        if not math.isfinite(value):
            break
        values.append(value)
    if len(values) < 2:
        raise InputError(
            f"{where}: has no two coordinates after the image's name",
            remedy="Give lines as IMAGE X Y Z.",
            code="bad-table",
        )
    return values


def _geodetic(system: str, points: Any, path: Path, numbers: Sequence[int]) -> Any:
    """Longitudes and latitudes (n, 2) on WGS84 of coordinates x, y (n, 2) in a system, on lines of these numbers."""
    from pyproj.exceptions import CRSError, ProjError

    where = f"image positions {path}, line"
    try:
        crs = _horizontal_system(system, f"{where} 1")
        known = _with_area(crs)
        _require_no_degrees(known, points, f"{where} {numbers[0]}")
        to_wgs84 = _transformer(crs, points, system)
        found = np.stack(to_wgs84.transform(points[:, 0], points[:, 1], errcheck=True), -1)
    except (CRSError, ProjError) as error:
        said = " ".join(str(error).split())[:150]
        remedy = "Give EPSG:4326, another EPSG code, a PROJ string or WGS84 UTM 32N in the first line."
        raise InputError(f"{where} 1: {system[:80]!r}: {said}", remedy=remedy, code="bad-table") from None
    for number, (longitude, latitude) in zip(numbers, found.tolist(), strict=True):
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):  # also refuses NaN
            raise InputError(
                f"{where} {number}: coordinates are outside of {system[:80]!r}: are x and y swapped?",
                remedy="Give x (east, longitude) before y.",
                code="bad-table",
            )
        if not is_near(known, (latitude, longitude)):
            at = f"{latitude:.3f}, {longitude:.3f}"
            raise InputError(
                f"{where} {number}: lies at {at}, far outside of the area of {system[:80]!r}",
                remedy="Give in the first line the system that the coordinates are in, and x (east) before y.",
                code="outside-crs",
            )
    return found


def _horizontal_system(system: str, where: str) -> Any:
    """The system that the first line names."""
    import pyproj

    if (match := _UTM.fullmatch(system)) and 1 <= int(match[1]) <= utm.ZONES:
        system = f"EPSG:{(32600 if match[2].upper() == 'N' else 32700) + int(match[1])}"
    crs = pyproj.CRS.from_user_input(system)
    if crs.is_compound or crs.is_vertical:
        raise InputError(
            f"{where}: {system[:80]!r} has heights of its own, and those of the lines are taken as metres above the "
            "ellipsoid",
            remedy="Give the horizontal system alone, and ellipsoidal heights in metres.",
            code="bad-table",
        )
    return crs.to_2d()


def _with_area(crs: Any) -> Any:
    """The system, or for one without an area, as a PROJ string's, the one of EPSG that is most like it, if any is."""
    import pyproj

    code = crs.to_epsg() if crs.area_of_use is None else None
    return crs if code is None else pyproj.CRS.from_epsg(code)


def _require_no_degrees(crs: Any, points: Any, where: str) -> None:
    """Refuse metres that are degrees: all of them within 180 m of the system's origin, where hardly a road is.

    The place may be near the system's area, as that of UTM's origin is, or in it. A system of the user's own, which has
    no area, may have its origin on the road.
    """
    if crs.is_projected and crs.area_of_use is not None and (np.abs(points) <= (180.0, 90.0)).all():
        raise InputError(
            f"{where}: {points[0, 0]:g}, {points[0, 1]:g} and all others look like degrees, and the first line names a "
            "system of metres",
            remedy="Give EPSG:4326 in the first line for longitude and latitude, or coordinates of the named system.",
            code="outside-crs",
        )
