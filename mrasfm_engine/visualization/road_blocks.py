"""Blocks of road that are under way, as many as fit into bounded memory, the others on disk."""

from __future__ import annotations

import shutil
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import StorageError
from mrasfm_engine.types import Floats
from mrasfm_engine.visualization.road_candidates import Candidates
from mrasfm_engine.visualization.road_consensus import COHERENCE_CELLS
from mrasfm_engine.visualization.tile_file import TILE_CELLS

APRON_CELLS = COHERENCE_CELLS  # around a block, so that its border is decided as its middle is
MAX_BLOCKS = 48  # in memory, of 5 MB each: a view reaches 36 at most
# Left free on the disk, for the scene and for the tiles and the GeoTIFF of the blocks.
MIN_FREE_BYTES = 4_000_000_000

Block = tuple[int, int]  # row, growing downwards, and column


class BlockPlan:
    """Blocks along a path, and those that a view may reach.

    Parameters
    ----------
    trajectory_m
        Positions (n, 2) of the vehicle; no two neighbours farther apart than a block's side are needed.
    radius_m
        How far from the trajectory blocks are wanted.
    """

    def __init__(self, trajectory_m: Floats, *, cell_m: float, radius_m: float) -> None:
        self._cell_m = cell_m
        self.wanted = {block for place in trajectory_m for block in self._around(place, radius_m)}

    def reached(self, centre_m: Floats, reach_m: float) -> list[Block]:
        """Wanted blocks that have a cell, the apron's included, within a distance of a place (2,)."""
        around = self._around(centre_m, reach_m + APRON_CELLS * self._cell_m)
        return [block for block in around if block in self.wanted]

    def _around(self, centre_m: Floats, reach_m: float) -> list[Block]:
        side_m = TILE_CELLS * self._cell_m
        x, y = float(centre_m[0]), -float(centre_m[1])
        rows = range(int((y - reach_m) // side_m), int((y + reach_m) // side_m) + 1)
        columns = range(int((x - reach_m) // side_m), int((x + reach_m) // side_m) + 1)
        return [
            (row, column)
            for row in rows
            for column in columns
            if _beyond(y, row, side_m) ** 2 + _beyond(x, column, side_m) ** 2 <= reach_m**2
        ]


def _beyond(at_m: float, number: int, side_m: float) -> float:
    """Distance to the interval that a row or column of blocks covers."""
    return max(number * side_m - at_m, at_m - (number + 1) * side_m, 0.0)


class BlockStore:
    """Candidates of blocks; those that were not used for longest move to a folder when there are too many."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._active: OrderedDict[Block, Candidates] = OrderedDict()
        self._on_disk: set[Block] = set()

    def get(self, blocks: Sequence[Block]) -> list[Candidates]:
        """Candidates of blocks, empty at first; they stay in memory at least until others are asked for."""
        for block in blocks:
            if block not in self._active:
                self._active[block] = self._load(block) if block in self._on_disk else _empty(block)
            self._active.move_to_end(block)
        while len(self._active) > max(MAX_BLOCKS, len(blocks)):
            self._save(*self._active.popitem(last=False))
        return [self._active[block] for block in blocks]

    def pop(self, block: Block) -> Candidates | None:
        """Take a finished block out; None where nothing was added to it."""
        if block in self._active:
            return self._active.pop(block)
        return self._load(block) if block in self._on_disk else None

    def _path(self, block: Block) -> Path:
        return self._folder / f"block {block[0]} {block[1]}.npz"

    def _save(self, block: Block, candidates: Candidates) -> None:
        if shutil.disk_usage(self._folder).free < MIN_FREE_BYTES:
            raise StorageError(
                f"the disk has less than {MIN_FREE_BYTES / 1e9:.0f} GB free, which are left to the scene",
                remedy="Free space on the disk of the scene.",
            )
        np.savez(self._path(block), **{name: getattr(candidates, name) for name in _ARRAYS})
        self._on_disk.add(block)

    def _load(self, block: Block) -> Candidates:
        with np.load(self._path(block)) as arrays:
            candidates = Candidates(row=_first(block[0]), column=_first(block[1]), **{n: arrays[n] for n in _ARRAYS})
        self._path(block).unlink()
        self._on_disk.discard(block)
        return candidates


_ARRAYS: Sequence[str] = ("count", "color", "quality", "place")


def _first(number: int) -> int:
    return number * TILE_CELLS - APRON_CELLS


def _empty(block: Block) -> Candidates:
    return Candidates.empty(row=_first(block[0]), column=_first(block[1]), side=TILE_CELLS + 2 * APRON_CELLS)
