"""Line 25: the own car in images without masks, and a bar with the time over a fifth of them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.features.own_car import find_own_cars
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.synthetic.drive_writer import TRUE_OWN_CAR_FOLDER
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import imported
from tests.benchmarks.table import Figure, exactly

CAMERAS, SIZE = 4, ("--width", 640, "--height", 360)
LEAST_OVERLAP = 0.9
RATES = {"28 units of 1.1 m": (28, 1.1), "61 units of 0.5 m": (61, 0.5), "15 units of 2.2 m": (15, 2.2)}
PANDASET, PANDASET_FRAMES, SEES_IT = "pandaset_002", "26:52", "back_camera"
PANDASET_SHARE = (0.18, 0.25)
WITHOUT = ("kitti01", "kitti02", "kitti06", "kitti_raw_0001", "ddad")
BAR_SHARE = 0.2
BAR_UNITS = 24


def rendered_own_car(work: Path, seed: int) -> Iterator[Figure]:
    """Line 25: a bonnet and a boot lid on 30 m of way, at three rates of images."""
    for rate, (units, spacing_m) in RATES.items():
        drive = work / f"own car, {rate}"
        mrasfm(
            "synth", "--cameras", CAMERAS, "--units", units, "--spacing-m", spacing_m, "--seed", seed, *SIZE,
            "--own-car", "--no-masks", "--out", drive,
        )  # fmt: skip
        masks = _masks(drive)
        for camera in ("front", "back"):
            yield Figure(
                line="25",
                what=f"seed {seed}, {rate}: intersection over union with the {camera} camera's true mask",
                value=_overlap(masks[camera], drive / TRUE_OWN_CAR_FOLDER / f"{camera}.png"),
                above=LEAST_OVERLAP,
                most=1.0,
            )
        others = sum(mask is not None for camera, mask in masks.items() if camera not in ("front", "back"))
        yield exactly("25", f"seed {seed}, {rate}: other cameras with a mask + 1", others + 1, 1)
        shutil.rmtree(drive)


def bar_with_time(work: Path, seed: int) -> Iterator[Figure]:
    """Line 25: a bar over a fifth of all images costs no accuracy."""
    plain = work / "without a bar"
    mrasfm(
        "synth", "--cameras", CAMERAS, "--units", BAR_UNITS, "--seed", seed, *SIZE, "--no-masks", "--out", plain
    )  # fmt: skip
    masks = _masks(plain)
    found = sum(mask is not None for mask in masks.values())
    yield exactly("25", f"seed {seed}, no own car: cameras with a mask + 1", found + 1, 1)
    error_m = _error_m(plain, work / "without a bar, scene")
    barred = work / "with a bar"
    shutil.copytree(plain, barred)
    for index, file in enumerate(sorted((barred / "images").glob("*/*.jpg"))):
        _draw_bar(file, index)
    with_bar_m = _error_m(barred, work / "with a bar, scene")
    yield Figure(line="25", what=f"seed {seed}, without a bar: similarity error", value=error_m, unit="m")
    yield Figure(
        line="25",
        what=f"seed {seed}, a bar over {BAR_SHARE:.0%} of all images: similarity error",
        value=with_bar_m,
        unit="m",
        most=1.5 * error_m + 0.005,
    )
    shares = [camera.get("share", 0.0) for camera in read_report(work / "with a bar, scene")["own_car"].values()]
    yield Figure(
        line="25", what=f"seed {seed}: least share of an image that is masked", value=min(shares), above=0.18, most=0.25
    )


def real_own_car(data: Path, work: Path) -> Iterator[Figure]:
    """Line 25: a real boot lid, and rigs whose cameras see nothing of their car."""
    drive = work / PANDASET
    mrasfm("import", data / PANDASET, "--frames", PANDASET_FRAMES, "--out", drive)
    masks = _masks(drive)
    mask = masks.pop(SEES_IT)
    low, high = PANDASET_SHARE
    share = 0.0 if mask is None else float(mask.mean())
    yield Figure(line="25", what=f"{PANDASET}, {SEES_IT}: share of the image", value=share, above=low, most=high)
    others = sum(mask is not None for mask in masks.values())
    yield exactly("25", f"{PANDASET}: other cameras with a mask + 1", others + 1, 1)
    for name in WITHOUT:
        found = sum(mask is not None for mask in _masks(imported(data, name, work)).values())
        yield exactly("25", f"{name}: cameras with a mask + 1", found + 1, 1)


def _masks(drive: Path) -> dict[str, Any]:
    """The mask of each camera by name."""
    read = read_drive(drive)
    return {camera.name: car.mask for camera, car in zip(read.cameras, find_own_cars(read, threads=1), strict=True)}


def _overlap(mask: np.ndarray | None, truth: Path) -> float:
    true = cv2.imread(str(truth), cv2.IMREAD_UNCHANGED) > 0
    return 0.0 if mask is None else float((mask & true).sum() / (mask | true).sum())


def _error_m(drive: Path, scene: Path) -> float:
    mrasfm("reconstruct", drive, "--out", scene)
    return float(evaluate(scene, drive)["similarity"]["rmse_m"])


def _draw_bar(file: Path, index: int) -> None:
    image = cv2.imread(str(file))
    rows = round(BAR_SHARE * len(image))
    image[:rows] = (40, 30, 20)
    cv2.putText(image, f"2026-05-04 12:{index:06d}", (20, rows - 20), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (255, 255, 255))
    cv2.imwrite(str(file), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
