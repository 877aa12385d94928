"""The points in systems that users name: coordinates as PROJ and laspy have them, and what is refused by name."""

from __future__ import annotations

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
from schemas.artifacts import COPC_FILE
from tests.helpers.export_example import make_scene


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    write_scene(make_scene(), tmp_path / "scene", {})
    return tmp_path / "scene"


def exported(folder: Path, crs: str | None) -> Path:
    request = ExportRequest(
        folder=folder, out=folder.parent / "out", formats=["copc"], options=ExportOptions(crs=crs), drives={}
    )
    run_export(request, progress=lambda *_: None, cancel=lambda: False)
    return folder.parent / "out" / "copc" / COPC_FILE


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
