"""The mosaic of a ground whose pattern is known, and what it says of two cameras' agreement."""

from __future__ import annotations

import numpy as np
import pytest
from painted_ground import SIZE_PX, Level, looking, pattern, photographed, view_of

from mrasfm_engine.geometry import se3
from mrasfm_engine.views.agreement import measure_agreement
from mrasfm_engine.views.exposure import camera_gains
from mrasfm_engine.views.mosaic import GIVEN, REFINED, Grid, Mosaic, View, make_mosaic

WAY = np.column_stack([np.linspace(0, 8, 9), np.zeros(9)])
YAWS_DEG = (0.0, 40.0)  # of the two cameras, which see much of the same ground


def mosaic_of(
    views: list[View], images: list[np.ndarray], usable: np.ndarray | None = None, **options: object
) -> Mosaic:
    grid = Grid.around(WAY, max_cells=700_000)
    return make_mosaic(views, grid, Level(), lambda i: (images[i], usable), own_car_m=None, **options)  # type: ignore[arg-type]


def drive(model: str, *, turned_deg: float = 0.0, gains: tuple[float, float] = (1.0, 1.0)) -> Mosaic:
    """Two cameras go along; the second one's given pose is turned about the vertical."""
    views, images = [], []
    for x in WAY[:, 0]:
        for camera, (yaw, gain) in enumerate(zip(YAWS_DEG, gains, strict=True)):
            pose = looking(yaw, float(x))
            given = looking(yaw + camera * turned_deg, float(x))
            views.append(view_of(model, camera, pose, given=given))
            images.append((gain * photographed(model, pose)).clip(0, 255).astype(np.uint8))
    return mosaic_of(views, images)


def places(mosaic: Mosaic) -> np.ndarray:
    """Plan coordinates (rows, columns, 2) of the cells' centres."""
    grid = mosaic.grid
    x = grid.left_m + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.top_m - (np.arange(grid.rows) + 0.5) * grid.cell_m
    return np.stack(np.meshgrid(x, y), -1)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
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
    found = measure_agreement(drive("PINHOLE", turned_deg=2.0), WAY)
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
    found = measure_agreement(mosaic, WAY)
    assert found is not None
    assert found[0].displacement_m == pytest.approx(cells * mosaic.grid.cell_m, abs=0.2 * mosaic.grid.cell_m)
    assert found[1].correlation == pytest.approx(1.0, abs=1e-3)
    mosaic.color[:] = 90
    assert measure_agreement(mosaic, WAY) is None  # plain asphalt


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
    cut = make_mosaic([view], grid, Level(), lambda _: (image, None), own_car_m=car)
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
    make_mosaic(views, grid, Level(), read, own_car_m=None, step=steps.append)
    assert reads == list(range(len(views)))
    assert steps == list(range(1, len(views) + 1))
    reads.clear()

    def stop(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_mosaic(views, grid, Level(), read, own_car_m=None, step=stop)
    assert 2 <= len(reads) <= 6
