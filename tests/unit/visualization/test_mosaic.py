"""The mosaic of a ground whose pattern is known, and what it says of two cameras' agreement."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.visualization.agreement import MAX_PLOTS, PLOT_SIDE_M, measure_agreement, plots_along
from mrasfm_engine.visualization.birds_eye import grids_along
from mrasfm_engine.visualization.drawing import framed
from mrasfm_engine.visualization.exposure import camera_gains
from mrasfm_engine.visualization.ground import GroundHeights, GroundTiles
from mrasfm_engine.visualization.mosaic import Grid, Mosaic, MosaicPainter
from mrasfm_engine.visualization.views import AHEAD, GIVEN, REFINED, Read, View, paint_views, sample
from tests.helpers.painted_ground import SIZE_PX, Level, Slope, looking, pattern, photographed, view_of
from tests.helpers.slow import slow

MAX_TEXTURE_PX = 16_384  # of browsers and graphics cards
WAY = np.column_stack([np.linspace(0, 8, 9), np.zeros(9)])
YAWS_DEG = (0.0, 40.0)  # of the two cameras, which see much of the same ground


def make_mosaics(
    views: Sequence[View],
    grids: Sequence[Grid],
    ground: GroundHeights,
    read: Read,
    *,
    own_car_m: np.ndarray | None,
    step: Callable[[int], None] = lambda done: None,
) -> list[Mosaic]:
    painter = MosaicPainter(grids, GroundTiles(ground), own_car_m=own_car_m)
    paint_views(views, read, [painter], step=step)
    return painter.mosaics()


def mosaic_of(
    views: list[View], images: list[np.ndarray], usable: np.ndarray | None = None, **options: object
) -> Mosaic:
    grid = Grid.around(WAY, max_cells=700_000)
    [mosaic] = make_mosaics(
        views,
        [grid],
        Level(),
        lambda i: (images[i], usable),
        own_car_m=None,
        **options,
    )
    return mosaic


def drive(model: str, *, turned_deg: float = 0.0, gains: tuple[float, float] = (1.0, 1.0)) -> Mosaic:
    """Two cameras go along; the second one's given pose is turned about the vertical."""
    return mosaic_of(*shots_of(model, turned_deg=turned_deg, gains=gains))


def shots_of(
    model: str, *, turned_deg: float = 0.0, gains: tuple[float, float] = (1.0, 1.0), way: np.ndarray = WAY
) -> tuple[list[View], list[np.ndarray]]:
    views, images = [], []
    for x in way[:, 0]:
        for camera, (yaw, gain) in enumerate(zip(YAWS_DEG, gains, strict=True)):
            pose = looking(yaw, float(x))
            given = looking(yaw + camera * turned_deg, float(x))
            views.append(view_of(model, camera, pose, given=given))
            images.append((gain * photographed(model, pose)).clip(0, 255).astype(np.uint8))
    return views, images


def corner(arm_m: float) -> np.ndarray:
    """A way (n, 2) that turns by 90 degrees halfway."""
    along = np.arange(0.0, arm_m, 2.0)
    first, second = np.column_stack([along, 0 * along]), np.column_stack([0 * along + arm_m, along])
    return np.concatenate([first, second])


def places(mosaic: Mosaic) -> np.ndarray:
    """Plan coordinates (rows, columns, 2) of the cells' centres."""
    grid = mosaic.grid
    x = grid.left_m + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.top_m - (np.arange(grid.rows) + 0.5) * grid.cell_m
    return np.stack(np.meshgrid(x, y), -1)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE", *slow("OPENCV")])
def test_every_cell_shows_its_own_place(model: str) -> None:
    mosaic = drive(model)
    truth = pattern(places(mosaic))
    near = (mosaic.score > 25.0) & (mosaic.owner > 0)
    for layer in (0, 1):
        cells = near[layer]
        assert cells.sum() > 5000
        error = np.abs(mosaic.color[REFINED, layer, ..., 0].astype(float) - truth)[cells]
        assert 0.1 < np.median(error) < 3.0
        np.testing.assert_array_equal(mosaic.color[GIVEN, layer], mosaic.color[REFINED, layer])
    both = (mosaic.owner > 0).all(axis=0)
    assert (mosaic.owner[0][both] != mosaic.owner[1][both]).all()
    assert (mosaic.score[0] >= mosaic.score[1]).all()
    assert mosaic.images_used == 2 * len(WAY)


def test_a_turned_camera_shows_as_displacement_and_lower_correlation() -> None:
    found = measure_agreement([drive("PINHOLE", turned_deg=2.0)], WAY)
    assert found is not None
    given, refined = found
    assert given.blocks == refined.blocks > 20
    assert 0.95 < refined.correlation < 1.0
    assert 0 < given.correlation < refined.correlation - 0.005
    assert 0 < refined.displacement_m < 0.02
    # 2 deg at the 2 m at which most of the ground is seen best
    assert 0.03 < given.displacement_m < 0.2


def test_what_is_known_of_a_shift_is_measured() -> None:
    mosaic = drive("PINHOLE")
    cells = 3
    shifted = pattern(places(mosaic) - [cells * mosaic.grid.cell_m, 0.0])
    exact = pattern(places(mosaic))
    mosaic.owner[:] = np.array([1, 2])[:, None, None]
    mosaic.color[:, 0] = exact[..., None].round()
    mosaic.color[GIVEN, 1] = shifted[..., None].round()
    mosaic.color[REFINED, 1] = exact[..., None].round()
    found = measure_agreement([mosaic], WAY)
    assert found is not None
    assert found[0].displacement_m == pytest.approx(cells * mosaic.grid.cell_m, abs=0.2 * mosaic.grid.cell_m)
    assert found[1].correlation == pytest.approx(1.0, abs=1e-3)
    mosaic.color[:] = 90
    assert measure_agreement([mosaic], WAY) is None  # plain asphalt


def test_masked_pixels_and_the_own_car_are_left_out() -> None:
    view, image = view_of("PINHOLE", 0, looking(0.0, 0.0)), photographed("PINHOLE", looking(0.0, 0.0))
    usable = np.ones(SIZE_PX[::-1], dtype=np.bool_)
    whole = mosaic_of([view], [image], usable)
    usable[:, : SIZE_PX[0] // 2] = False
    half = mosaic_of([view], [image], usable)
    y = places(whole)[..., 1]
    assert (whole.owner[0][y > 0.2] > 0).sum() > 1000
    assert not (half.owner[0][y > 0.2] > 0).any()
    np.testing.assert_array_equal(half.owner[0][y < -0.2], whole.owner[0][y < -0.2])
    car = np.array([[-1.0, -1.0], [3.0, 1.0]])
    grid = whole.grid
    [cut] = make_mosaics([view], [grid], Level(), lambda _: (image, None), own_car_m=car)
    inside = (np.abs(places(whole)[..., 0] - 1.0) < 2.0) & (np.abs(y) < 1.0)
    assert (whole.owner[0][inside] > 0).any()
    assert not (cut.owner[0][inside] > 0).any()
    assert (cut.owner[0][~inside] > 0).sum() > 1000


def test_a_camera_that_looks_up_sees_no_road() -> None:
    up = looking(0.0, 0.0)
    up[:3, :3] = se3.exp_so3([0.0, np.radians(-95.0), 0.0]) @ up[:3, :3]
    view = view_of("PINHOLE", 0, up)
    mosaic = mosaic_of([view], [photographed("PINHOLE", up)])
    assert mosaic.images_used == 0
    assert not mosaic.owner.any()


def test_cameras_of_different_exposure_are_balanced() -> None:
    gains = camera_gains(drive("PINHOLE", gains=(1.0, 0.8)))
    assert gains[1] / gains[0] == pytest.approx(1.25, rel=0.02)
    assert camera_gains(drive("PINHOLE")) == pytest.approx([1.0, 1.0], rel=0.01)


def test_cells_on_a_slope_show_their_own_places() -> None:
    ground = Slope((0.05, -0.08))
    normal = np.append(-ground.slope, 1.0) / np.sqrt(1 + ground.slope @ ground.slope)
    axis = np.cross([0.0, 0.0, 1.0], normal)
    turn = se3.exp_so3(axis / np.linalg.norm(axis) * np.arccos(normal[2]))
    views, images = [], []
    for x in WAY[:, 0]:
        level = looking(0.0, float(x))
        views.append(view_of("PINHOLE", 0, se3.transform(turn, np.zeros(3)) @ level))
        images.append(photographed("PINHOLE", level))
    [mosaic] = make_mosaics(views, [Grid.around(WAY)], ground, lambda i: (images[i], None), own_car_m=None)
    xy = places(mosaic)
    on_ground = np.concatenate([xy, (xy @ ground.slope)[..., None]], -1) @ turn
    near = (mosaic.score[0] > 25.0) & (mosaic.owner[0] > 0)
    assert near.sum() > 5000
    error = np.abs(mosaic.color[REFINED, 0, ..., 0].astype(float) - pattern(on_ground[..., :2]))[near]
    assert 0.1 < np.median(error) < 3.0


def test_a_corner_asks_for_heights_by_its_length_and_not_by_the_land_it_encloses() -> None:
    image, asked = photographed("PINHOLE", looking(0.0, 0.0)), []
    for arm_m in (200.0, 400.0):
        ground, way = Level(), corner(arm_m)
        views = []
        for x, y in way[::5]:
            pose = looking(0.0, float(x))
            pose[1, 3] = y
            views.append(view_of("PINHOLE", 0, pose))
        grid = Grid.around(way, max_cells=100_000)
        make_mosaics(views, [grid], ground, lambda _: (image, None), own_car_m=None)
        asked.append(ground.asked)
        ground.asked = 0

        def stop(done: int) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            make_mosaics(views, [grid], ground, lambda _: (image, None), own_car_m=None, step=stop)
        # Nothing is computed before it is needed: a run can be stopped at once, but for the view that is under way.
        begun = Level()
        make_mosaics(views[: 1 + AHEAD], [grid], begun, lambda _: (image, None), own_car_m=None)
        assert ground.asked <= begun.asked < 11_000
    assert 10_000 < asked[0] < asked[1] < 2.2 * asked[0]


def test_cameras_are_compared_in_fine_cells_where_the_picture_has_coarse_ones() -> None:
    way = np.column_stack([np.linspace(0, 20, 11), np.zeros(11)])
    views, images = shots_of("PINHOLE", turned_deg=2.0, way=way)
    coarse, fine, *plots = make_mosaics(
        views,
        [Grid.around(way, max_cells=5_000), Grid.around(way), *plots_along(way)],
        Level(),
        lambda i: (images[i], None),
        own_car_m=None,
    )
    found, expected = measure_agreement(plots, way), measure_agreement([fine], way)
    assert found is not None
    assert expected is not None
    for of, like in zip(found, expected, strict=True):
        assert of.blocks > 20
        assert of.correlation == pytest.approx(like.correlation, abs=0.01)
        assert of.displacement_m == pytest.approx(like.displacement_m, abs=0.01)
    with pytest.raises(ValueError, match="coarse"):
        measure_agreement([coarse], way)


@pytest.mark.parametrize("arm_m", [10.0, 300.0, 1200.0])
def test_long_ways_have_plots(arm_m: float) -> None:
    way = corner(arm_m)
    grid, *plots = grids_along(way)
    assert (grid.cell_m > 0.05) == (arm_m > 10) == bool(plots)
    assert len(plots) <= MAX_PLOTS
    assert sum(plot.rows * plot.columns for plot in plots) < 6e6
    for plot in plots:
        assert plot.cell_m == 0.025
        centre = np.array([plot.left_m + PLOT_SIDE_M / 2, plot.top_m - PLOT_SIDE_M / 2])
        assert np.linalg.norm(way - centre, axis=1).min() < 1e-6
    if plots:
        assert len(plots) > 0.8 * MAX_PLOTS


@pytest.mark.parametrize("length_m", [100.0, 500.0, 800.0, 1000.0, 30_000.0])
def test_the_picture_of_a_straight_drive_can_be_opened(length_m: float) -> None:
    grid = Grid.around(np.array([[0.0, 0.0], [length_m, 0.0]]))
    assert grid.columns * grid.cell_m == pytest.approx(length_m + 24.0, rel=1e-3)
    picture = np.zeros((grid.rows, grid.columns, 3), np.uint8)
    out = framed(picture, ["one", "two"], cell_m=grid.cell_m, arrows=[("drive", (1.0, 0.0))]).picture
    assert max(out.shape) <= MAX_TEXTURE_PX
    upright = framed(picture.transpose(1, 0, 2), ["one", "two"], cell_m=grid.cell_m, arrows=[]).picture
    assert max(upright.shape) <= MAX_TEXTURE_PX


def test_the_grid_is_bounded() -> None:
    small = Grid.around(WAY)
    assert small.cell_m == 0.025
    far = Grid.around(np.array([[0.0, 0.0], [9000.0, 4000.0]]))
    assert 11e6 < far.rows * far.columns <= 12e6
    assert far.columns * far.cell_m == pytest.approx(9024, rel=1e-3)


def test_every_image_is_read_once_and_an_error_ends_it() -> None:
    image, reads, steps = photographed("PINHOLE", looking(0.0, 0.0)), [], []
    views = [view_of("PINHOLE", 0, looking(0.0, float(x))) for x in WAY[:, 0]]

    def read(index: int) -> tuple[np.ndarray, None]:
        reads.append(index)
        return image, None

    grid = Grid.around(WAY, max_cells=100_000)
    make_mosaics(views, [grid], Level(), read, own_car_m=None, step=steps.append)
    assert reads == list(range(len(views)))
    assert steps == list(range(1, len(views) + 1))
    reads.clear()

    def stop(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_mosaics(views, [grid], Level(), read, own_car_m=None, step=stop)
    assert 2 <= len(reads) <= 6


@pytest.mark.parametrize("shape", [(1, 5, 3), (5, 1, 3), (1, 1, 3)])
def test_an_image_of_one_row_or_column_is_read_inside(shape: tuple[int, ...]) -> None:
    within = np.full((7, 7, 3), 200, np.uint8)  # around the image, in the same memory
    image = within[: shape[0], : shape[1]]
    image[:] = 50
    seen = np.zeros(3, np.uint8)
    for u, v in ((0.1, 0.1), (shape[1] - 0.01, shape[0] - 0.01)):
        sample.py_func(image, u, v, np.ones(3), seen)  # compiled for such memory, it takes ten seconds
        assert (seen == 50).all()
