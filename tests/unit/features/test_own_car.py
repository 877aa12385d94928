from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.features.extraction import extract_features
from mrasfm_engine.features.own_car import (
    LARGE_SHARE,
    MAX_PIXELS,
    MIN_IMAGES,
    WIDTH_PX,
    NotFound,
    OwnCar,
    find_own_cars,
    large_share_finding,
    small_width_px,
    with_margin,
)
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.features.static_outline import _best_heights
from mrasfm_engine.geometry import se3
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive, matrix_from_pose, pose_from_matrix
from mrasfm_engine.synthetic import small_options
from mrasfm_engine.synthetic.drive_writer import TRUE_OWN_CAR_FOLDER, render_drives
from tests.helpers.painted_once import textures_painted_once

UNITS = 24
SMALL = {"cameras": 1, "units": UNITS, "texture_px": 128, "masks": False}


@pytest.fixture(scope="module")
def with_bonnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One camera that sees a bonnet, on 25 m of way."""
    out = tmp_path_factory.mktemp("synth") / "bonnet"
    with textures_painted_once():
        render_drives(small_options(own_car=True, **SMALL), out)
    return out


@pytest.fixture(scope="module")
def without_bonnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "plain"
    with textures_painted_once():
        render_drives(small_options(**SMALL), out)
    return out


def changed(drive: Path, out: Path, change) -> Drive:  # type: ignore[no-untyped-def]
    """A copy of a drive whose images `change(index, image)` makes."""
    shutil.copytree(drive, out)
    result = read_drive(out)
    before = [cv2.imread(str(drive / image.file)) for image in result.images]
    for index, image in enumerate(result.images):
        cv2.imwrite(str(out / image.file), change(index, before), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return result


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum() / (found | true).sum())


def truth(drive: Path) -> np.ndarray:
    return cv2.imread(str(drive / TRUE_OWN_CAR_FOLDER / "front.png"), cv2.IMREAD_UNCHANGED) > 0


def test_a_bonnet_is_found(with_bonnet: Path) -> None:
    car = find_own_cars(read_drive(with_bonnet), threads=1)[0]
    assert car.mask is not None
    assert car.reason is None
    assert car.images == UNITS
    assert 0.9 < overlap(car.mask, truth(with_bonnet)) <= 1
    assert car.report() == {"share": round(float(car.mask.mean()), 4), "images_compared": UNITS}


def test_a_camera_that_sees_no_car_has_no_mask(without_bonnet: Path) -> None:
    car = find_own_cars(read_drive(without_bonnet), threads=1)[0]
    assert (car.mask, car.reason, car.images) == (None, NotFound.NOT_SEEN, UNITS)
    assert car.share == 0
    assert car.report()["reason"] == str(NotFound.NOT_SEEN)


def test_a_camera_that_is_upside_down_sees_the_bonnet_above(with_bonnet: Path, tmp_path: Path) -> None:
    drive = changed(with_bonnet, tmp_path / "drive", lambda index, images: images[index][::-1, ::-1])
    camera = drive.manifest.rig.cameras[0]
    turned = matrix_from_pose(camera.rig_from_cam) @ se3.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    fx, fy, cx, cy = camera.params
    turned_camera = camera.model_copy(
        update={"rig_from_cam": pose_from_matrix(turned), "params": [fx, fy, camera.width - cx, camera.height - cy]}
    )
    rig = drive.manifest.rig.model_copy(update={"cameras": [turned_camera]})
    car = find_own_cars(Drive(drive.root, drive.manifest.model_copy(update={"rig": rig})), threads=1)[0]
    assert car.mask is not None
    assert 0.9 < overlap(car.mask, truth(with_bonnet)[::-1, ::-1]) <= 1


def in_a_circle(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image as a lens shows it whose image circle is the image's width across, and the dark around the circle."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    outside = (x - width / 2) ** 2 + (y - height / 2) ** 2 > (0.46 * width) ** 2
    result = image.copy()
    result[outside] = 3
    return result, outside


@pytest.mark.parametrize("bonnet", [False, True])
def test_the_dark_around_an_image_circle_is_masked_and_no_more(
    bonnet: bool, with_bonnet: Path, without_bonnet: Path, tmp_path: Path
) -> None:
    """A rim that stays is no outline of the car, although the ground is inside it; a bonnet is found all the same."""
    source = with_bonnet if bonnet else without_bonnet
    drive = changed(source, tmp_path / "drive", lambda index, images: in_a_circle(images[index])[0])
    car = find_own_cars(drive, threads=1)[0]
    dark = in_a_circle(cv2.imread(str(drive.root / drive.images[0].file)))[1]
    expected = dark | truth(source) if bonnet else dark
    assert car.mask is not None
    assert 0.85 < overlap(car.mask, expected) <= 1


def test_a_vehicle_that_stands_shows_nothing(with_bonnet: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def noisy(_: int, images: list[np.ndarray]) -> np.ndarray:
        return np.clip(images[0] + rng.normal(0, 3, images[0].shape), 0, 255).astype(np.uint8)

    car = find_own_cars(changed(with_bonnet, tmp_path / "drive", noisy), threads=1)[0]
    assert (car.mask, car.reason) == (None, NotFound.NO_MOTION)
    assert 0 < car.images < MIN_IMAGES


def test_few_units_are_not_judged(with_bonnet: Path) -> None:
    drive = read_drive(with_bonnet)
    few = drive.manifest.model_copy(update={"frames": drive.manifest.frames[: MIN_IMAGES - 1]})
    car = find_own_cars(Drive(drive.root, few), threads=1)[0]
    assert (car.mask, car.reason, car.images) == (None, NotFound.NO_MOTION, 0)


@pytest.mark.parametrize("at_top", [True, False])
def test_a_bar_with_the_time_is_masked(without_bonnet: Path, tmp_path: Path, at_top: bool) -> None:
    rows = 54  # of 270

    def with_bar(index: int, images: list[np.ndarray]) -> np.ndarray:
        image = images[index].copy()
        bar = image[:rows] if at_top else image[-rows:]
        bar[:] = (40, 30, 20)
        cv2.putText(bar, f"12:00:{index:02d}", (20, 35), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255))
        return image

    car = find_own_cars(changed(without_bonnet, tmp_path / "drive", with_bar), threads=1)[0]
    assert car.mask is not None
    bar = np.zeros(car.mask.shape, np.bool_)
    bar[slice(rows) if at_top else slice(-rows, None)] = True
    assert 0.9 < overlap(car.mask, bar) <= 1
    assert (with_margin(car.mask) & bar).sum() > 0.99 * bar.sum()


def test_cancel(with_bonnet: Path) -> None:
    with pytest.raises(CancelledError):
        find_own_cars(read_drive(with_bonnet), threads=2, cancel=lambda: True)


def test_no_keypoint_lies_on_the_mask(without_bonnet: Path) -> None:
    drive = read_drive(without_bonnet)
    one = Drive(drive.root, drive.manifest.model_copy(update={"frames": drive.manifest.frames[:1]}))
    mask = np.zeros((270, 480), np.bool_)
    mask[180:, 100:300] = True
    plain, masked = (
        extract_features(one, SiftExtractor(FeatureConfig()), threads=1, own_cars=masks)[0] for masks in ([], [mask])
    )

    def on_mask(xy_px: np.ndarray) -> int:
        column, row = xy_px.astype(int).T
        return int(with_margin(mask)[row, column].sum())

    assert on_mask(plain.xy_px) > 20
    assert on_mask(masked.xy_px) == 0
    assert len(masked.xy_px) > 100


def test_a_mask_over_much_of_an_image_gives_a_warning() -> None:
    mask = np.zeros((90, 160), np.bool_)
    mask[60:] = True
    assert large_share_finding("back", mask[:, : round(160 * LARGE_SHARE)]) == []
    mask[50:] = True
    (finding,) = large_share_finding("back", mask)
    assert finding.code == "own-car-large"
    assert "44% of the area of every image" in finding.what  # and not 44 % of the images
    assert large_share_finding("back", None) == []
    assert OwnCar(mask=mask, reason=None, images=20).share == pytest.approx(4 / 9)


def test_images_looked_at_have_few_pixels() -> None:
    assert small_width_px(1920, 1080) == small_width_px(1080, 1920) == WIDTH_PX
    assert small_width_px(480, 5000) ** 2 * 5000 / 480 <= MAX_PIXELS
    assert small_width_px(1, 60_000) >= 1


def test_the_best_outline_is_that_of_all_outlines() -> None:
    rng = np.random.default_rng(3)
    rows, columns = 3, 4
    for _ in range(20):
        crossing, area = rng.normal(size=(2, rows, columns)).astype(np.float32)
        side = rng.uniform(0, 1, (rows, columns)).astype(np.float32)

        everything = [np.array(np.unravel_index(k, (rows + 1,) * columns)) for k in range((rows + 1) ** columns)]
        best = max(worth(heights, crossing, area, side) for heights in everything)
        found = _best_heights(crossing, area, side)
        assert worth(found, crossing, area, side) == pytest.approx(best, abs=1e-5)


def worth(heights: np.ndarray, crossing: np.ndarray, area: np.ndarray, side: np.ndarray) -> float:
    """What an outline is worth, added up pixel by pixel."""
    rows, total = len(area), 0.0
    for column, height in enumerate(heights):
        if height:
            total += float(area[rows - height :, column].sum() + crossing[rows - height, column])
        if column:
            low, high = sorted((int(heights[column - 1]), int(height)))
            total -= float(side[rows - high : rows - low, column].sum())
    return total
