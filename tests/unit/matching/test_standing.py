"""Units of a standing car, found in small images."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.matching.pair_matching import NO_PRIOR
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.standing import Standing, find_standing, is_whole, moving_by_prior
from mrasfm_engine.scene.drive import Drive
from tests.helpers.simulated_drive import make_drive

SIZE_PX = (640, 360)
MIN_MOTION_PX = 2.0
Draw = Callable[[int, int], np.ndarray]  # unit, camera


def texture(seed: int) -> np.ndarray:
    """Detail at all scales, larger than an image."""
    rng = np.random.default_rng(seed)
    result = np.zeros((600, 1200), np.float32)
    for side in (8, 16, 32, 64):
        cells = rng.normal(0, 25, (600 // side + 1, 1200 // side + 1)).astype(np.float32)
        result += cv2.resize(cells, (1200, 600), interpolation=cv2.INTER_CUBIC)
    return result + 120


WORLD = [texture(seed) for seed in range(3)]
LORRY = texture(9)


def view(camera: int, shift_px: float) -> np.ndarray:
    """A camera's view of its side of the world, moved to the left."""
    by = np.array([[1.0, 0.0, 200.0 + shift_px], [0.0, 1.0, 100.0]])
    return cv2.warpAffine(WORLD[camera], by, SIZE_PX, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def write(folder: Path, units: int, draw: Draw, cameras: int = 1) -> Drive:
    made = make_drive(
        np.tile(np.eye(4), (cameras, 1, 1)),
        np.tile([500.0, 500.0, 320.0, 180.0], (cameras, 1)),
        units=units,
        size_px=SIZE_PX,
    )
    drive = Drive(folder, made.manifest)
    for i, image in enumerate(drive.images):
        path = folder / image.file
        path.parent.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(i).normal(0, 3, (SIZE_PX[1], SIZE_PX[0]))
        pixels = np.clip(draw(image.unit, image.camera) + noise, 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return drive


def standing_of(
    drive: Drive, prior: PriorTrajectory = NO_PRIOR, threads: int = 2, repeated: Collection[str] = ()
) -> Standing:
    return find_standing(drive, prior, min_motion_px=MIN_MOTION_PX, repeated=repeated, threads=threads)


def stop_px(unit: int) -> float:
    """A car that drives up to unit 2 and from unit 8 on."""
    return 25.0 * (min(unit, 2) + max(unit - 7, 0))


def test_the_first_and_the_last_unit_of_a_stop_are_kept(tmp_path: Path) -> None:
    found = standing_of(
        write(tmp_path, 13, lambda unit, camera: view(camera, 25.0 * (min(unit, 2) + max(unit - 9, 0))))
    )
    assert found.included.tolist() == [True] * 3 + [False] * 6 + [True] * 4
    assert found.spans() == [(2, 9)]
    assert np.isnan(found.moved_px[found.included]).all()
    assert found.moved_px[~found.included].max() < 0.5, "noise is no motion"
    assert found.compared == 9, "4 to 7 lie between two that stand"


def test_jpegs_in_colour_with_noise_of_each_channel(tmp_path: Path) -> None:
    """They are decoded small and grey."""
    drive = write(tmp_path, 11, lambda unit, camera: view(camera, stop_px(unit)))
    rng = np.random.default_rng(5)
    for image in drive.images:
        grey = view(image.camera, stop_px(image.unit))
        pixels = np.clip(grey[..., None] * [0.8, 1.0, 1.1] + rng.normal(0, 4, (*grey.shape, 3)), 0, 255)
        (drive.root / image.file).write_bytes(cv2.imencode(".jpg", pixels.astype(np.uint8))[1].tobytes())
    found = standing_of(drive)
    assert found.included.tolist() == [True] * 3 + [False] * 4 + [True] * 4
    assert found.moved_px[~found.included].max() < 0.5, "noise is no motion"


def files_of(drive: Drive, units: Iterable[int], cameras: int) -> set[str]:
    """Files of the first cameras in some units."""
    return {image.file for image in drive.images if image.unit in units and image.camera < cameras}


@pytest.mark.parametrize(("cameras", "hung"), [(1, 1), (2, 1), (2, 2), (3, 2)])
def test_images_that_are_those_before_once_more_do_not_stand(tmp_path: Path, cameras: int, hung: int) -> None:
    """What records them hangs, and says nothing of the vehicle."""
    shown = [unit if unit < 3 or unit > 7 else 2 for unit in range(11)]
    drive = write(tmp_path, 11, lambda unit, k: view(k, 25.0 * (shown[unit] if k < hung else unit)), cameras)
    repeated = files_of(drive, range(3, 8), hung)
    assert standing_of(drive, repeated=repeated).included.all()
    assert (not standing_of(drive).included.all()) == (2 * hung >= cameras), "which nobody else would tell"


@pytest.mark.parametrize("units", [[5], [3, 4, 5, 6], [7], [2, 4, 6, 8], range(8, 11)])
def test_units_without_images_of_their_own_stand_where_the_next_one_does(tmp_path: Path, units: Iterable[int]) -> None:
    drive = write(tmp_path, 11, lambda unit, camera: view(camera, stop_px(unit)))
    repeated = files_of(drive, units, 1)
    found = standing_of(drive, repeated=repeated)
    shown = [unit for unit in range(2, 8) if unit not in units]
    assert found.spans() == [(shown[0], shown[-1])]
    assert not np.isnan(found.moved_px[~found.included]).any()
    assert found.moved_px[~found.included].max() < 0.5


def test_grey_images_do_not_stand(tmp_path: Path) -> None:
    """They show nothing: as a picture of another exposure, each would be any other."""

    def drawn(unit: int, camera: int) -> np.ndarray:
        return np.full(SIZE_PX[::-1], 128.0) if 3 <= unit <= 7 else view(camera, 25.0 * unit)

    assert standing_of(write(tmp_path, 11, drawn)).included.all()


def test_steps_of_a_creeping_car_add_up(tmp_path: Path) -> None:
    """0.8 px from unit to unit are no motion, three times that is: against the last unit that was kept."""
    found = standing_of(write(tmp_path, 17, lambda unit, camera: view(camera, 0.8 * unit)))
    kept = np.flatnonzero(found.included)
    assert kept[0] == 0
    assert kept[-1] == 16
    assert np.diff(kept).max() <= 2
    assert found.moved_px[~found.included].max() < MIN_MOTION_PX


def test_a_driving_car_keeps_all_units(tmp_path: Path) -> None:
    for number, step_px in enumerate((3.0, 8.0, 40.0)):
        drive = write(tmp_path / str(number), 6, lambda unit, camera, by=step_px: view(camera, by * unit))
        assert standing_of(drive).included.all()


def test_three_units_a_second_are_read_of_a_stop(tmp_path: Path) -> None:
    """Ten are recorded. Steps in it are found where they are; an image that ends early is there for the extraction."""

    def stepped_px(unit: int) -> float:
        return 25.0 * (min(unit, 2) + (unit > 31) + max(unit - 58, 0))

    drive = write(tmp_path, 60, lambda unit, camera: view(camera, stepped_px(unit)))
    found = standing_of(drive, threads=1)
    assert found.spans() == [(2, 31), (32, 58)]
    assert found.compared < 30
    assert standing_of(drive, threads=16).compared == found.compared
    assert not np.isnan(found.moved_px[~found.included]).any(), "also those between"
    assert found.moved_px[~found.included].max() < 0.5
    path = drive.root / drive.images[16].file
    path.write_bytes(path.read_bytes()[:-100])
    assert standing_of(drive).spans() == [(2, 15), (17, 31), (32, 58)]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_an_image_that_ends_early_is_not_whole(tmp_path: Path, suffix: str) -> None:
    path, data = tmp_path / "image", cv2.imencode(suffix, view(0, 0.0).astype(np.uint8))[1].tobytes()
    for written, whole in ((data, True), (data[:-1], False), (data[: len(data) // 2], False), (b"", False)):
        path.write_bytes(written)
        assert is_whole(path) == whole
    assert not is_whole(tmp_path / "nothing")


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_a_lorry_that_passes_is_no_motion_of_ours(tmp_path: Path, share: float) -> None:
    """It covers a part of every view, or one camera of three."""

    def draw(unit: int, camera: int) -> np.ndarray:
        result = view(camera, 0.0)
        if 2 <= unit <= 5 and (share < 1.0 or camera == 1):
            width = round(share * SIZE_PX[0])
            result[:, :width] = LORRY[: SIZE_PX[1], 90 * unit : 90 * unit + width]
        return result if unit < 8 else view(camera, 30.0 * (unit - 7))

    found = standing_of(write(tmp_path, 10, draw, cameras=3))
    assert found.spans() == [(0, 7)]


def test_another_exposure_is_no_motion(tmp_path: Path) -> None:
    found = standing_of(
        write(tmp_path, 10, lambda unit, camera: view(camera, stop_px(unit)) * (1.0 + 0.03 * (unit % 3)) - 4 * unit)
    )
    assert found.spans() == [(2, 7)]


def test_what_tells_nothing_is_kept(tmp_path: Path) -> None:
    """No texture, and an image that cannot be read: the extraction says what is wrong with it."""
    assert standing_of(write(tmp_path / "fog", 5, lambda unit, camera: np.full((360, 640), 120.0))).included.all()
    drive = write(tmp_path / "broken", 11, lambda unit, camera: view(camera, stop_px(unit)))
    (drive.root / drive.images[5].file).write_bytes(b"no image")
    assert standing_of(drive).included[5]


def test_a_car_that_never_moves_keeps_all_units(tmp_path: Path) -> None:
    assert standing_of(write(tmp_path, 5, lambda unit, camera: view(camera, 0.0))).included.all()


def prior_of(x_m: np.ndarray, sigma_m: float) -> PriorTrajectory:
    poses = np.tile(np.eye(4), (len(x_m), 1, 1))
    poses[:, 0, 3] = x_m
    return PriorTrajectory(source="GNSS", world_from_rig=poses, sigma=np.full((len(x_m), 6), sigma_m))


def test_where_the_prior_shows_motion_no_image_is_read() -> None:
    """There are no images here at all: they would be found missing. Ten units a second, at 10 m/s and stopped."""
    units = 200
    drive = make_drive(np.eye(4)[None], np.array([[500.0, 500.0, 320.0, 180.0]]), units=units)
    driving = np.arange(units, dtype=float)
    moves = moving_by_prior(drive, prior_of(driving, 1.0))
    assert moves[20:-20].all()
    assert standing_of(drive, prior_of(driving, 1.0)).included.all()
    stopped = np.minimum(driving, 80) + np.maximum(driving - 140, 0)
    moves = moving_by_prior(drive, prior_of(stopped, 1.0))
    assert not moves[80:141].any()
    assert moves[21:60].all()
    assert moves[160:179].all()
    assert not moving_by_prior(drive, prior_of(driving, 100.0)).any(), "a receiver that errs by as much knows nothing"
    assert not moving_by_prior(drive, NO_PRIOR).any()


def test_images_that_stay_while_the_prior_moves_on_are_something_that_moves_along(tmp_path: Path) -> None:
    drive = write(tmp_path, 30, lambda unit, camera: view(camera, 0.0))
    creeping = prior_of(0.5 * np.arange(30), 0.1)
    kept = standing_of(drive, creeping).included
    assert np.diff(np.flatnonzero(kept)).max() <= 3


def test_the_drive_without_them(tmp_path: Path) -> None:
    drive = write(tmp_path, 11, lambda unit, camera: view(camera, stop_px(unit)), cameras=1)
    found = standing_of(drive)
    left = drive.restricted_to(found.included)
    assert [frame.source_frame for frame in left.manifest.frames] == [0, 1, 2, 7, 8, 9, 10]
    assert [image.unit for image in left.images] == list(range(7))
