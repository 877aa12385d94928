"""Comparison of `trajectory.gpkg` with the scene, for the check before it is put in place."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.geopackage import DESCRIPTIONS, ELLIPSOIDAL, HEIGHTS, IN_DATUM, LOCAL, TABLES
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.export.projection_readback import projected
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints

PROJECTED_TOLERANCE = 1e-5  # of a system's unit; numbers of millions have nine more digits
Select = Callable[[str], list[tuple[Any, ...]]]

_POINT = np.dtype(
    [("magic", "S2"), ("version", "u1"), ("flags", "u1"), ("srs", "<i4"), ("order", "u1"), ("kind", "<u4"),
     ("place", "<f8", 3)]
)  # fmt: skip
_LINE = np.dtype(
    [("magic", "S2"), ("version", "u1"), ("flags", "u1"), ("srs", "<i4"), ("envelope", "<f8", (3, 2)), ("order", "u1"),
     ("kind", "<u4"), ("count", "<u4")]
)  # fmt: skip


def read_geopackage(path: Path) -> Select:
    """A function from SQL to all rows."""

    def select(sql: str) -> list[tuple[Any, ...]]:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as db:
            return db.execute(sql).fetchall()

    return select


def geopackage(scene: Scene, scene_of_unit: Sequence[str], select: Select, *, crs: str | None = None) -> Rows:
    """The tables as the standard wants them, and every attribute and coordinate.

    Parameters
    ----------
    crs
        Name of the system of coordinates, as `EPSG:25832` or `EPSG:25832+7837`, where it is not WGS84.
    """
    yield Row("its application id", select("PRAGMA application_id"), [(0x47504B47,)])
    yield Row("its version", select("PRAGMA user_version"), [(10300,)])
    yield Row("its integrity", select("PRAGMA integrity_check"), [("ok",)])
    tables: dict[str, str] = dict(
        select("SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%'")
    )
    yield Row("its tables", tables, {name: f"CREATE TABLE {name} ({columns})" for name, columns in TABLES.items()})
    system = None if crs is None else _named(crs)
    srs = _srs(scene) if system is None else system[1]
    rig, cameras = (_places(scene, poses, system) for poses in (scene.world_from_rig, scene.world_from_cam))
    tolerance = None if system is None else PROJECTED_TOLERANCE
    yield from _contents(scene, select, srs=srs, system=system, rig=rig, cameras=cameras, tolerance=tolerance)
    for table, places, attributes in (
        ("unit_positions", rig, list(_units(scene, scene_of_unit))),
        ("camera_positions", cameras, list(_images(scene, scene_of_unit))),
    ):
        rows = select(f"SELECT * FROM {table} ORDER BY fid")
        yield Row(f"the rows of {table}", [(row[0], *row[2:]) for row in rows], attributes)
        yield from _points(srs, table, [row[1] for row in rows], places, tolerance)
    lines = select("SELECT * FROM trajectory ORDER BY fid")
    yield from _lines(scene, scene_of_unit, lines, rig, srs=srs, tolerance=tolerance)


def _named(crs: str) -> tuple[Any, ...]:
    """The row of a system in the table of reference systems."""
    system = CRS.from_user_input(crs)
    if "+" in crs:
        return system.name, 100_000, "NONE", 100_000, system.to_wkt("WKT1_GDAL"), IN_DATUM
    code = int(crs.removeprefix("EPSG:"))
    return system.name, code, "EPSG", code, system.to_wkt("WKT1_GDAL"), ELLIPSOIDAL


def _contents(
    scene: Scene,
    select: Select,
    *,
    srs: int,
    system: tuple[Any, ...] | None,
    rig: Floats,
    cameras: Floats,
    tolerance: float | None,
) -> Rows:
    yield Row(
        "its reference systems",
        sorted(select("SELECT * FROM gpkg_spatial_ref_sys")),
        sorted(
            [
                *([] if system is None else [system]),
                ("Undefined Cartesian", -1, "NONE", -1, "undefined", LOCAL),
                ("Undefined geographic", 0, "NONE", 0, "undefined", None),
                ("WGS 84", 4326, "EPSG", 4326, CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), HEIGHTS),
            ],
            key=lambda row: row[:4],
        ),
    )
    changed = _date(max(frame.timestamp_us for frame in scene.drive.manifest.frames)) or "1970-01-01T00:00:00.000Z"
    extents = {}
    for table, places in (("trajectory", rig), ("unit_positions", rig), ("camera_positions", cameras)):
        known = places[~np.isnan(places[:, 0])][:, :2]
        extents[table] = [*known.min(0).tolist(), *known.max(0).tolist()] if len(known) else [None] * 4
    described = [(t, "features", t, DESCRIPTIONS[t], changed, srs) for t in sorted(extents)]
    rows = sorted(select("SELECT * FROM gpkg_contents"))
    yield Row("its contents", [(*row[:5], *row[9:]) for row in rows], described)
    for row in rows:
        extent = extents[row[0]]
        yield Row(f"the extent of {row[0]}", list(row[5:9]), extent, None if None in extent else tolerance)
    geometries = [(t, "geom", "LINESTRING" if t == "trajectory" else "POINT", srs, 1, 0) for t in sorted(extents)]
    yield Row("its geometry columns", sorted(select("SELECT * FROM gpkg_geometry_columns")), geometries)


def _units(scene: Scene, scene_of_unit: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    for u, (frame, name) in enumerate(zip(scene.drive.manifest.frames, scene_of_unit, strict=True)):
        sigma = scene.sigma_position_m[u].tolist()
        sigma = [None] * 3 if np.isnan(sigma).any() else sigma
        known, component = int(scene.unit_registered[u]), int(scene.unit_component[u])
        yield u + 1, name, component, frame.source_frame, frame.timestamp_us, _date(frame.timestamp_us), known, *sigma


def _images(scene: Scene, scene_of_unit: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    for i, image in enumerate(scene.drive.images):
        name, camera = scene_of_unit[image.unit], scene.drive.cameras[image.camera].name
        when, known = image.timestamp_us, int(scene.image_registered[i])
        yield (
            i + 1,
            name,
            int(scene.unit_component[image.unit]),
            image.unit + 1,
            camera,
            image.file,
            when,
            _date(when),
            known,
        )


def _date(timestamp_us: int) -> str | None:
    """UTC with three decimals; None before 2000 and from the last second of 9999 on."""
    if timestamp_us < 946_684_800_000_000 or timestamp_us >= 253_402_300_799_000_000:
        return None
    rounded = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=(timestamp_us + 500) // 1000)
    return rounded.strftime("%Y-%m-%dT%H:%M:%S.") + f"{rounded.microsecond // 1000:03d}Z"


def _points(srs: int, table: str, blobs: list[bytes | None], places: Floats, tolerance: float | None) -> Rows:
    known = np.flatnonzero(~np.isnan(places[:, 0]))
    yield Row(f"which of {table} have a place", [k for k, blob in enumerate(blobs) if blob is not None], known.tolist())
    found = np.frombuffer(b"".join(blob for blob in blobs if blob is not None), dtype=_POINT)
    heads = np.unique(found[["magic", "version", "flags", "srs", "order", "kind"]]).tolist()
    expected = [(b"GP", 0, 1, srs, 1, 1001)] if len(known) else []
    yield Row(f"how the geometries of {table} begin", heads, expected)
    yield Row(f"a place of {table}", found["place"], places[known], tolerance)


def _lines(
    scene: Scene,
    scene_of_unit: Sequence[str],
    rows: list[tuple[Any, ...]],
    places: Floats,
    *,
    srs: int,
    tolerance: float | None,
) -> Rows:
    parts = [*zip(scene_of_unit, scene.unit_component.tolist(), strict=True)]
    units = {part: _path(scene, np.array([own == part for own in parts])) for part in dict.fromkeys(parts)}
    expected = [(*part, len(path)) for part, path in units.items() if len(path) > 1]
    yield Row("the rows of trajectory", [row[2:] for row in rows], expected)
    yield Row("the ids of trajectory", [row[0] for row in rows], [*range(1, len(rows) + 1)])
    for _, blob, name, component, count in rows:
        head, line = np.frombuffer(blob[: _LINE.itemsize], dtype=_LINE)[0], places[units[name, component]]
        described = head[["magic", "version", "flags", "srs", "order", "kind", "count"]].tolist()
        yield Row(f"the beginning of {name}'s line", described, (b"GP", 0, 5, srs, 1, 1002, count))
        envelope = np.stack([line.min(0), line.max(0)], -1)
        yield Row(f"the envelope of {name}'s line", head["envelope"], envelope, tolerance)
        found = np.frombuffer(blob[_LINE.itemsize :], dtype="<f8").reshape(-1, 3)
        yield Row(f"{name}'s line", found, line, tolerance)


def _path(scene: Scene, of_scene: NDArray[np.bool_]) -> Ints:
    """Registered units of a scene in order of time."""
    frames = scene.drive.manifest.frames
    units = np.flatnonzero(of_scene & scene.unit_registered).tolist()
    return np.array(sorted(units, key=lambda u: frames[u].timestamp_us), dtype=np.int64)


def _places(scene: Scene, poses: Floats, system: tuple[Any, ...] | None) -> Floats:
    """Origins of poses as `poses.json` has them, as x, y, z; its own check compares them with the poses.

    Longitudes are those within 180 deg of the origin's. In another system they are PROJ's, of earth-centred ones.
    """
    if system is not None:
        return _projected(scene, poses, system)
    geodetic = geodetic_positions(scene, poses)
    if geodetic is None:
        return poses[:, :3, 3]
    assert scene.georeference is not None
    latitude, longitude, height = geodetic.T
    east = longitude - scene.georeference.origin_longitude_deg
    longitude = np.where(east > 180.0, longitude - 360.0, np.where(east < -180.0, longitude + 360.0, longitude))
    return np.stack([longitude, latitude, height], -1)


def _projected(scene: Scene, poses: Floats, system: tuple[Any, ...]) -> Floats:
    place = scene.georeference
    assert place is not None
    points_m, crs = poses[:, :3, 3], CRS.from_wkt(system[4])
    known = np.isfinite(points_m).all(axis=1)
    places = np.full(points_m.shape, np.nan)
    places[known] = projected(place, points_m[known], crs if system[2] == "NONE" else crs.to_3d())
    return places


def _srs(scene: Scene) -> int:
    return -1 if scene.georeference is None else 4326
