from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.features.tiles import MIN_OVERLAP_PX, cut, duplicates, lay_tiles

WINDOW = (640, 360)


@pytest.mark.parametrize("size", [(370, 1226), (640, 360), (641, 361), (900, 1600), (30, 40), (1400, 300)])
def test_cores_partition_the_image_and_lie_well_inside_their_tiles(size: tuple[int, int]) -> None:
    rows, columns = size
    tiles = lay_tiles(size, WINDOW)
    yy, xx = np.mgrid[:rows:7, :columns:7] + 0.5
    xy = np.stack([xx.ravel(), yy.ravel()], axis=1).astype(np.float32)
    owners = np.stack([tile.owns(xy) for tile in tiles])
    assert (owners.sum(axis=0) == 1).all()
    for tile, own in zip(tiles, owners, strict=True):
        x, y = (xy[own] - [tile.column, tile.row]).T
        inner = MIN_OVERLAP_PX / 2 - 1
        assert ((x >= inner) | (xy[own][:, 0] < inner)).all()
        assert ((x <= WINDOW[1] - inner) | (xy[own][:, 0] > columns - inner)).all()
        assert (y <= WINDOW[0]).all()
        assert 0 <= tile.column <= max(0, columns - WINDOW[1])


def test_no_more_tiles_than_needed() -> None:
    assert len(lay_tiles((370, 1226), WINDOW)) == 4
    assert len(lay_tiles((640, 360), WINDOW)) == 1
    assert len(lay_tiles((900, 1600), WINDOW)) == 2 * 5


def test_a_tile_has_the_images_pixels_and_beyond_it_mirrored_ones() -> None:
    image = np.random.default_rng(0).integers(0, 256, (100, 500, 3), dtype=np.uint8)
    tiles = lay_tiles((100, 500), (128, 360))
    assert [tile.column for tile in tiles] == [0, 140]
    part = cut(image, tiles[1], (128, 360))
    np.testing.assert_array_equal(part[:100], image[:, 140:])
    np.testing.assert_array_equal(part[100:], image[72:, 140:][::-1])


def test_of_a_corner_that_two_tiles_found_the_stronger_stays() -> None:
    xy = np.array([[10, 10], [11, 10], [30, 10], [31, 10], [50, 10]], np.float32)
    scores = np.array([0.5, 0.9, 0.8, 0.1, 0.3], np.float32)
    tile = np.array([0, 1, 0, 0, 1])
    assert duplicates(xy, scores, tile).tolist() == [True, False, False, False, False]
    assert duplicates(xy[:0], scores[:0], tile[:0]).tolist() == []
