"""A tile pyramid as a tiled BigTIFF with overviews, placed on the earth where the scene is.

One file of any size that QGIS, GDAL and libtiff open as it is, and that is read in parts, over HTTP too: the layout is
that of a cloud-optimised GeoTIFF, all directories first and the coarsest tiles before finer ones.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from itertools import chain
from pathlib import Path

import numpy as np

from mrasfm_engine.scene.scene import Georeference
from mrasfm_engine.types import Floats
from mrasfm_engine.visualization.tile_file import PREDICTED, TILE_CELLS, predicted
from mrasfm_engine.visualization.tile_pyramid import TilePyramid

_SHORT, _LONG, _DOUBLE, _ASCII, _LONG8 = 3, 4, 12, 2, 16
_FORMAT = {_SHORT: "H", _LONG: "I", _DOUBLE: "d", _ASCII: "B", _LONG8: "Q"}
_DEFLATE, _RGB, _UNASSOCIATED_ALPHA, _REDUCED = 8, 2, 2, 1
_HEADER_BYTES = 16

Entry = tuple[int, int, bytes]  # tag, type, values


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
    start = _HEADER_BYTES + len(_directories(tags, offsets, sizes))
    end = start + len(empty)
    for level in reversed(range(pyramid.levels)):
        offsets[level][:] = start  # all tiles without content are one
        for index in present[level]:
            number = pyramid.number(index)
            offsets[level][number], sizes[level][number] = end, pyramid.file.size_bytes(index)
            end += pyramid.file.size_bytes(index)
    digest = hashlib.sha256()
    with path.open("wb") as file:
        head = struct.pack("<2sHHHQ", b"II", 43, 8, 0, _HEADER_BYTES) + _directories(tags, offsets, sizes) + empty
        tiles = (pyramid.file.compressed(index) for level in reversed(present) for index in level)
        for data in chain([head], tiles):
            digest.update(data)
            file.write(data)
    return digest.hexdigest()


def _level_tags(pyramid: TilePyramid, level: int) -> list[Entry]:
    height, width = pyramid.shape(level)
    return [
        _entry(254, _LONG, 0 if level == 0 else _REDUCED),
        _entry(256, _LONG, width),
        _entry(257, _LONG, height),
        _entry(258, _SHORT, 8, 8, 8, 8),
        _entry(259, _SHORT, _DEFLATE),
        _entry(262, _SHORT, _RGB),
        _entry(277, _SHORT, 4),
        _entry(284, _SHORT, 1),
        _entry(317, _SHORT, PREDICTED),
        _entry(322, _LONG, TILE_CELLS),
        _entry(323, _LONG, TILE_CELLS),
        _entry(338, _SHORT, _UNASSOCIATED_ALPHA),
        _entry(339, _SHORT, 1, 1, 1, 1),
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
    entries = [_entry(34264, _DOUBLE, *matrix.ravel()), _entry(34735, _SHORT, *directory)]
    entries += [_entry(34736, _DOUBLE, *doubles)] if doubles else []
    return [*entries, _entry(34737, _ASCII, *name)]


def _entry(tag: int, kind: int, *values: float) -> Entry:
    return tag, kind, struct.pack(f"<{len(values)}{_FORMAT[kind]}", *values)


def _directories(tags: list[list[Entry]], offsets: list[Floats], sizes: list[Floats]) -> bytes:
    """All directories, each followed by the values that do not fit into it."""
    data, at = b"", _HEADER_BYTES
    for level, (own, offset, size) in enumerate(zip(tags, offsets, sizes, strict=True)):
        entries = sorted([*own, (324, _LONG8, offset.tobytes()), (325, _LONG8, size.tobytes())])
        beyond = at + 8 + 20 * len(entries) + 8
        table, values = struct.pack("<Q", len(entries)), b""
        for tag, kind, value in entries:
            count = len(value) // struct.calcsize(_FORMAT[kind])
            inline = value.ljust(8, b"\0") if len(value) <= 8 else struct.pack("<Q", beyond + len(values))
            table += struct.pack("<HHQ", tag, kind, count) + inline
            values += b"" if len(value) <= 8 else value.ljust(-(-len(value) // 8) * 8, b"\0")
        end = beyond + len(values)
        data += table + struct.pack("<Q", 0 if level == len(tags) - 1 else end) + values
        at = end
    return data
