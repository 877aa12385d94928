"""Paints the road, block by block along the path, in time by its length and in bounded memory.

Views come in the order of the path, those of a second visit with those of the first. A block is under way while views
may still reach it, then decided, written and forgotten, while the next views are painted.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mrasfm_engine.parallel import in_order
from mrasfm_engine.types import Bools, Bytes, Floats
from mrasfm_engine.visualization.ground import GroundTiles
from mrasfm_engine.visualization.mosaic import MIN_CELL_M, RADIUS_M
from mrasfm_engine.visualization.road_blocks import APRON_CELLS, Block, BlockPlan, BlockStore
from mrasfm_engine.visualization.road_candidates import Candidates, Shot, add_view, log_ratios
from mrasfm_engine.visualization.road_consensus import find_consensus
from mrasfm_engine.visualization.running_gains import RunningGains
from mrasfm_engine.visualization.standing_points import StandingPoints
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile, TileIndex
from mrasfm_engine.visualization.views import REFINED, VIEW_M, PlacedView, View, place_view

UNDECIDED_BLOCKS = 8  # that may wait in memory, of 5 MB each


@dataclass
class Cells:
    """Counts of cells of the road: seen by any view, left out of them, and shown from one place only."""

    seen: int = 0
    left_out: int = 0
    single: int = 0


@dataclass(frozen=True, kw_only=True)
class _Prepared:
    """A view before it is painted: the blocks that it may reach, and what hides them."""

    index: int
    reached: list[Block]
    placed: PlacedView | None  # None where it sees no ground
    hidden: Bools  # see `StandingPoints.hidden_from`


@dataclass(kw_only=True)
class RoadPainter:
    """See `views.Painter`.

    Parameters
    ----------
    trajectory_m
        Positions (n, 2) of the vehicle.
    folder
        An empty one, for blocks that do not fit into memory.
    tiles
        Takes the finished blocks.
    own_car_m
        See `MosaicPainter`.
    """

    views: Sequence[View]
    ground: GroundTiles
    standing: StandingPoints
    trajectory_m: Floats
    folder: Path
    tiles: TileFile
    own_car_m: Floats | None
    radius_m: float = RADIUS_M  # beside the trajectory
    cells: Cells = field(default_factory=Cells)
    images_used: int = 0

    def __post_init__(self) -> None:
        """Count the views that may reach every block."""
        self._cameras = 1 + max((view.camera for view in self.views), default=0)
        self._plan = BlockPlan(self.trajectory_m, cell_m=MIN_CELL_M, radius_m=self.radius_m)
        self._store = BlockStore(self.folder)
        self._gains = RunningGains(self._cameras)
        self._left = Counter(block for view in self.views for block in self._reached(view))
        self._prepared = in_order(1, self._prepare, range(len(self.views)))
        self._decider = ThreadPoolExecutor(1)
        self._undecided: deque[Future[None]] = deque()

    def paint(self, index: int, view: View, rgb: Bytes, usable: Bools | None) -> None:
        """Paint one view; see `views.Painter`."""
        prepared = next(self._prepared)
        assert prepared.index == index, "views come in order, and none is left out"
        if prepared.placed is not None:
            shot = Shot(
                view=view,
                placed=prepared.placed,
                rgb=rgb,
                usable=usable,
                hidden=prepared.hidden,
                own_car_m=self.own_car_m,
            )
            self._add(shot, self._store.get(_overlapping(prepared.reached, prepared.placed)))
        for block in prepared.reached:
            self._left[block] -= 1
            if not self._left[block]:
                del self._left[block]
                self._finish(block)

    def _prepare(self, index: int) -> _Prepared:
        """Do for a view what depends on no other one, while earlier ones are painted."""
        view = self.views[index]
        placed = place_view(view, self.ground, margin_m=APRON_CELLS * MIN_CELL_M)
        hidden = np.zeros((0, 0), np.bool_) if placed is None else self.standing.hidden_from(index, placed)
        return _Prepared(index=index, reached=self._reached(view), placed=placed, hidden=hidden)

    def finish(self) -> None:
        """Wait until all blocks are decided and written; raises what went wrong."""
        while self._undecided:
            self._undecided.popleft().result()
        self._decider.shutdown()

    def close(self) -> None:
        """End; blocks that nobody began to decide are left."""
        self._decider.shutdown(cancel_futures=True)
        self._prepared.close()

    def _reached(self, view: View) -> list[Block]:
        return self._plan.reached(view.plan_from_cam[REFINED][:2, 3], VIEW_M)

    def _add(self, shot: Shot, blocks: Sequence[Candidates]) -> None:
        view = shot.view
        ratios = [log_ratios(block, shot, view.gain, MIN_CELL_M, APRON_CELLS) for block in blocks]
        gain = view.gain * self._gains.factor(view.camera, np.concatenate([np.zeros(0), *ratios]))
        added = sum(add_view(block, shot, gain, MIN_CELL_M) for block in blocks)
        self.images_used += added > 0

    def _finish(self, block: Block) -> None:
        candidates = self._store.pop(block)
        if candidates is None or not candidates.count.any():
            return
        while self._undecided and (self._undecided[0].done() or len(self._undecided) >= UNDECIDED_BLOCKS):
            self._undecided.popleft().result()
        self._undecided.append(self._decider.submit(self._decide, block, candidates))

    def _decide(self, block: Block, candidates: Candidates) -> None:
        found = find_consensus(candidates, cameras=self._cameras)
        inside = slice(APRON_CELLS, -APRON_CELLS), slice(APRON_CELLS, -APRON_CELLS)
        agreed = found.agreed[inside]
        self.cells.seen += int(found.seen[inside].sum())
        self.cells.left_out += int((found.seen & ~found.agreed)[inside].sum())
        self.cells.single += int((found.single & found.agreed)[inside].sum())
        opacity = np.where(agreed, 255, 0).astype(np.uint8)
        self.tiles.add(TileIndex(0, *block), np.dstack([found.color[inside] * agreed[..., None], opacity]))


def _overlapping(blocks: Sequence[Block], placed: PlacedView) -> list[Block]:
    """Blocks that a view's footprint meets."""
    side_m, apron_m = TILE_CELLS * MIN_CELL_M, APRON_CELLS * MIN_CELL_M
    (left_m, bottom_m), (right_m, top_m) = (placed.low_m - apron_m).tolist(), (placed.high_m + apron_m).tolist()
    return [
        (row, column)
        for row, column in blocks
        if -(row + 1) * side_m < top_m and -row * side_m > bottom_m
        if column * side_m < right_m and (column + 1) * side_m > left_m
    ]
