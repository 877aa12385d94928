"""`trajectory.gpkg`: the path and the positions of units and cameras as a GeoPackage 1.3, for geographic systems.

Every unit and image of the drive has a row; the geometry of what is not registered is NULL. Ids are the rows' numbers
from 1 on, which for images is their id in `model/`.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.geometry.earth_system import EarthSystem
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats

APPLICATION_ID, USER_VERSION = int.from_bytes(b"GPKG", "big"), 10300
WGS84, UNDEFINED_CARTESIAN, UNDEFINED_GEOGRAPHIC = 4326, -1, 0
TRAJECTORY, UNITS, CAMERAS = "trajectory", "unit_positions", "camera_positions"
POINT, LINE = "POINT", "LINESTRING"
# A drive's clock that begins later than any camera was on a car counts from 1970; another's times have no date.
FIRST_DATE_US, END_OF_DATES_US = 946_684_800_000_000, 253_402_300_799_000_000  # 2000 to 9999
NO_DATE = "1970-01-01T00:00:00.000Z"

TABLES = {
    "gpkg_spatial_ref_sys": "srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL, "
    "organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT",
    "gpkg_contents": "table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, "
    "description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')), "
    "min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id)",
    "gpkg_geometry_columns": "table_name TEXT NOT NULL UNIQUE REFERENCES gpkg_contents(table_name), "
    "column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, "
    "srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL, "
    "PRIMARY KEY (table_name, column_name)",
    TRAJECTORY: "fid INTEGER PRIMARY KEY NOT NULL, geom LINESTRING, scene TEXT, component INTEGER, units INTEGER",
    UNITS: "fid INTEGER PRIMARY KEY NOT NULL, geom POINT, scene TEXT, component INTEGER, source_frame INTEGER, "
    "timestamp_us INTEGER, time DATETIME, registered BOOLEAN, sigma_x_m DOUBLE, sigma_y_m DOUBLE, sigma_z_m DOUBLE",
    CAMERAS: "fid INTEGER PRIMARY KEY NOT NULL, geom POINT, scene TEXT, component INTEGER, unit INTEGER, camera TEXT, "
    "image TEXT, timestamp_us INTEGER, time DATETIME, registered BOOLEAN",
}
GEOMETRIES = {TRAJECTORY: LINE, UNITS: POINT, CAMERAS: POINT}
DESCRIPTIONS = {
    TRAJECTORY: "the rig's path; a line for each component",
    UNITS: "the rig's positions; sigmas along the local frame's axes",
    CAMERAS: "the cameras' positions",
}
HEIGHTS = "longitude, latitude; z is the height above the ellipsoid in metres"
LOCAL = "metres in the scene's local frame, which has no place on the earth"
ELLIPSOIDAL, IN_DATUM = (
    "z is the height above the ellipsoid in metres",
    "z is the height in the system's vertical datum",
)
OWN_SYSTEM = 100_000  # id of a system with a vertical datum, for which EPSG has no code of its own


def write_geopackage(scene: Scene, scene_of_unit: Sequence[str], path: Path, system: EarthSystem | None = None) -> str:
    """Write positions on WGS84; of a scene that is not georeferenced, in its local frame as an undefined system.

    The SHA-256 of the file's content is returned.

    Parameters
    ----------
    scene_of_unit
        Name of the scene of each unit; each has a line in `trajectory` for each of its components.
    system
        In place of WGS84, of a scene with a place on the earth.

    Raises
    ------
    OSError
        Where the file cannot be written.
    InputError
        Where a position has no coordinates in the system.
    """
    with closing(sqlite3.connect(":memory:")) as db:  # on disk at once: a full disk is an OSError
        db.executescript(
            f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {USER_VERSION};"
            + "".join(f"CREATE TABLE {name} ({columns});" for name, columns in TABLES.items())
        )
        with db:
            rig, cameras = (_positions(scene, poses, system) for poses in (scene.world_from_rig, scene.world_from_cam))
            content = (
                *_content_rows(scene, system, rig, cameras),
                *_feature_rows(scene, scene_of_unit, system, rig, cameras),
            )
            for table, rows in filter(itemgetter(1), content):
                db.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(rows[0]))})", rows)
        return write_content(path, db.serialize())


def _positions(scene: Scene, poses: Floats, system: EarthSystem | None) -> Floats:
    """Origins (n, 3) of poses (n, 4, 4) in the file's system: longitude, latitude and height, or local coordinates.

    Across the antimeridian longitudes go on beyond 180 deg, on the side of the scene's origin: lines and extents would
    reach around the earth.
    """
    if system is not None:
        return projected_positions(scene, poses, system)
    geodetic, place = geodetic_positions(scene, poses), scene.georeference
    if geodetic is None or place is None:
        return poses[:, :3, 3]
    places: Floats = geodetic[:, [1, 0, 2]]
    places[:, 0] -= 360.0 * np.rint((places[:, 0] - place.origin_longitude_deg) / 360.0)
    return places


def projected_positions(scene: Scene, poses: Floats, system: EarthSystem) -> Floats:
    """Origins (n, 3) of poses (n, 4, 4) in a system of coordinates; NaN where a pose is."""
    assert scene.georeference is not None
    places = np.full((len(poses), 3), np.nan)
    known = np.isfinite(poses[:, :3, 3]).all(axis=1)
    if known.any():
        places[known] = system.projected(poses[known, :3, 3], scene.georeference.ecef_from_local)
    return places


def _date(timestamp_us: int) -> str | None:
    """UTC with exactly three decimals, as GeoPackage wants it; None where the clock does not count from 1970."""
    if not FIRST_DATE_US <= timestamp_us < END_OF_DATES_US:
        return None
    return f"{np.datetime64((timestamp_us + 500) // 1000, 'ms')}Z"


def _content_rows(
    scene: Scene, system: EarthSystem | None, rig: Floats, cameras: Floats
) -> Iterator[tuple[str, list[tuple[Any, ...]]]]:
    """Rows of the tables that describe the others, by table; positions (n, 3) are in the file's system."""
    srs = _srs_id(scene, system)
    yield (
        "gpkg_spatial_ref_sys",
        [
            ("WGS 84", WGS84, "EPSG", WGS84, CRS.from_epsg(WGS84).to_wkt("WKT1_GDAL"), HEIGHTS),
            ("Undefined Cartesian", UNDEFINED_CARTESIAN, "NONE", UNDEFINED_CARTESIAN, "undefined", LOCAL),
            ("Undefined geographic", UNDEFINED_GEOGRAPHIC, "NONE", UNDEFINED_GEOGRAPHIC, "undefined", None),
            *([] if system is None else [_system_row(system)]),
        ],
    )
    # No time of writing: the same scene is the same file.
    last_change = _date(int(scene.drive.timestamps_us.max())) or NO_DATE
    yield (
        "gpkg_contents",
        [
            (table, "features", table, DESCRIPTIONS[table], last_change, *_extent(places), srs)
            for table, places in ((TRAJECTORY, rig), (UNITS, rig), (CAMERAS, cameras))
        ],
    )
    yield "gpkg_geometry_columns", [(table, "geom", kind, srs, 1, 0) for table, kind in GEOMETRIES.items()]


def _system_row(system: EarthSystem) -> tuple[Any, ...]:
    if system.has_vertical:
        name = CRS.from_wkt(system.well_known_text).name
        return name, OWN_SYSTEM, "NONE", OWN_SYSTEM, system.well_known_text, IN_DATUM
    horizontal = CRS.from_epsg(system.horizontal)
    text, code = horizontal.to_wkt("WKT1_GDAL"), system.horizontal
    return horizontal.name, code, "EPSG", code, text, ELLIPSOIDAL


def _feature_rows(
    scene: Scene, scene_of_unit: Sequence[str], system: EarthSystem | None, rig: Floats, cameras: Floats
) -> Iterator[tuple[str, list[tuple[Any, ...]]]]:
    """Rows of the tables with geometries, by table."""
    srs, drive, component = _srs_id(scene, system), scene.drive, scene.unit_component.tolist()
    lines: list[tuple[Any, ...]] = []
    # No line leads from one component to another: nothing links them.
    for name, number in dict.fromkeys(zip(scene_of_unit, component, strict=True)):
        own = [pair == (name, number) for pair in zip(scene_of_unit, component, strict=True)]
        units = np.flatnonzero(scene.unit_registered & np.array(own))
        units = units[np.argsort(drive.timestamps_us[units], kind="stable")]
        if len(units) > 1:
            lines.append((len(lines) + 1, _line(rig[units], srs), name, number, len(units)))
    yield TRAJECTORY, lines
    yield (
        UNITS,
        [
            (
                *(u + 1, _point(rig[u], srs), scene_of_unit[u], component[u], frame.source_frame),
                *(frame.timestamp_us, _date(frame.timestamp_us), bool(scene.unit_registered[u])),
                *_known(scene.sigma_position_m[u]),
            )
            for u, frame in enumerate(drive.manifest.frames)
        ],
    )
    yield (
        CAMERAS,
        [
            (
                *(i + 1, _point(cameras[i], srs), scene_of_unit[image.unit], component[image.unit], image.unit + 1),
                *(drive.cameras[image.camera].name, image.file, image.timestamp_us, _date(image.timestamp_us)),
                bool(scene.image_registered[i]),
            )
            for i, image in enumerate(drive.images)
        ],
    )


def _srs_id(scene: Scene, system: EarthSystem | None) -> int:
    """Id of the file's spatial reference system."""
    if system is not None:
        return OWN_SYSTEM if system.has_vertical else system.horizontal
    return UNDEFINED_CARTESIAN if scene.georeference is None else WGS84


def _extent(places: Floats) -> list[float | None]:
    known = places[np.isfinite(places).all(axis=1), :2]
    return [*known.min(axis=0).tolist(), *known.max(axis=0).tolist()] if len(known) else [None] * 4


def _known(sigma_m: Floats) -> list[float | None]:
    return sigma_m.tolist() if np.isfinite(sigma_m).all() else [None] * 3


def _point(place: Floats, srs: int) -> bytes | None:
    """A point of three axes; None where there is none."""
    if not np.isfinite(place).all():
        return None
    return struct.pack("<2sBBiBI3d", b"GP", 0, 1, srs, 1, 1001, *place.tolist())


def _line(places: Floats, srs: int) -> bytes:
    """A line of three axes, with its envelope in front."""
    envelope = np.stack([places.min(axis=0), places.max(axis=0)], -1).ravel().tolist()
    head = struct.pack("<2sBBi6d", b"GP", 0, 1 | 2 << 1, srs, *envelope)
    return head + struct.pack("<BII", 1, 1002, len(places)) + places.astype("<f8").tobytes()
