"""A large picture at all its resolutions, each level half as fine as the one before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Bytes
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile, TileIndex


@dataclass(frozen=True, kw_only=True)
class TilePyramid:
    """Levels of a picture whose tiles lie in a file; in rows and columns from its own first ones.

    Attributes
    ----------
    first_row, first_column
        Of the finest level's tiles as they were added.
    tiles
        Per level, finest first: rows and columns of tiles.
    """

    file: TileFile
    first_row: int
    first_column: int
    tiles: tuple[tuple[int, int], ...]

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.tiles)

    def shape(self, level: int) -> tuple[int, int]:
        """Height and width of a level in cells."""
        rows, columns = self.tiles[0]
        height, width = (-(-n * TILE_CELLS // 2**level) for n in (rows, columns))
        return height, width

    def index(self, level: int, row: int, column: int) -> TileIndex:
        """The index in the file of a tile of this place."""
        if level == 0:
            return TileIndex(0, row + self.first_row, column + self.first_column)
        return TileIndex(level, row, column)

    def place(self, index: TileIndex) -> tuple[int, int]:
        """The row and the column that a tile of the file has in its level."""
        if index.level == 0:
            return index.row - self.first_row, index.column - self.first_column
        return index.row, index.column

    def number(self, index: TileIndex) -> int:
        """The number of a tile in its level, in rows."""
        row, column = self.place(index)
        return row * self.tiles[index.level][1] + column

    def picture(self, level: int) -> Bytes:
        """A whole level (h, w, 4)."""
        rows, columns = self.tiles[level]
        whole = np.zeros((rows * TILE_CELLS, columns * TILE_CELLS, 4), np.uint8)
        for index in self.file.indices(level):
            row, column = self.place(index)
            whole[row * TILE_CELLS :, column * TILE_CELLS :][:TILE_CELLS, :TILE_CELLS] = self.file.get(index)
        height, width = self.shape(level)
        return whole[:height, :width]

    def level_within(self, *, max_cells: int, max_side_cells: int) -> int:
        """The finest level that is small enough for one picture."""
        for level in range(self.levels):
            height, width = self.shape(level)
            if height * width <= max_cells and max(height, width) <= max_side_cells:
                return level
        return self.levels - 1


def build_pyramid(file: TileFile) -> TilePyramid | None:
    """Make the coarser levels of a file's finest one, down to a single tile; None where there is no tile."""
    finest = file.indices(0)
    if not finest:
        return None
    rows, columns = [i.row for i in finest], [i.column for i in finest]
    tiles = [(max(rows) - min(rows) + 1, max(columns) - min(columns) + 1)]
    while max(tiles[-1]) > 1:
        tiles.append((-(-tiles[-1][0] // 2), -(-tiles[-1][1] // 2)))
    pyramid = TilePyramid(file=file, first_row=min(rows), first_column=min(columns), tiles=tuple(tiles))
    for level in range(1, pyramid.levels):
        _build_level(pyramid, level)
    return pyramid


def _build_level(pyramid: TilePyramid, level: int) -> None:
    below = pyramid.file.indices(level - 1)
    wanted = sorted({(row // 2, column // 2) for row, column in map(pyramid.place, below)})
    half = TILE_CELLS // 2
    for row, column in wanted:
        tile = np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
        for i in (0, 1):
            for j in (0, 1):
                part = pyramid.file.get(pyramid.index(level - 1, 2 * row + i, 2 * column + j))
                tile[i * half : (i + 1) * half, j * half : (j + 1) * half] = halved(part)
        pyramid.file.add(TileIndex(level, row, column), tile)


def halved(tile: Bytes) -> Bytes:
    """Half as many rows and columns (h, w, 4): the mean of every four cells, by their opacity."""
    result: Bytes = np.empty((tile.shape[0] // 2, tile.shape[1] // 2, 4), np.uint8)
    _halve(tile, result)
    return result


@njit(cache=True, nogil=True)
def _halve(tile: Any, result: Any) -> None:
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            total: Any = np.int64(0)  # of unsigned numbers numba makes floats
            for a in range(4):
                total += tile[2 * i + a // 2, 2 * j + a % 2, 3]
            for k in range(3):
                color: Any = total // 2
                for a in range(4):
                    cell = tile[2 * i + a // 2, 2 * j + a % 2]
                    color += np.int64(cell[k]) * np.int64(cell[3])
                result[i, j, k] = color // max(total, 1)
            result[i, j, 3] = (total + 2) // 4
