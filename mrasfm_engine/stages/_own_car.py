"""The vehicle itself in its cameras' images, which all images share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.features.own_car import OwnCar, find_own_cars, large_share_finding
from mrasfm_engine.freed_memory import return_freed_memory
from mrasfm_engine.io.images import mask_of_png, mask_png
from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.stages._run import OWN_CAR_VERSION, Run
from mrasfm_engine.types import Bools
from schemas.findings import as_json

OWN_CAR = "own-car"


def own_cars(run: Run) -> None:
    """Find the own car, or take it from the store: `run.own_cars` has its masks from here on."""
    if run.own_cars:
        return
    masks, report = _found(run)
    run.own_cars = masks
    run.report["own_car"] = report
    for camera, mask in zip(run.drive.cameras, masks, strict=True):
        run.report["findings"] += [as_json(finding) for finding in large_share_finding(camera.name, mask)]


def _found(run: Run) -> tuple[list[Bools | None], dict[str, Any]]:
    if not run.config.features.own_car:
        return [None for _ in run.drive.cameras], {}

    def find() -> tuple[Arrays, dict[str, Any]]:
        found = find_own_cars(run.drive, threads=run.config.threads, cancel=run.cancel)
        return_freed_memory()
        report = {camera.name: car.report() for camera, car in zip(run.drive.cameras, found, strict=True)}
        return _packed(found), report

    masks, report = run.once(OWN_CAR, OWN_CAR_VERSION, find=find)
    return _unpacked(masks), report


def _packed(own_cars: Sequence[OwnCar]) -> Arrays:
    masks = [
        np.zeros(0, np.uint8) if car.mask is None else mask_png(car.mask.astype(np.uint8) * 255) for car in own_cars
    ]
    return {
        "own_car_bytes": np.array([len(mask) for mask in masks], dtype=np.int64),
        "own_cars": np.concatenate([np.zeros(0, np.uint8), *masks]),
    }


def _unpacked(arrays: Arrays) -> list[Bools | None]:
    masks = np.split(arrays["own_cars"], np.cumsum(arrays["own_car_bytes"])[:-1])
    return [mask_of_png(mask) > 0 if len(mask) else None for mask in masks]
