"""Names of projected coordinate reference systems, as `EPSG:25832` or, with a vertical datum, `EPSG:25832+7837`.

A name is judged here without a scene: the service refuses a wrong one at once, the engine before it reads.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from pyproj import CRS
from pyproj.exceptions import CRSError

REMEDY = "Give a projected system, as EPSG:25832, if need be with a vertical datum, as EPSG:25832+7837."
_NAMED = re.compile(r"EPSG:([0-9]{4,6})(?:\+([0-9]{4,6}))?")


class EarthSystemError(ValueError):
    """A name is not that of a projected system; the message says why, `REMEDY` what to do."""


@dataclass(frozen=True)
class NamedSystem:
    """The parts of a system.

    Attributes
    ----------
    code
        EPSG's, of the system without heights.
    vertical
        None where heights are above the ellipsoid.
    """

    code: int
    horizontal: CRS
    vertical: CRS | None


def parse_system(name: str) -> NamedSystem:
    """The parts of the system that a user names.

    Raises
    ------
    EarthSystemError
        Where there is none of this name, or it is not a projected one.
    """
    match = _NAMED.fullmatch(name)
    if match is None:
        raise EarthSystemError(f"{name!r} names no coordinate reference system")
    horizontal = _known(name, match[1])
    vertical = None if match[2] is None else _known(name, match[2])
    if not horizontal.is_projected or horizontal.is_compound or len(horizontal.axis_info) != 2:
        raise EarthSystemError(f"EPSG:{match[1]} ({horizontal.name}) is no projected system of two axes")
    if vertical is not None and (not vertical.is_vertical or vertical.is_compound):
        raise EarthSystemError(f"EPSG:{match[2]} ({vertical.name}) is no vertical datum")
    return NamedSystem(int(match[1]), horizontal, vertical)


def _known(name: str, code: str) -> CRS:
    try:
        return CRS.from_epsg(int(code))
    except CRSError:
        raise EarthSystemError(f"EPSG:{code} of {name!r} is not known") from None
