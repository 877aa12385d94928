"""Line 1: real drives, alone and beside COLMAP on the same matches."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.benchmark.baselines import Baseline, run_baseline
from mrasfm_engine.evaluation.cameras import compare_camera_poses
from mrasfm_engine.io.read_scene import read_poses
from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.commands import evaluate, mrasfm
from tests.benchmarks.table import Figure, exactly

THREADS = os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class StereoBounds:
    """What is asked of a stereo drive."""

    name: str
    images: int
    metric_rmse_m: float
    metric_rmse_gnss_m: float


STEREO = (
    StereoBounds(name="kitti06", images=102, metric_rmse_m=0.15, metric_rmse_gnss_m=0.10),
    StereoBounds(name="kitti02", images=40, metric_rmse_m=0.15, metric_rmse_gnss_m=0.15),
)
DDAD_IMAGES = 18


def imported(data: Path, name: str, work: Path) -> Path:
    drive = work / name
    if not drive.exists():
        mrasfm("import", data / name, "--out", drive)
    return drive


def reconstructed(drive: Path, out: Path, *options: str) -> Path:
    """The scene; one that this run has reconstructed before is used again."""
    if not (out / "report.json").exists():
        mrasfm("reconstruct", drive, "--out", out, *options)
    return out


def accuracy(data: Path, work: Path) -> Iterator[Figure]:
    """Line 1."""
    for bounds in STEREO:
        drive = imported(data, bounds.name, work)
        for title, options, most in (
            ("without GNSS", ("--no-gnss",), bounds.metric_rmse_m),
            ("with GNSS", (), bounds.metric_rmse_gnss_m),
        ):
            scene = reconstructed(drive, work / f"{bounds.name} {title}", *options)
            yield from _stereo_figures(f"{bounds.name} {title}", evaluate(scene, drive), bounds.images, most)
    yield from _ddad(data, work)
    yield from _baselines(data, work)


def _stereo_figures(title: str, errors: dict, images: int, most: float) -> Iterator[Figure]:  # type: ignore[type-arg]
    yield exactly("1", f"{title}: images registered", errors["registered_images"], images)
    metric, similarity = errors["metric"], errors["similarity"]
    yield Figure(line="1", what=f"{title}: position, metric RMSE", value=metric["rmse_m"], unit="m", most=most)
    yield Figure(line="1", what=f"{title}: rotation, median", value=metric["rotation_median_deg"], unit="deg", most=0.3)
    yield Figure(line="1", what=f"{title}: position, similarity RMSE", value=similarity["rmse_m"], unit="m")


def _ddad(data: Path, work: Path) -> Iterator[Figure]:
    drive = imported(data, "ddad", work)
    scene = read_poses(reconstructed(drive, work / "ddad scene"))
    yield exactly("1", "ddad: images registered", scene.registered_images, DDAD_IMAGES)
    # The drive's files are images/CAMERA_01/000000.jpg, the source's truth has CAMERA_01/000000.
    sensors = json.loads((data / "ddad" / "T_world_sensor.json").read_text(encoding="utf-8"))
    files = sorted(scene.world_from_cam)
    truth = np.array([sensors[Path(file).parent.name + "/" + Path(file).stem] for file in files])
    errors = compare_camera_poses(np.stack([scene.world_from_cam[file] for file in files]), truth)
    yield Figure(line="1", what="ddad: worst camera position", value=errors.translation_max_m, unit="m", most=0.08)
    yield Figure(line="1", what="ddad: worst camera rotation", value=errors.rotation_max_deg, unit="deg", most=0.3)
    yield Figure(line="1", what="ddad: camera position, median", value=errors.translation_median_m, unit="m")
    yield Figure(line="1", what="ddad: camera rotation, median", value=errors.rotation_median_deg, unit="deg")


def _baselines(data: Path, work: Path) -> Iterator[Figure]:
    """COLMAP on the matches of kitti06 without GNSS, for comparison."""
    drive = imported(data, "kitti06", work)
    scene = reconstructed(drive, work / "kitti06 without GNSS", "--no-gnss")
    truth = read_tum(drive / "truth.tum").world_from_rig
    for mapper in (Baseline.GLOBAL, Baseline.GLOBAL_FIXED_CALIBRATION, Baseline.INCREMENTAL_FIXED_CALIBRATION):
        result = run_baseline(scene / "features.db", mapper, threads=THREADS)
        title = f"kitti06 without GNSS, COLMAP {mapper}"
        yield Figure(line="1", what=f"{title}: mapping", value=result.seconds, unit="s", remark=result.failure)
        yield Figure(line="1", what=f"{title}: images registered", value=result.registered_images)
        errors = result.errors(truth)
        if errors is not None:
            yield Figure(line="1", what=f"{title}: metric RMSE", value=errors.metric_rmse_m, unit="m")
            yield Figure(line="1", what=f"{title}: similarity RMSE", value=errors.similarity_rmse_m, unit="m")
