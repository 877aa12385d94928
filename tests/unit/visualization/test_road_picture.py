"""The picture of the best views of a ground whose pattern is known."""

from __future__ import annotations

import shutil
import time
import tracemalloc
from functools import cache
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import StorageError
from mrasfm_engine.visualization import road_blocks, road_picture
from mrasfm_engine.visualization import road_painter as road_painter_module
from mrasfm_engine.visualization.ground import GroundTiles
from mrasfm_engine.visualization.mosaic import MIN_CELL_M
from mrasfm_engine.visualization.road_painter import RoadPainter
from mrasfm_engine.visualization.road_picture import BLOCKS, TILES, OptionalPainter, discard_road, finish_road
from mrasfm_engine.visualization.standing_points import SIDE, STEP_M, StandingPoints
from mrasfm_engine.visualization.tile_file import TILE_CELLS, TileFile
from mrasfm_engine.visualization.tile_pyramid import build_pyramid
from mrasfm_engine.visualization.views import AHEAD, View, paint_views, place_view
from tests.helpers.export_example import make_scene
from tests.helpers.painted_ground import HEIGHT_M, Level, looking, pattern, photographed, view_of

WAY_M = np.arange(0.0, 10.0)
NOTHING = np.zeros((0, 3))
DEADLINE_S = 60.0


@cache
def photo(yaw_deg: float, x_m: float) -> np.ndarray:
    """What a camera at x_m sees that looks to the side by so much; nobody writes into it."""
    return photographed("PINHOLE", looking(yaw_deg, x_m))


def shots(
    places_m: np.ndarray = WAY_M, *, gains: tuple[float, float] = (1.0, 1.0)
) -> tuple[list[View], list[np.ndarray]]:
    """Two cameras go along, and see much of the same ground."""
    views, images = [], []
    for x in places_m:
        for camera, (yaw, gain) in enumerate(zip((0.0, 40.0), gains, strict=True)):
            pose = looking(yaw, float(x))
            view = view_of("PINHOLE", camera, pose)
            views.append(View(**{**view.__dict__, "place": 2 * int(x // 2) + camera}))
            images.append((gain * photo(yaw, float(x))).clip(0, 255).astype(np.uint8))
    return views, images


def road_painter(
    views: list[View], folder: Path, *, standing_m: np.ndarray = NOTHING, radius_m: float = 12.0
) -> RoadPainter:
    """A painter whose files are in a folder."""
    (folder / BLOCKS).mkdir(parents=True)
    return RoadPainter(
        views=views,
        ground=GroundTiles(Level()),
        standing=StandingPoints(standing_m, [np.arange(len(standing_m))] * len(views)),
        trajectory_m=np.array([view.plan_from_cam[1][:2, 3] for view in views]),
        folder=folder / BLOCKS,
        tiles=TileFile(folder / TILES),
        own_car_m=None,
        radius_m=radius_m,
    )


def road_of(
    folder: Path,
    views: list[View],
    images: list[np.ndarray],
    *,
    standing_m: np.ndarray = NOTHING,
    radius_m: float = 12.0,
    masks: dict[int, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, RoadPainter]:
    """The finest level (h, w, 4), the places (h, w, 2) that it shows, and the painter."""
    painter = road_painter(views, folder, standing_m=standing_m, radius_m=radius_m)
    with painter.tiles:
        paint_views(views, lambda i: (images[i], (masks or {}).get(i)), [painter])
        painter.finish()
        pyramid = build_pyramid(painter.tiles)
        assert pyramid is not None
        picture = pyramid.picture(0)
    rows, columns = np.arange(picture.shape[0]) + 0.5, np.arange(picture.shape[1]) + 0.5
    x = (pyramid.first_column * TILE_CELLS + columns) * MIN_CELL_M
    y = -(pyramid.first_row * TILE_CELLS + rows) * MIN_CELL_M
    return picture, np.stack(np.meshgrid(x, y), -1), painter


def error_of(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Difference (h, w) from the pattern; NaN where the picture is transparent."""
    return np.where(picture[..., 3] == 255, np.abs(picture[..., 0].astype(float) - pattern(places)), np.nan)


def beside_the_way(places: np.ndarray) -> np.ndarray:
    """Cells (h, w) that many views see from near."""
    return (np.abs(places[..., 1]) < 2.0) & (places[..., 0] > 4.0) & (places[..., 0] < 10.0)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray, RoadPainter]:
    return road_of(tmp_path_factory.mktemp("road"), *shots())


def test_every_cell_shows_its_own_place_also_at_the_borders_of_tiles(
    plain: tuple[np.ndarray, np.ndarray, RoadPainter],
) -> None:
    picture, places, painter = plain
    error, near = error_of(picture, places), beside_the_way(places)
    assert np.isfinite(error[near]).all()
    assert 0.1 < np.median(error[near]) < 3.0
    border = near & ((np.arange(picture.shape[1]) % TILE_CELLS)[None] < 1) | near & (
        (np.arange(picture.shape[0]) % TILE_CELLS)[:, None] < 1
    )
    assert border.sum() > 300
    assert np.median(error[border]) == pytest.approx(np.median(error[near]), rel=0.3)
    step = np.abs(np.diff(picture[..., 0].astype(float), axis=1))
    across = np.arange(1, picture.shape[1]) % TILE_CELLS == 0
    both = near[:, 1:] & near[:, :-1]
    assert step[:, across][both[:, across]].mean() == pytest.approx(step[both].mean(), rel=0.4)
    assert painter.images_used == len(painter.views)
    assert painter.cells.seen > near.sum()


def test_a_car_that_moved_on_is_outvoted(tmp_path: Path, plain: tuple[np.ndarray, np.ndarray, RoadPainter]) -> None:
    views, images = shots()
    for i in (4, 5):  # both cameras see a white car everywhere, at one place of the path
        images[i][:] = 255
    picture, places, _ = road_of(tmp_path, views, images)
    error, near = error_of(picture, places), beside_the_way(places)
    assert np.nanmedian(error[near]) < 3.0
    assert (error[near] > 30).mean() < 0.02


def test_what_no_two_views_agree_on_is_left_out(tmp_path: Path) -> None:
    views, images = shots()
    rng = np.random.default_rng(1)
    for image in images:
        image[:] = rng.integers(20, 235, 3)
    picture, places, painter = road_of(tmp_path, views, images)
    near = beside_the_way(places)
    assert (picture[..., 3][near] == 0).mean() > 0.6
    assert painter.cells.left_out > 0.3 * painter.cells.seen


def test_masked_pixels_are_not_shown(tmp_path: Path) -> None:
    views, images = shots(np.array([0.0]))
    nothing = np.zeros(images[0].shape[:2], dtype=np.bool_)
    left = nothing.copy()
    left[:, : left.shape[1] // 2] = True
    picture, places, _ = road_of(tmp_path, views, images, masks={0: left, 1: nothing})
    shown = picture[..., 3] > 0
    assert shown.sum() > 1000
    assert (places[shown][:, 1] > -0.3).all()  # the left half of the image is the left of the road


def test_cameras_of_different_exposure_are_evened(tmp_path: Path) -> None:
    picture, places, _ = road_of(tmp_path, *shots(gains=(1.0, 0.75)))
    truth, near = pattern(places), beside_the_way(places) & (picture[..., 3] == 255)
    ratio = (picture[..., 0] / truth)[near]
    assert np.quantile(ratio, 0.9) / np.quantile(ratio, 0.1) < 1.12  # of 1.33


def test_things_that_stand_hide_the_ground_behind_them(tmp_path: Path) -> None:
    height = 0.5 * HEIGHT_M
    post = np.array([[6.0, y, height] for y in np.linspace(-0.3, 0.3, 5)])
    view, ground = view_of("PINHOLE", 0, looking(0.0, 0.0)), GroundTiles(Level())
    placed = place_view(view, ground)
    assert placed is not None
    assert placed.above_ground_m == pytest.approx(HEIGHT_M)
    hidden = StandingPoints(post, [np.arange(5)]).hidden_from(0, placed)
    ahead = hidden[SIDE // 2, SIDE // 2 :]
    at_m = np.flatnonzero(ahead) * STEP_M
    # The ray over a thing half as high as the camera meets the ground at twice its distance.
    assert (at_m.min(), at_m.max()) == pytest.approx((6.0, 12.0), abs=0.4)
    assert not hidden[:, : SIDE // 2].any()
    picture, places, _ = road_of(tmp_path, *shots(), standing_m=post)
    under = (np.abs(places[..., 0] - 6.0) < 0.1) & (np.abs(places[..., 1]) < 0.2)
    assert (picture[..., 3][under] == 0).all()


def test_blocks_on_disk_make_the_same_picture(
    tmp_path: Path, plain: tuple[np.ndarray, np.ndarray, RoadPainter], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = []
    keep = road_blocks.BlockStore._save
    monkeypatch.setattr(road_blocks, "MAX_BLOCKS", 2)
    monkeypatch.setattr(road_blocks, "MIN_FREE_BYTES", 0)  # whatever the disk of the test has left
    monkeypatch.setattr(road_blocks.BlockStore, "_save", lambda *a: saved.append(a[1]) or keep(*a))
    picture, _, _ = road_of(tmp_path, *shots())
    assert saved
    np.testing.assert_array_equal(picture, plain[0])
    assert not list((tmp_path / BLOCKS).iterdir())


def test_blocks_leave_space_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = road_blocks.BlockStore(tmp_path)
    monkeypatch.setattr(road_blocks, "MAX_BLOCKS", 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=road_blocks.MIN_FREE_BYTES - 1))
    store.get([(0, 0)])
    with pytest.raises(StorageError, match="less than 4 GB free"):
        store.get([(0, 1)])
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_road_leaves_only_the_road_out() -> None:
    painted = []

    class FullDisk:
        def paint(self, index: int, *_: object) -> None:
            painted.append(index)
            raise OSError(28, "No space left on device")

    optional = OptionalPainter(FullDisk())
    views, images = shots(np.array([0.0, 1.0]))
    paint_views(views, lambda i: (images[i], None), [optional])
    assert painted == [0]
    assert "No space" in str(optional.error)


@pytest.mark.parametrize("at_once", [True, False])
def test_a_block_that_cannot_be_decided_ends_the_road(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: bool
) -> None:
    """Where a block fails, one of the next says so, or the end does; the disk is given back."""
    views, images = shots(np.arange(0.0, 31.0, 5.0) if at_once else np.array([0.0]))
    painter, failing = road_painter(views, tmp_path, radius_m=1.0), Event()

    def full(*_: object) -> None:
        failing.wait(DEADLINE_S)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(painter.tiles, "add", full)
    if at_once:
        failing.set()
    optional = OptionalPainter(painter, on_error=lambda: discard_road(painter, tmp_path))
    paint_views(views, lambda i: (images[i], None), [optional])
    assert (optional.error is not None) == at_once
    failing.set()
    if optional.error is None:
        with pytest.raises(OSError, match="No space"):
            painter.finish()
        discard_road(painter, tmp_path)
    assert painter.tiles._file.closed
    assert not list(tmp_path.iterdir())


def test_a_road_is_discarded_while_a_block_is_decided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views, images = shots(np.arange(0.0, 31.0, 5.0))
    painter, deciding, added = road_painter(views, tmp_path), Event(), []
    add = painter.tiles.add

    def slowly(*tile: Any) -> None:
        deciding.set()
        time.sleep(0.2)
        add(*tile)  # into a file that must still be open
        added.append(tile)

    monkeypatch.setattr(painter.tiles, "add", slowly)
    paint_views(views, lambda i: (images[i], None), [painter])
    assert deciding.wait(DEADLINE_S)
    discard_road(painter, tmp_path)
    assert painter.tiles._file.closed
    assert added
    ended = [future for future in painter._undecided if not future.cancelled()]
    assert all(future.exception(0) is None for future in ended)


def test_painters_are_a_few_views_apart_at_most() -> None:
    """One that waits holds up the other only after a while; what fails in one ends both."""
    slow, fast, behind = [], [], Event()
    views, images = shots(np.arange(0.0, 12.0))

    class Slow:
        def paint(self, index: int, *_: object) -> None:
            assert index > 0 or behind.wait(DEADLINE_S)
            if index == 6:
                raise MemoryError
            slow.append(index)

    class Fast:
        def paint(self, index: int, *_: object) -> None:
            fast.append(index)
            if index == AHEAD:
                assert slow == []
                behind.set()

    with pytest.raises(MemoryError):
        paint_views(views, lambda i: (images[i], None), [Slow(), Fast()])
    assert slow[:6] == list(range(6))
    assert fast == list(range(len(fast)))
    assert AHEAD < len(fast) < len(views)


def test_a_road_that_fails_leaves_nothing_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        (tmp_path / "road.tif").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(road_picture, "_finished", full)
    for fail in (
        lambda painter: finish_road(make_scene(), None, painter, tmp_path, None),
        lambda painter: finish_road(make_scene(), None, painter, tmp_path, MemoryError()),
        lambda painter: discard_road(painter, tmp_path),
    ):
        (tmp_path / "blocks").mkdir()
        (tmp_path / "blocks" / "block 0 0.npz").write_bytes(b"block")
        tiles = TileFile(tmp_path / "tiles")
        fail(SimpleNamespace(tiles=tiles, close=lambda: None))
        assert tiles._file.closed
        assert not list(tmp_path.iterdir())


def test_tiles_close_on_a_full_disk() -> None:
    with TileFile(Path("/dev/full")) as tiles:
        tiles._file.write(b"tile")
        with pytest.raises(OSError, match="No space"):
            tiles.flush()


def test_memory_does_not_grow_with_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(road_painter_module, "UNDECIDED_BLOCKS", 1)  # how many wait is the processor's to say
    image = photographed("PINHOLE", looking(0.0, 0.0))
    peak = []
    for length_m in (40.0, 100.0):
        views, _ = shots(np.arange(0.0, length_m + 1, 5.0))
        tracemalloc.start()
        painter = road_painter(views, tmp_path / f"{length_m}", radius_m=1.0)
        with painter.tiles:
            paint_views(views, lambda _: (image, None), [painter])
            painter.finish()
            pyramid = build_pyramid(painter.tiles)
        peak.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert pyramid is not None
        assert pyramid.shape(0)[1] * MIN_CELL_M > length_m
    assert peak[0] > 20e6
    assert peak[1] < 1.15 * peak[0]
