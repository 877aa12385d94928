"""Tiles on disk, their coarser levels, and the GeoTIFF of them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Transformer

from mrasfm_engine.geometry.geodesy import ecef_from_local
from mrasfm_engine.scene.scene import Georeference
from mrasfm_engine.visualization.geotiff import write_geotiff
from mrasfm_engine.visualization.road_picture import world_file
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile, TileIndex, predicted, unpredicted
from mrasfm_engine.visualization.tile_pyramid import TilePyramid, build_pyramid, halved

TILES = ((-2, 3), (-2, 4), (-1, 3), (0, 5))  # rows and columns; a hole between
WORLD_FROM_PIXEL = np.array([[0.02, 0.015, 7.0], [0.015, -0.02, -3.0]])


def tile(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    smooth = cv2.resize(rng.integers(1, 255, (9, 9, 3), dtype=np.uint8), (TILE_CELLS, TILE_CELLS))
    return np.dstack([smooth, np.full((TILE_CELLS, TILE_CELLS), 255, np.uint8)])


@pytest.fixture
def pyramid(tmp_path: Path) -> Iterator[TilePyramid]:
    with TileFile(tmp_path / "tiles") as file:
        for seed, place in enumerate(TILES):
            file.add(TileIndex(0, *place), tile(seed))
        file.add(TileIndex(0, 9, 9), np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8))  # no tile: nothing is on it
        built = build_pyramid(file)
        assert built is not None
        yield built


def test_tiles_come_back_and_make_coarser_levels(pyramid: TilePyramid) -> None:
    assert pyramid.tiles == ((3, 3), (2, 2), (1, 1))
    finest = pyramid.picture(0)
    assert finest.shape == (768, 768, 4)
    np.testing.assert_array_equal(finest[:256, 256:512], tile(1))
    assert not finest[:256, 512:].any()
    np.testing.assert_array_equal(unpredicted(predicted(tile(2))), tile(2))
    np.testing.assert_array_equal(pyramid.picture(1), halved(finest))
    assert pyramid.shape(2) == (192, 192)
    assert [pyramid.level_within(max_cells=n, max_side_cells=10_000) for n in (10**6, 200_000, 10)] == [0, 1, 2]
    assert pyramid.level_within(max_cells=10**6, max_side_cells=400) == 1


def test_halving_averages_opaque_cells_only() -> None:
    cells = np.zeros((2, 4, 4), np.uint8)
    cells[0, 0], cells[1, 1] = (100, 10, 0, 255), (200, 20, 0, 255)
    np.testing.assert_array_equal(halved(cells), [[[150, 15, 0, 128], [0, 0, 0, 0]]])


def test_without_tiles_there_is_no_pyramid(tmp_path: Path) -> None:
    with TileFile(tmp_path / "tiles") as file:
        assert build_pyramid(file) is None


def test_libtiff_reads_all_levels_of_the_geotiff(pyramid: TilePyramid, tmp_path: Path) -> None:
    path = tmp_path / "road.tif"
    digest = write_geotiff(path, pyramid, WORLD_FROM_PIXEL, place=None)
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    ok, pages = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
    assert ok
    assert len(pages) == pyramid.levels
    for level, page in enumerate(pages):
        np.testing.assert_array_equal(page[..., [2, 1, 0, 3]], pyramid.picture(level))
    matrix = np.zeros((4, 4))
    matrix[:2, [0, 1, 3]], matrix[3, 3] = WORLD_FROM_PIXEL, 1.0
    data = path.read_bytes()
    assert data[:4] == b"II\x2b\x00"
    assert matrix.tobytes() in data
    size = 3 * 256 * 256 * 4
    assert len(data) < 0.9 * size * (1 + 1 / 4 + 1 / 16)  # holes and smooth colours are packed


def test_the_local_frame_is_an_orthographic_projection() -> None:
    place = Georeference(
        origin_latitude_deg=48.1,
        origin_longitude_deg=11.5,
        origin_ellipsoidal_height_m=0.0,
        height_datum="ellipsoid",
        ecef_from_local=ecef_from_local([48.1, 11.5, 0.0]),
    )
    xy = np.array([[400.0, -300.0], [10.0, 900.0], [-700.0, 5.0]])
    projection = f"+proj=ortho +lat_0={place.origin_latitude_deg} +lon_0={place.origin_longitude_deg} +ellps=WGS84"
    lon, lat = Transformer.from_crs(projection, "EPSG:4326", always_xy=True).transform(*xy.T)
    ecef = np.column_stack(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, 0 * lat))
    local = (ecef - place.ecef_from_local[:3, 3]) @ place.ecef_from_local[:3, :3]
    np.testing.assert_allclose(local[:, :2], xy, atol=1e-3)


def test_a_world_file_names_the_middle_of_the_first_pixel() -> None:
    a, d, b, e, x, y = (float(line) for line in world_file(WORLD_FROM_PIXEL).split())
    np.testing.assert_allclose([[a, b], [d, e]], WORLD_FROM_PIXEL[:, :2])
    np.testing.assert_allclose([x, y], WORLD_FROM_PIXEL @ [0.5, 0.5, 1.0])
