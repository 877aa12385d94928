"""Square tiles of a large picture on disk, and its coarser levels.

Tiles come in any order and none is kept in memory; a coarser level is made of the four tiles below each of its own.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.types import Bytes

TILE_CELLS = 256
# Higher levels take twice as long and save a twentieth of a road's size.
COMPRESSION_LEVEL = 4
PREDICTED = 2  # TIFF's horizontal differences


@dataclass(frozen=True)
class TileIndex:
    """A tile's place: level 0 is the finest; rows go down."""

    level: int
    row: int
    column: int


class TileFile:
    """Compressed tiles (256, 256, 4), red, green, blue and opacity, appended to one file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b")
        self._entries: dict[TileIndex, tuple[int, int]] = {}

    def __enter__(self) -> TileFile:
        """Use it as a context that closes the file."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; what does not reach a full disk then is lost, see `flush`."""
        with suppress(OSError):
            self._file.close()

    def flush(self) -> None:
        """Write all that is held in memory, or raise."""
        self._file.flush()

    def add(self, index: TileIndex, tile: Bytes) -> None:
        """Write a tile; one without any opaque cell is left out."""
        if not tile[..., 3].any():
            return
        data = zlib.compress(predicted(tile), COMPRESSION_LEVEL)
        self._entries[index] = (self._file.seek(0, 2), len(data))
        self._file.write(data)

    def get(self, index: TileIndex) -> Bytes:
        """A tile; transparent where there is none."""
        if index not in self._entries:
            return np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
        return unpredicted(zlib.decompress(self.compressed(index)))

    def compressed(self, index: TileIndex) -> bytes:
        """The bytes that a TIFF holds of a tile."""
        start, size = self._entries[index]
        self._file.seek(start)
        return self._file.read(size)

    def size_bytes(self, index: TileIndex) -> int:
        """The size of a tile's bytes."""
        return self._entries[index][1]

    def indices(self, level: int) -> list[TileIndex]:
        """Tiles of a level, in rows."""
        return sorted((i for i in self._entries if i.level == level), key=lambda i: (i.row, i.column))


def predicted(tile: Bytes) -> bytes:
    """A tile with every cell as its difference to the one to the left."""
    difference = tile.copy()
    difference[:, 1:] -= tile[:, :-1]
    return difference.tobytes()


def unpredicted(data: bytes) -> Bytes:
    """The tile that `predicted` took."""
    difference = np.frombuffer(data, np.uint8).reshape(TILE_CELLS, TILE_CELLS, 4)
    tile: Bytes = np.cumsum(difference, axis=1, dtype=np.uint8)
    return tile
