"""Format `geotiff`: the picture of the road from above in the coordinate reference system that the user names.

Its cells stay as they are, bit by bit: the file says where its first one is in the system, and how rows and columns go
there. Such an affine map is no projection, but over the kilometres of a scene it is one to within a part of a cell. A
scene where it is not is refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS
from scipy.spatial import cKDTree

from mrasfm_engine.errors import InputError
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportOptions, ExportSource, ExportWork, Written
from mrasfm_engine.export.projection_readback import projected
from mrasfm_engine.geometry import utm
from mrasfm_engine.geometry.earth_system import EarthSystem, named_system
from mrasfm_engine.io import tiff
from mrasfm_engine.io.read_scene import read_json
from mrasfm_engine.types import Floats, Ints
from schemas.artifacts import REPORT_FILE, ROAD_TIFF_FILE, road_not_drawn

FILE = "road.tif"
WIDTH, TILE_SIDE = 256, 322  # tags
MODEL_TRANSFORMATION, KEYS = tiff.GEO_TAGS[:2]
PROJECTED, AREA = 1, 1  # of GeoKeys 1024 and 1025: the model, and what a cell is
GEO_KEYS = (1024, 1025, 3072)
MOST_OFF_CELLS = 0.5
PART_BYTES = 1 << 24


class Picture(NamedTuple):
    """A tiled TIFF with its levels, finest first."""

    path: Path
    levels: list[dict[int, tiff.Entry]]

    def numbers(self, tag: int, level: int = 0) -> Ints:
        """Whole numbers of an entry."""
        _, kind, value = self.levels[level][tag]
        return np.frombuffer(value, f"<{tiff.FORMAT[kind]}").astype(np.int64)

    @property
    def world_from_pixel(self) -> Floats:
        """Affine map (2, 3) of (u, v, 1) of the finest level, whose top left corner is at (0, 0)."""
        matrix: Floats = np.frombuffer(self.levels[0][MODEL_TRANSFORMATION][2], "<f8").reshape(4, 4)[:2, [0, 1, 3]]
        return matrix

    def corners(self) -> Floats:
        """Pixels (n, 2) of the corners of the finest level's tiles that show anything."""
        offsets, side = self.numbers(tiff.TILE_OFFSETS), int(self.numbers(TILE_SIDE)[0])
        columns = -(-int(self.numbers(WIDTH)[0]) // side)
        # All tiles that show nothing are one, the first of the file.
        first = min(int(self.numbers(tiff.TILE_OFFSETS, level).min()) for level in range(len(self.levels)))
        shown = np.flatnonzero(offsets != first)
        shown = shown if len(shown) else np.arange(len(offsets))
        places = np.stack([shown % columns, shown // columns], -1)
        around = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        return np.unique((places[:, None] + around).reshape(-1, 2), axis=0) * float(side)


class PlacedPicture(NamedTuple):
    """A picture and its place in a coordinate reference system."""

    picture: Picture
    system: EarthSystem
    system_from_pixel: Floats
    off_cells: float


def write_geotiff_in_crs(work: ExportWork) -> Written:
    """Write `road.tif`; the scene must be georeferenced.

    Raises
    ------
    InputError
        Where the scene has no picture of its road, or is too large for an affine map.
    """
    source = work.source
    picture, system, system_from_pixel, off_cells = placed_picture(source, work.options)
    digest = _write(picture, work.folder / FILE, system_from_pixel, system)
    compare = partial(_compare, source, picture, system.name)
    notes = [
        f"coordinates are in {system.name.partition('+')[0]}; cells are off by up to {off_cells:.2g} cells",
        *system.notes(),
    ]
    return Written(checks=[Check(FILE, read_picture, compare)], digests={FILE: digest}, notes=notes)


def placed_picture(source: ExportSource, options: ExportOptions) -> PlacedPicture:
    """The picture of a georeferenced scene in a system, by default in UTM.

    Raises
    ------
    InputError
        As `write_geotiff_in_crs` does: before anything is written this tells whether it can be.
    """
    picture = _picture(source)
    place = source.scene.georeference
    assert place is not None
    system = named_system(options.crs or f"EPSG:{utm.epsg_code(*place.origin_deg)}", at=place.origin_deg)
    pixels = picture.corners()
    places = system.projected(on_the_ground(source, picture, pixels), place.ecef_from_local)[:, :2]
    system_from_pixel, off_cells = _fitted(pixels, places)
    if off_cells > MOST_OFF_CELLS:
        raise InputError(
            f"the picture of the road is too large for {system.name}: its cells would be off by up to "
            f"{off_cells:.1f} cells",
            remedy=f"Warp the scene's own {ROAD_TIFF_FILE} with gdalwarp -t_srs {system.name.partition('+')[0]}.",
            code="too-far",
        )
    return PlacedPicture(picture, system, system_from_pixel, off_cells)


def _picture(source: ExportSource) -> Picture:
    path = source.folder / ROAD_TIFF_FILE
    if not path.is_file():
        reason = road_not_drawn(
            read_json(source.folder / REPORT_FILE, remedy="Copy or download it again, or make it anew.")
        )
        raise InputError(
            f"{source.folder} has no {ROAD_TIFF_FILE}" + (f": {reason}" if reason else ""),
            remedy="Leave the format out: maps, and scenes whose pictures were not drawn, have no picture of a road.",
            code="no-picture",
        )
    try:
        return read_picture(path)
    except ValueError as error:
        remedy = "Copy it again, or make the scene anew."
        raise InputError(f"{path} is damaged: {error}", remedy=remedy, code="damaged-scene") from error


def read_picture(path: Path) -> Picture:
    """A picture's directories; ValueError where it has none."""
    levels = tiff.read_directories(path)
    needed = {WIDTH, TILE_SIDE, tiff.TILE_OFFSETS, tiff.TILE_SIZES}
    if not levels or not all(needed <= level.keys() for level in levels) or MODEL_TRANSFORMATION not in levels[0]:
        raise ValueError("it is no tiled picture with a place")
    return Picture(path, levels)


def on_the_ground(source: ExportSource, picture: Picture, pixels: Floats) -> Floats:
    """Local points (n, 3) of pixels (n, 2), at the height of the nearest unit.

    A metre of height moves a place by a millimetre where it is 6 km from the origin.
    """
    scene = source.scene
    xy = np.column_stack([pixels, np.ones(len(pixels))]) @ picture.world_from_pixel.T
    units = scene.world_from_rig[scene.unit_registered, :3, 3]
    nearest = cKDTree(units[:, :2]).query(xy)[1]
    return np.column_stack([xy, units[nearest, 2]])


def _fitted(pixels: Floats, places: Floats) -> tuple[Floats, float]:
    """Affine map (2, 3) from pixels (n, 2) to places (n, 2), and by how many cells it is off at most."""
    rows = np.column_stack([pixels, np.ones(len(pixels))])
    middle = places.mean(axis=0)  # coordinates are millions
    found = np.linalg.lstsq(rows, places - middle, rcond=None)[0].T
    off = np.linalg.norm(rows @ found.T + middle - places, axis=1).max()
    cell = np.sqrt(abs(np.linalg.det(found[:, :2])))
    found[:, 2] += middle
    return found, float(off / cell)


def _write(picture: Picture, path: Path, system_from_pixel: Floats, system: EarthSystem) -> str:
    """The picture with another place: its tiles follow new directories as they are."""
    matrix = np.zeros((4, 4))
    matrix[:2, [0, 1, 3]], matrix[3, 3] = system_from_pixel, 1.0
    values = (PROJECTED, AREA, system.horizontal)
    rows = [(key, 0, 1, value) for key, value in zip(GEO_KEYS, values, strict=True)]
    keys = [1, 1, 0, len(GEO_KEYS), *(number for row in rows for number in row)]
    placed = [
        tiff.entry(MODEL_TRANSFORMATION, tiff.DOUBLE, *matrix.ravel().tolist()),
        tiff.entry(KEYS, tiff.SHORT, *keys),
    ]
    left_out = {*tiff.GEO_TAGS, tiff.TILE_OFFSETS, tiff.TILE_SIZES}
    tags = [[entry for tag, entry in level.items() if tag not in left_out] for level in picture.levels]
    tags[0] += placed
    levels = range(len(picture.levels))
    offsets = [picture.numbers(tiff.TILE_OFFSETS, level).astype("<u8") for level in levels]
    sizes = [picture.numbers(tiff.TILE_SIZES, level).astype("<u8") for level in levels]
    first = min(int(own.min()) for own in offsets)
    start = tiff.HEADER_BYTES + len(tiff.directories(tags, offsets, sizes))
    moved = [own - np.uint64(first) + np.uint64(start) for own in offsets]
    digest = hashlib.sha256()
    with picture.path.open("rb") as source, path.open("wb") as file:
        source.seek(first)
        data = tiff.header() + tiff.directories(tags, moved, sizes)
        while data:
            digest.update(data)
            file.write(data)
            data = source.read(PART_BYTES)
    return digest.hexdigest()


def _compare(source: ExportSource, own: Picture, crs: str, found: Picture) -> Rows:
    """The system, the places of tiles as PROJ has them, and that all tiles are those of the scene's picture."""
    horizontal = crs.partition("+")[0]
    keys = found.numbers(KEYS)[4:].reshape(-1, 4).tolist()
    code = int(horizontal.removeprefix("EPSG:"))
    yield Row("its keys", keys, [[1024, 0, 1, 1], [1025, 0, 1, 1], [3072, 0, 1, code]])
    yield Row("its number of levels", len(found.levels), len(own.levels))
    for level in range(len(own.levels)):
        yield Row(f"what it says of level {level}", level_tags(found, level), level_tags(own, level))
        yield Row(f"the tiles of level {level}", _tiles(found, level), _tiles(own, level))
    place = source.scene.georeference
    assert place is not None
    corners = own.corners()
    expected = projected(place, on_the_ground(source, own, corners), CRS.from_epsg(code).to_3d())[:, :2]
    pixels = np.column_stack([corners, np.ones(len(corners))])
    cell = float(np.sqrt(abs(np.linalg.det(found.world_from_pixel[:, :2]))))
    yield Row("a tile's place", pixels @ found.world_from_pixel.T, expected, 1.01 * MOST_OFF_CELLS * cell)


def level_tags(picture: Picture, level: int) -> list[tiff.Entry]:
    """Entries of a level that do not say where it or its tiles are."""
    where = {*tiff.GEO_TAGS, tiff.TILE_OFFSETS}
    return sorted(entry for tag, entry in picture.levels[level].items() if tag not in where)


def _tiles(picture: Picture, level: int) -> str:
    """Digest of a level's tiles, one after the other."""
    digest = hashlib.sha256()
    places: Sequence[int] = picture.numbers(tiff.TILE_OFFSETS, level).tolist()
    with picture.path.open("rb") as file:
        for at, size in zip(places, picture.numbers(tiff.TILE_SIZES, level).tolist(), strict=True):
            file.seek(at)
            digest.update(file.read(size))
    return digest.hexdigest()
