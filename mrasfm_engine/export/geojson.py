"""Format `geojson`: the layers of `trajectory.gpkg` as GeoJSON (RFC 7946), for web maps.

`trajectory.geojson` has a line for each component of a scene, `unit_positions.geojson` and `camera_positions.geojson`
a point for each registered unit and image. Coordinates are longitude, latitude (WGS84) and ellipsoidal height; a line
that crosses the antimeridian is cut there, as the RFC wants it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from mrasfm_engine.export import readers
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportSource, ExportWork, Written
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.types import Floats
from schemas.file_names import composed

TRAJECTORY, UNITS, CAMERAS = "trajectory.geojson", "unit_positions.geojson", "camera_positions.geojson"
DECIMALS_DEG, DECIMALS_M = 11, 4  # a micrometre, and a tenth of a millimetre
TOLERANCE_DEG, TOLERANCE_M = 0.5001e-11, 0.5001e-4
HALF_TURN_DEG = 180.0


def write_geojson(work: ExportWork) -> Written:
    """Write the three files; the scene must be georeferenced."""
    source = work.source
    digests: dict[str, str] = {}
    for name, features in ((TRAJECTORY, _lines(source)), (UNITS, _units(source)), (CAMERAS, _cameras(source))):
        document = {"type": "FeatureCollection", "features": list(features)}
        text = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
        digests[name] = write_content(work.folder / name, text + "\n")
    return Written(
        digests=digests,
        checks=[
            Check(TRAJECTORY, readers.json_object, partial(_compare_lines, source)),
            Check(UNITS, readers.json_object, partial(_compare_units, source)),
            Check(CAMERAS, readers.json_object, partial(_compare_cameras, source)),
        ],
    )


def _lines(source: ExportSource) -> Iterator[dict[str, Any]]:
    places = _positions(source, source.scene.world_from_rig)
    for name, component in _parts(source):
        units = _units_of(source, name, component)
        if len(units) < 2:
            continue
        parts = _cut(places[units])
        kind, coordinates = ("LineString", parts[0]) if len(parts) == 1 else ("MultiLineString", parts)
        yield _feature(kind, coordinates, {"scene": name, "component": component, "units": len(units)})


def _units(source: ExportSource) -> Iterator[dict[str, Any]]:
    places, scene = _positions(source, source.scene.world_from_rig), source.scene
    for u in np.flatnonzero(scene.unit_registered).tolist():
        frame = scene.drive.manifest.frames[u]
        properties = {
            "unit": u,
            "scene": source.scene_of_unit[u],
            "component": int(scene.unit_component[u]),
            "source_frame": frame.source_frame,
            "timestamp_us": frame.timestamp_us,
        }
        yield _feature("Point", _rounded(places[u]), properties)


def _cameras(source: ExportSource) -> Iterator[dict[str, Any]]:
    places, scene = _positions(source, source.scene.world_from_cam), source.scene
    for i in source.registered:
        image = scene.drive.images[i]
        properties = {
            "image": composed(image.file),
            "camera": scene.drive.cameras[image.camera].name,
            "unit": image.unit,
            "scene": source.scene_of_unit[image.unit],
            "component": int(scene.unit_component[image.unit]),
            "timestamp_us": image.timestamp_us,
        }
        yield _feature("Point", _rounded(places[i]), properties)


def _feature(kind: str, coordinates: Sequence[Any], properties: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": dict(properties),
    }


def _positions(source: ExportSource, poses: Floats) -> Floats:
    """Longitude, latitude and height (n, 3) of poses' origins; NaN where a pose is."""
    places = geodetic_positions(source.scene, poses)
    assert places is not None
    return places[:, [1, 0, 2]]


def _parts(source: ExportSource) -> list[tuple[str, int]]:
    """Scenes and the components of each, in order; no line leads from one to another, as nothing links them."""
    return list(dict.fromkeys(zip(source.scene_of_unit, source.scene.unit_component.tolist(), strict=True)))


def _units_of(source: ExportSource, name: str, component: int) -> list[int]:
    scene = source.scene
    of_scene = np.array([own == name for own in source.scene_of_unit])
    units = np.flatnonzero(scene.unit_registered & of_scene & (scene.unit_component == component))
    ordered: list[int] = units[np.argsort(scene.drive.timestamps_us[units], kind="stable")].tolist()
    return ordered


def _rounded(place: Floats) -> list[float]:
    longitude, latitude, height = place.tolist()
    return [round(longitude, DECIMALS_DEG), round(latitude, DECIMALS_DEG), round(height, DECIMALS_M)]


def _cut(places: Floats) -> list[list[list[float]]]:
    """Parts of a line (n, 3) on one side of the antimeridian each; where it crosses, both parts have the crossing."""
    parts: list[list[list[float]]] = [[_rounded(places[0])]]
    for a, b in pairwise(places):
        if abs(b[0] - a[0]) > HALF_TURN_DEG:
            side = np.sign(a[0]) * HALF_TURN_DEG
            beyond = np.array([b[0] + 2.0 * side, b[1], b[2]])
            crossing = a + (beyond - a) * (side - a[0]) / (beyond[0] - a[0])
            parts[-1].append(_rounded(np.array([side, *crossing[1:]])))
            parts.append([_rounded(np.array([-side, *crossing[1:]]))])
        parts[-1].append(_rounded(b))
    return parts


def _compare_lines(source: ExportSource, document: dict[str, Any]) -> Rows:
    """Every point of a line but those where it is cut."""
    places = _positions(source, source.scene.world_from_rig)
    known = [part for part in _parts(source) if len(_units_of(source, *part)) > 1]
    features = document["features"]
    yield from _kinds(document, {"LineString", "MultiLineString"})
    yield Row("its scenes and their components", _properties(document, ("scene", "component")), known)
    for (name, component), feature in zip(known, features, strict=True):
        units, coordinates = _units_of(source, name, component), feature["geometry"]["coordinates"]
        lines = [coordinates] if feature["geometry"]["type"] == "LineString" else coordinates
        found = [place for line in lines for place in line]
        cuts = [[line[-1], following[0]] for line, following in pairwise(lines)]
        yield Row("a cut", all(a[0] == -b[0] and abs(a[0]) == HALF_TURN_DEG and a[1:] == b[1:] for a, b in cuts), True)
        at_cuts = [place for cut in cuts for place in cut]
        yield from _places(f"the path of {name}", [p for p in found if p not in at_cuts], places[units])
        yield Row("its number of units", feature["properties"]["units"], len(units))


def _compare_units(source: ExportSource, document: dict[str, Any]) -> Rows:
    scene = source.scene
    units = np.flatnonzero(scene.unit_registered).tolist()
    yield from _kinds(document, {"Point"})
    yield from _points(document, _positions(source, scene.world_from_rig)[units])
    frames = scene.drive.manifest.frames
    components = scene.unit_component.tolist()
    expected = [
        (u, source.scene_of_unit[u], components[u], frames[u].source_frame, frames[u].timestamp_us) for u in units
    ]
    keys = ("unit", "scene", "component", "source_frame", "timestamp_us")
    yield Row("a unit's properties", _properties(document, keys), expected)


def _compare_cameras(source: ExportSource, document: dict[str, Any]) -> Rows:
    scene = source.scene
    yield from _kinds(document, {"Point"})
    yield from _points(document, _positions(source, scene.world_from_cam)[source.registered])
    images = [scene.drive.images[i] for i in source.registered]
    expected = [
        (
            *(composed(i.file), scene.drive.cameras[i.camera].name, i.unit, source.scene_of_unit[i.unit]),
            *(int(scene.unit_component[i.unit]), i.timestamp_us),
        )
        for i in images
    ]
    keys = ("image", "camera", "unit", "scene", "component", "timestamp_us")
    yield Row("an image's properties", _properties(document, keys), expected)


def _kinds(document: dict[str, Any], geometries: set[str]) -> Rows:
    yield Row("its type", document["type"], "FeatureCollection")
    yield Row("its features' types", {feature["type"] for feature in document["features"]} <= {"Feature"}, True)
    found = {feature["geometry"]["type"] for feature in document["features"]}
    yield Row("its geometries' types", found <= geometries, True)


def _points(document: dict[str, Any], expected: Floats) -> Rows:
    yield from _places("a position", [f["geometry"]["coordinates"] for f in document["features"]], expected)


def _places(what: str, found: Sequence[Sequence[float]], expected: Floats) -> Rows:
    places = np.array(found, dtype=np.float64).reshape(-1, 3)
    yield Row(what, places[:, :2], expected[:, :2], TOLERANCE_DEG)
    yield Row(f"{what}, its height", places[:, 2], expected[:, 2], TOLERANCE_M)


def _properties(document: dict[str, Any], keys: Sequence[str]) -> list[tuple[Any, ...]]:
    return [tuple(feature["properties"][key] for key in keys) for feature in document["features"]]
