"""The points in systems that users name: coordinates as PROJ and laspy have them, and what is refused by name."""

from __future__ import annotations

import json
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.transformer import TransformerGroup

from mrasfm_engine.errors import InputError
from mrasfm_engine.export.contract import ExportOptions
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy
from mrasfm_engine.geometry.earth_system import named_system
from schemas.artifacts import COPC_FILE, TRAJECTORY_FILE
from tests.helpers.export_example import make_scene


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    write_scene(make_scene(), tmp_path / "scene", {})
    return tmp_path / "scene"


def exported(folder: Path, crs: str | None, form: str = "copc") -> Path:
    request = ExportRequest(
        folder=folder, out=folder.parent / "out", formats=[form], options=ExportOptions(crs=crs), drives={}
    )
    run_export(request, progress=lambda *_: None, cancel=lambda: False)
    return folder.parent / "out" / form / {"copc": COPC_FILE, "geopackage": TRAJECTORY_FILE}.get(form, "")


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:3857", "EPSG:25833", "EPSG:3035"])
def test_points_are_where_proj_puts_them(scene_folder: Path, crs: str) -> None:
    """3857 is what web maps have, 25833 the neighbouring zone, 3035 has its axes in the other order."""
    scene = make_scene()
    assert scene.georeference is not None
    las = laspy.read(exported(scene_folder, crs))
    matrix = scene.georeference.ecef_from_local
    ecef = scene.points_m @ matrix[:3, :3].T + matrix[:3, 3]
    places = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(places[0], places[1])
    order = np.asarray(las["point_id"]) - 1
    found = np.stack([las.x, las.y, las.z], -1)
    assert np.abs(found - np.stack([east, north, places[2]], -1)[order]).max() < 1.1e-4
    system = las.header.parse_crs()
    assert system is not None
    (text,) = (record.string for record in las.header.vlrs if record.record_id == 2112)
    assert f'AUTHORITY["EPSG","{crs.removeprefix("EPSG:")}"]' in text


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:3035", "EPSG:23032"])
def test_positions_of_the_geopackage_are_where_proj_puts_them(scene_folder: Path, crs: str) -> None:
    """23032 has a datum of its own, with its own ellipsoid."""
    scene = make_scene()
    assert scene.georeference is not None
    path = exported(scene_folder, crs, "geopackage")
    matrix, known = scene.georeference.ecef_from_local, scene.unit_registered
    ecef = scene.world_from_rig[known, :3, 3] @ matrix[:3, :3].T + matrix[:3, 3]
    places = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)
    expected = np.stack(Transformer.from_crs("EPSG:4979", CRS(crs).to_3d(), always_xy=True).transform(*places), -1)
    with closing(sqlite3.connect(path)) as db:
        rows = db.execute("SELECT geom FROM unit_positions WHERE geom NOT NULL ORDER BY fid").fetchall()
        systems = db.execute("SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys")
        (definition,) = (text for name, code, text in systems if f"{name}:{code}" == crs)
        used = {
            srs
            for (srs,) in db.execute("SELECT srs_id FROM gpkg_contents UNION SELECT srs_id FROM gpkg_geometry_columns")
        }
    found = np.array([struct.unpack_from("<3d", geometry, 13) for (geometry,) in rows])
    assert np.abs(found - expected).max() < 1e-5
    assert used == {int(crs.removeprefix("EPSG:"))} == {struct.unpack_from("<i", rows[0][0], 4)[0]}
    assert definition.endswith(f'AUTHORITY["EPSG","{crs.removeprefix("EPSG:")}"]]')


def test_what_has_no_system_of_choice_says_so(scene_folder: Path) -> None:
    request = ExportRequest(
        folder=scene_folder,
        out=scene_folder.parent / "out",
        formats=["copc", "geojson", "kitti", "geopackage"],
        options=ExportOptions(crs="EPSG:25832"),
        drives={},
    )
    notes = {
        k: v["notes"] for k, v in run_export(request, progress=lambda *_: None, cancel=lambda: False)["formats"].items()
    }
    assert notes["geojson"] == ["EPSG:25832 does not apply: GeoJSON (RFC 7946) has WGS84 alone"]
    assert notes["kitti"] == ["EPSG:25832 does not apply: its coordinates are those of the local frame"]
    assert notes["copc"] == notes["geopackage"]
    assert notes["copc"][0] == "coordinates are in EPSG:25832"
    with pytest.raises(InputError, match="de_bkg_gcg2016"):
        exported(scene_folder, "EPSG:25832+7837", "geopackage")


def test_components_are_told_apart(tmp_path: Path) -> None:
    """In the COPC, the GeoPackage and GeoJSON; no line leads from one to the other."""
    scene = make_scene()
    component = np.array([0, 0, 0, 1, 1])
    write_scene(replace(scene, unit_component=component), tmp_path / "scene", {})
    las = laspy.read(tmp_path / "scene" / COPC_FILE)
    of_point = {}
    for point, image in zip(scene.observation_point.tolist(), scene.observation_image.tolist(), strict=True):
        of_point.setdefault(point, component[scene.drive.images[image].unit])
    assert las["component"].tolist() == [of_point[i - 1] for i in las["point_id"].tolist()]
    path = exported(tmp_path / "scene", "EPSG:25832", "geopackage")
    for file in (tmp_path / "scene" / "trajectory.gpkg", path):
        with closing(sqlite3.connect(file)) as db:
            assert db.execute("SELECT component, units FROM trajectory").fetchall() == [(0, 2), (1, 2)]
            assert db.execute("SELECT component FROM unit_positions ORDER BY fid").fetchall() == [
                (c,) for c in component
            ]
            rows = db.execute(
                "SELECT component, count(*) FROM camera_positions GROUP BY component ORDER BY 1"
            ).fetchall()
        assert rows == [(0, 6), (1, 4)]
    folder = exported(tmp_path / "scene", None, "geojson")
    lines = json.loads((folder / "trajectory.geojson").read_text())["features"]
    assert [(f["properties"]["component"], len(f["geometry"]["coordinates"])) for f in lines] == [(0, 2), (1, 2)]


def test_without_a_system_it_is_the_scenes_own_file(scene_folder: Path) -> None:
    assert exported(scene_folder, None).read_bytes() == (scene_folder / COPC_FILE).read_bytes()


def test_a_grid_that_is_missing_is_named(scene_folder: Path) -> None:
    for crs, grid in (("EPSG:25832+7837", "de_bkg_gcg2016.tif"), ("EPSG:25832+5773", "egm96_15")):
        if any(Path(folder, grid).exists() for folder in pyproj.datadir.get_data_dir().split(":")):
            pytest.skip(f"{grid} is installed")
        with pytest.raises(InputError, match=grid) as raised:
            exported(scene_folder, crs)
        assert raised.value.code == "missing-geoid-grid"
    assert not (scene_folder.parent / "out").exists()


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4979", "EPSG:5773", "EPSG:99999", "UTM", "EPSG:25832+25832"])
def test_what_is_no_projected_system_is_refused(scene_folder: Path, crs: str) -> None:
    with pytest.raises(InputError, match=r"EPSG|names no") as raised:
        exported(scene_folder, crs)
    assert raised.value.code == "bad-crs"


def test_a_scene_far_from_the_systems_area(scene_folder: Path) -> None:
    """New Zealand's would give numbers here, which mean nothing; those of the whole earth reach around it."""
    for crs in ("EPSG:2193", "EPSG:32618"):
        with pytest.raises(InputError, match="is for") as raised:
            exported(scene_folder, crs)
        assert raised.value.code == "outside-crs"
    assert named_system("EPSG:2193", at=(-41.0, 175.0)).name == "EPSG:2193"
    assert named_system("EPSG:3832", at=(0.0, -179.0)).name == "EPSG:3832", "across the antimeridian"


def test_every_system_says_its_heights() -> None:
    for crs in ("EPSG:25832", "EPSG:32632"):
        text: Any = named_system(crs, at=(48.1, 11.5)).well_known_text
        assert text.startswith("COMPD_CS[")
        assert 'VERT_CS["Ellipsoid (metre)"' in text


def test_old_datums_are_taken_as_they_are_at_the_scene(tmp_path: Path) -> None:
    """ED50 has a transformation for each country: that of the whole of Europe is 3 m off in Norway."""
    oslo = (59.9, 10.7)
    near = AreaOfInterest(10.6, 59.8, 10.8, 60.0)
    target = CRS("EPSG:23032").to_3d()
    best = TransformerGroup("EPSG:4979", target, always_xy=True, area_of_interest=near).transformers[0]
    system = named_system("EPSG:23032", at=oslo)
    found = system.projected(np.zeros((1, 3)), geodesy.ecef_from_local([*oslo, 100.0]))[0]
    assert np.abs(found - best.transform(10.7, 59.9, 100.0)).max() < 1e-4
    anywhere = TransformerGroup("EPSG:4979", target, always_xy=True).transformers[0]
    assert np.abs(found - anywhere.transform(10.7, 59.9, 100.0)).max() > 2.0
    assert system.notes() == ["the transformation from WGS84 to EPSG:23032 has an accuracy of 1 m, as EPSG states it"]
    assert named_system("EPSG:32632", at=(48.1, 11.5)).notes() == []
    scene = make_scene()
    assert scene.georeference is not None
    place = replace(
        scene.georeference,
        origin_latitude_deg=oslo[0],
        origin_longitude_deg=oslo[1],
        origin_ellipsoidal_height_m=100.0,
        ecef_from_local=geodesy.ecef_from_local([*oslo, 100.0]),
    )
    write_scene(replace(scene, georeference=place), tmp_path / "scene", {})
    assert laspy.read(exported(tmp_path / "scene", "EPSG:23032")).header.point_count == len(scene.points_m)
    with pytest.raises(InputError, match="es_ign_SPED2ETV2"):  # in Spain the best one is a grid
        named_system("EPSG:23030", at=(40.4, -3.7))
