"""A tile pyramid as a tiled BigTIFF with overviews, placed on the earth where the scene is.

One file of any size that QGIS, GDAL and libtiff open as it is, and that is read in parts, over HTTP too: the layout is
that of a cloud-optimised GeoTIFF, all directories first and the coarsest tiles before finer ones.
"""

from __future__ import annotations

import hashlib
import zlib
from itertools import chain
from pathlib import Path

import numpy as np

from mrasfm_engine.io.tiff import ASCII, DOUBLE, HEADER_BYTES, LONG, SHORT, Entry, directories, entry, header
from mrasfm_engine.scene.scene import Georeference
from mrasfm_engine.types import Floats
from mrasfm_engine.visualization.tile_file import PREDICTED, TILE_CELLS, predicted
from mrasfm_engine.visualization.tile_pyramid import TilePyramid

_DEFLATE, _RGB, _UNASSOCIATED_ALPHA, _REDUCED = 8, 2, 2, 1


def write_geotiff(path: Path, pyramid: TilePyramid, world_from_pixel: Floats, *, place: Georeference | None) -> str:
    """Write a pyramid as one file.

    Parameters
    ----------
    world_from_pixel
        (2, 3) x and y of (u, v, 1) of the finest level, whose top left corner is at (0, 0).
    place
        Where the scene's frame is on the earth. Its x and y are written as an orthographic projection about the
        origin, which they are but for heights: a factor of one and the height above the ellipsoid over 6,371 km.

    Returns
    -------
    str
        SHA-256 of what was written, in hexadecimal.
    """
    empty = zlib.compress(predicted(np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)))
    geo = _placement(world_from_pixel, place)
    tags = [_level_tags(pyramid, level) + (geo if level == 0 else []) for level in range(pyramid.levels)]
    present = [pyramid.file.indices(level) for level in range(pyramid.levels)]
    # Of known sizes, as only the offsets' values are still missing.
    sizes = [np.full(rows * columns, len(empty), dtype="<u8") for rows, columns in pyramid.tiles]
    offsets = [np.zeros_like(size) for size in sizes]
    start = HEADER_BYTES + len(directories(tags, offsets, sizes))
    end = start + len(empty)
    for level in reversed(range(pyramid.levels)):
        offsets[level][:] = start  # all tiles without content are one
        for index in present[level]:
            number = pyramid.number(index)
            offsets[level][number], sizes[level][number] = end, pyramid.file.size_bytes(index)
            end += pyramid.file.size_bytes(index)
    digest = hashlib.sha256()
    with path.open("wb") as file:
        head = header() + directories(tags, offsets, sizes) + empty
        tiles = (pyramid.file.compressed(index) for level in reversed(present) for index in level)
        for data in chain([head], tiles):
            digest.update(data)
            file.write(data)
    return digest.hexdigest()


def _level_tags(pyramid: TilePyramid, level: int) -> list[Entry]:
    height, width = pyramid.shape(level)
    return [
        entry(254, LONG, 0 if level == 0 else _REDUCED),
        entry(256, LONG, width),
        entry(257, LONG, height),
        entry(258, SHORT, 8, 8, 8, 8),
        entry(259, SHORT, _DEFLATE),
        entry(262, SHORT, _RGB),
        entry(277, SHORT, 4),
        entry(284, SHORT, 1),
        entry(317, SHORT, PREDICTED),
        entry(322, LONG, TILE_CELLS),
        entry(323, LONG, TILE_CELLS),
        entry(338, SHORT, _UNASSOCIATED_ALPHA),
        entry(339, SHORT, 1, 1, 1, 1),
    ]


def _placement(world_from_pixel: Floats, place: Georeference | None) -> list[Entry]:
    """ModelTransformation, and GeoKeys of the projection or of a frame that is tied to nothing."""
    matrix = np.zeros((4, 4))
    matrix[:2, [0, 1, 3]], matrix[3, 3] = world_from_pixel, 1.0
    name = b"x and y of the scene's local frame|\0"
    keys, doubles = [(1025, 0, 1, 1), (1026, 34737, len(name) - 1, 0)], []
    if place is None:
        keys = [(1024, 0, 1, 32767), *keys, (3076, 0, 1, 9001)]
    else:
        doubles = [place.origin_longitude_deg, place.origin_latitude_deg, 0.0, 0.0]
        keys = [
            (1024, 0, 1, 1),
            *keys,
            (2048, 0, 1, 4326),
            (3072, 0, 1, 32767),
            (3074, 0, 1, 32767),
            (3075, 0, 1, 21),  # orthographic
            (3076, 0, 1, 9001),  # metres
            (3080, 34736, 1, 0),
            (3081, 34736, 1, 1),
            (3082, 34736, 1, 2),
            (3083, 34736, 1, 3),
        ]
    directory = [1, 1, 0, len(keys), *(number for key in keys for number in key)]
    entries = [entry(34264, DOUBLE, *matrix.ravel()), entry(34735, SHORT, *directory)]
    entries += [entry(34736, DOUBLE, *doubles)] if doubles else []
    return [*entries, entry(34737, ASCII, *name)]
