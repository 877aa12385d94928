"""The picture of the road in systems that users name: where its cells are, and that they stay as they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pyproj import CRS, Transformer

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.contract import ExportOptions, ExportWork
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.geotiff_in_crs import KEYS, read_picture
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.visualization.geotiff import write_geotiff
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile, TileIndex
from mrasfm_engine.visualization.tile_pyramid import build_pyramid
from tests.helpers.export_example import make_scene

CELL_M = 0.025


def road_tiff(folder: Path, tiles: list[tuple[int, int]]) -> bytes:
    """A picture of tiles by row and column, turned by half a radian against the local frame."""
    scene, rng = make_scene(), np.random.default_rng(4)
    with TileFile(folder / "tiles") as file:
        for place in tiles:
            colors = rng.integers(0, 256, (TILE_CELLS, TILE_CELLS, 3), dtype=np.uint8)
            file.add(TileIndex(0, *place), np.dstack([colors, np.full(colors.shape[:2], 255, np.uint8)]))
        pyramid = build_pyramid(file)
        assert pyramid is not None
        c, s = CELL_M * np.cos(0.5), CELL_M * np.sin(0.5)
        write_geotiff(folder / "made.tif", pyramid, np.array([[c, s, -3.0], [s, -c, 5.0]]), place=scene.georeference)
    return (folder / "made.tif").read_bytes()


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    picture = road_tiff(tmp_path, [(0, 0), (0, 1), (1, 3), (2, 3)])
    write_scene(make_scene(), tmp_path / "scene", {}, lambda: {"road.tif": picture})
    return tmp_path / "scene"


def exported(folder: Path, **options: Any) -> Path:
    out = folder.parent / "out"
    request = ExportRequest(folder=folder, out=out, formats=["geotiff"], options=ExportOptions(**options), drives={})
    report = run_export(request, progress=lambda *_: None, cancel=lambda: False)
    assert "withheld" not in report["formats"]["geotiff"], report
    return out / "geotiff" / "road.tif"


@pytest.mark.parametrize("crs", [None, "EPSG:25832", "EPSG:3035", "EPSG:23032"])
def test_cells_are_where_proj_puts_them_and_stay_as_they_are(scene_folder: Path, crs: str | None) -> None:
    path, scene = exported(scene_folder, crs=crs), make_scene()
    own, found = read_picture(scene_folder / "pictures" / "road.tif"), read_picture(path)
    assert cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)[0]
    for one, other in zip(*(cv2.imreadmulti(str(p.path), flags=-1)[1] for p in (own, found)), strict=True):
        assert np.array_equal(one, other)
    code = 32632 if crs is None else int(crs.removeprefix("EPSG:"))
    assert found.numbers(KEYS).reshape(-1, 4).tolist()[1:] == [[1024, 0, 1, 1], [1025, 0, 1, 1], [3072, 0, 1, code]]
    assert scene.georeference is not None
    pixels = np.array([[0.0, 0.0, 1.0], [1024.0, 0.0, 1.0], [1024.0, 768.0, 1.0], [500.0, 300.0, 1.0]])
    local = np.column_stack([pixels @ own.world_from_pixel.T, np.zeros(4)])
    matrix = scene.georeference.ecef_from_local
    ecef = local @ matrix[:3, :3].T + matrix[:3, 3]
    places = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)
    target = Transformer.from_crs("EPSG:4979", CRS.from_epsg(code).to_3d(), always_xy=True)
    expected = np.stack(target.transform(*places), -1)[:, :2]
    off_m = np.linalg.norm(pixels @ found.world_from_pixel.T - expected, axis=1)
    assert 0 < off_m.max() < 1e-4


def test_a_bit_of_it_withholds_it(scene_folder: Path) -> None:
    """Also by what it says alone: without the digest, all but the texture's own checks find it."""
    source = read_source(scene_folder)
    folder = scene_folder.parent / "work"
    folder.mkdir()
    options = ExportOptions(crs="EPSG:25832")
    made = WRITERS["geotiff"](ExportWork(source=source, options=options, folder=folder, step=lambda *_: None))
    assert exports._fault(made, folder) is None
    content, rng = (folder / "road.tif").read_bytes(), np.random.default_rng(0)
    for at in rng.choice(8 * len(content), 60, replace=False).tolist():
        changed = bytearray(content)
        changed[at // 8] ^= 1 << at % 8
        (folder / "road.tif").write_bytes(changed)
        assert "road.tif" in str(exports._fault(made, folder))
        assert "road.tif" in str(exports._fault(replace(made, digests={}), folder)), at


def test_a_scene_without_a_picture_and_one_that_is_too_large(tmp_path: Path) -> None:
    write_scene(make_scene(), tmp_path / "none" / "scene", {})
    with pytest.raises(InputError, match=r"has no pictures/road.tif"):
        exported(tmp_path / "none" / "scene")
    picture = road_tiff(tmp_path, [(0, column) for column in (0, 1000, 2000, 3000)])  # 19 km
    write_scene(make_scene(), tmp_path / "large" / "scene", {}, lambda: {"road.tif": picture})
    with pytest.raises(InputError, match=r"too large for EPSG:25832: its cells would be off") as found:
        exported(tmp_path / "large" / "scene", crs="EPSG:25832")
    assert "gdalwarp -t_srs EPSG:25832" in found.value.remedy
    write_scene(make_scene(), tmp_path / "damaged" / "scene", {}, lambda: {"road.tif": picture[:5000]})
    with pytest.raises(InputError, match=r"road.tif is damaged: it ends early"):
        exported(tmp_path / "damaged" / "scene")
