"""The road from above as a mapping team wants it: a picture of the best views, and all its resolutions as a GeoTIFF."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export.picture_files import LargeFile
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bools, Bytes, Floats
from mrasfm_engine.visualization.geotiff import write_geotiff
from mrasfm_engine.visualization.ground import GroundTiles
from mrasfm_engine.visualization.mosaic import MAX_CELLS, MAX_SIDE_CELLS, MIN_CELL_M
from mrasfm_engine.visualization.plan import Plan
from mrasfm_engine.visualization.road_painter import RoadPainter
from mrasfm_engine.visualization.standing_points import StandingPoints
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile
from mrasfm_engine.visualization.tile_pyramid import TilePyramid, build_pyramid
from mrasfm_engine.visualization.views import Painter, View

PICTURE, WORLD_FILE, TIFF = "road.png", "road.pgw", "road.tif"
BLOCKS, TILES = "blocks", "tiles"  # in the scratch folder


@dataclass(frozen=True, kw_only=True)
class RoadPicture:
    """Pictures and other files by name, and what the report says of them."""

    pictures: dict[str, Bytes] = field(default_factory=dict)
    files: dict[str, bytes | LargeFile] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)


class OptionalPainter:
    """A painter whose first error ends its own work only, and calls `on_error` once; see `views.Painter`."""

    def __init__(self, painter: Painter, on_error: Callable[[], None] | None = None) -> None:
        self._painter = painter
        self._on_error = on_error
        self.error: Exception | None = None

    def paint(self, index: int, view: View, rgb: Bytes, usable: Bools | None) -> None:
        """Paint one view, unless an earlier one failed."""
        if self.error is None:
            try:
                self._painter.paint(index, view, rgb, usable)
            except Exception as error:  # whatever it is: the chequerboard does not depend on it
                self.error = error
                if self._on_error is not None:
                    self._on_error()


@contextmanager
def painting_road(plan: Plan, ground: GroundTiles, scratch: Path, own_car_m: Floats | None) -> Iterator[RoadPainter]:
    """A painter of the plan's road, whose tiles are in an empty folder until the context ends."""
    (scratch / BLOCKS).mkdir()
    try:
        with TileFile(scratch / TILES) as tiles:
            painter = RoadPainter(
                views=plan.views,
                ground=ground,
                standing=StandingPoints(plan.points_m, plan.seen_by),
                trajectory_m=plan.trajectory_m,
                folder=scratch / BLOCKS,
                tiles=tiles,
                own_car_m=own_car_m,
            )
            with closing(painter):
                yield painter
    finally:
        _remove_work(scratch)


def discard_road(painter: RoadPainter, scratch: Path) -> None:
    """Give back the disk space of a road that failed: the scene, which is still to be written, may need it."""
    painter.close()
    painter.tiles.close()  # an open file would keep its space
    _remove_work(scratch)
    (scratch / TIFF).unlink(missing_ok=True)


def _remove_work(scratch: Path) -> None:
    shutil.rmtree(scratch / BLOCKS, ignore_errors=True)
    (scratch / TILES).unlink(missing_ok=True)


def finish_road(scene: Scene, plan: Plan, painter: RoadPainter, scratch: Path, error: Exception | None) -> RoadPicture:
    """Write the pictures of a road that all views have painted; none, but the reason, where that failed with an
    error."""
    if error is None:
        try:
            return _finished(scene, plan, painter, scratch)
        except Exception as problem:  # as above
            error = problem
    discard_road(painter, scratch)
    reason = error.what if isinstance(error, MrasfmError) else f"{type(error).__name__}: {error}"
    return RoadPicture(report={"not_drawn": reason})


def _finished(scene: Scene, plan: Plan, painter: RoadPainter, scratch: Path) -> RoadPicture:
    painter.finish()
    pyramid = build_pyramid(painter.tiles)
    painter.tiles.flush()
    if pyramid is None:
        return RoadPicture(report={"not_drawn": "the views of the road agree nowhere"})
    side_m = TILE_CELLS * MIN_CELL_M
    left_m, top_m = pyramid.first_column * side_m, -pyramid.first_row * side_m
    digest = write_geotiff(
        scratch / TIFF, pyramid, plan.world_from_pixel(left_m, top_m, MIN_CELL_M), place=scene.georeference
    )
    picture, (left_m, top_m), cell_m = _overview(pyramid, left_m, top_m)
    world_from_pixel = plan.world_from_pixel(left_m, top_m, cell_m)
    cells, area_m2 = painter.cells, MIN_CELL_M**2
    report = {
        "images": painter.images_used,
        "cell_m": cell_m,
        "world_from_pixel": world_from_pixel.tolist(),
        "tiff": {
            "levels": pyramid.levels,
            "cell_m": [MIN_CELL_M * 2**level for level in range(pyramid.levels)],
            "tiles": [len(pyramid.file.indices(level)) for level in range(pyramid.levels)],
        },
        "ground_seen_m2": cells.seen * area_m2,
        "left_out_share": cells.left_out / max(cells.seen, 1),
        "seen_from_one_place_share": cells.single / max(cells.seen, 1),
    }
    files: dict[str, bytes | LargeFile] = {
        WORLD_FILE: world_file(world_from_pixel).encode(),
        TIFF: LargeFile(scratch / TIFF, digest),
    }
    return RoadPicture(pictures={PICTURE: picture}, files=files, report=report)


def _overview(pyramid: TilePyramid, left_m: float, top_m: float) -> tuple[Bytes, tuple[float, float], float]:
    """The finest level that fits into one picture, cut to what is seen; its top left corner and its cells' size."""
    level = pyramid.level_within(max_cells=MAX_CELLS, max_side_cells=MAX_SIDE_CELLS)
    picture, cell_m = pyramid.picture(level), MIN_CELL_M * 2**level
    rows, columns = (np.flatnonzero((picture[..., 3] > 0).any(axis=k)) for k in (1, 0))
    cut = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return cut, (left_m + columns[0] * cell_m, top_m - rows[0] * cell_m), cell_m


def world_file(world_from_pixel: Floats) -> str:
    """Text of an ESRI world file: the map (2, 3), for the centre of the top left pixel at (0, 0)."""
    a = world_from_pixel
    centre = a @ [0.5, 0.5, 1.0]
    return "".join(f"{value:.10g}\n" for value in (a[0, 0], a[1, 0], a[0, 1], a[1, 1], *centre))
