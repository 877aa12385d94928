"""Line 22: a real car's six cameras beside COLMAP's mappers on the same matches, and what GNSS costs its images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.benchmark.baselines import Baseline
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.benchmarks.colmap import beside_colmap
from tests.benchmarks.commands import evaluate
from tests.benchmarks.real_drives import DRIVES, imported, reconstructed
from tests.benchmarks.table import Figure, exactly

MAX_GROWTH = 1.05  # of the images' errors with GNSS
NAME = "pandaset_002"


def surround_peers(data: Path, work: Path) -> Iterator[Figure]:
    """Line 22."""
    real = next(real for real in DRIVES if real.name == NAME)
    drive = imported(data, real.name, work, *real.options)
    scene = reconstructed(drive, work / f"{NAME} without GNSS", "--no-gnss")
    errors = evaluate(scene, drive)
    yield exactly("22", f"{NAME} without GNSS: images registered", errors["registered_images"], real.images)
    with_gnss = reconstructed(drive, work / f"{NAME} with GNSS")
    ours, theirs = (_median_error_px(folder) for folder in (scene, with_gnss))
    yield Figure(line="22", what=f"{NAME} without GNSS: images' reprojection errors, median", value=ours, unit="px")
    yield Figure(line="22", what=f"{NAME}: the same with GNSS, of that", value=theirs / ours, most=MAX_GROWTH)
    units = {image.file: image.unit for image in read_drive(drive).images}
    best_m = np.inf
    for mapper in Baseline:
        figures, rmse_m = beside_colmap("22", NAME, mapper, scene=scene, drive=drive, unit_of_image=units)
        yield from figures
        best_m = min(best_m, rmse_m)
    yield Figure(
        line="22",
        what=f"{NAME} without GNSS: similarity RMSE, at most the best of COLMAP's",
        value=errors["similarity"]["rmse_m"],
        unit="m",
        most=best_m,
    )


def _median_error_px(scene: Path) -> float:
    """Median over the images of their observations' median reprojection error."""
    model = pycolmap.Reconstruction(str(scene / "model"))
    medians = []
    for image in model.images.values():
        seen = [p for p in image.points2D if p.has_point3D()]
        if not seen:
            continue
        points_m = np.array([model.points3D[p.point3D_id].xyz for p in seen])
        in_camera_m = image.cam_from_world() * points_m
        off_px = model.cameras[image.camera_id].img_from_cam(in_camera_m) - np.array([p.xy for p in seen])
        medians.append(np.median(np.linalg.norm(off_px, axis=1)))
    return float(np.median(medians))
