"""Line 23: simulated routes whose calibration is slightly off, with receivers from poor to very good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine import stages
from mrasfm_engine.benchmark.simulated_drive import SimulatedDrive, simulate_drive
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.evaluation.trajectory import compare_known
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.stage_store import StageStore, fingerprint
from mrasfm_engine.scene.drive import Drive, matrix_from_pose, pose_from_matrix
from schemas import Gnss
from tests.benchmarks.positions import Receiver
from tests.benchmarks.table import Figure, exactly

UNITS = 600  # a metre apart
OFF_DEG = 0.05  # what each camera's rotation is off by, about each axis
ARM_M = np.array([0.5, 0.1, 1.5])


SEEDS = (0, 1, 2)
MAX_RMSE_M, MAX_SHAPE_M, MAX_SIGMAS = 0.05, 0.10, 3.0

WHITE = {
    f"white noise of {sigma_m} m": Receiver(white_m=sigma_m, declared_m=sigma_m) for sigma_m in (1.0, 0.3, 0.05, 0.02)
}
# They say little of the scale, and the default prior of the rig does not either: their bound is that of the shape.
WANDERING = {
    "a random walk of 3 m in 60 s, declared 1.5 m": Receiver(white_m=0.0, walk_m=3.0, declared_m=1.5),
    "an error of 3 m that wanders in 60 s, declared 1.5 m": Receiver(white_m=0.0, wander_m=3.0, declared_m=1.5),
}


@dataclass(frozen=True, kw_only=True)
class Found:
    """Errors of one route; `scale_sigmas` is that of the scale, in those that the report states."""

    georeferenced: bool
    metric_rmse_m: float
    similarity_rmse_m: float
    scale_sigmas: float


def simulated_routes(data: Path, work: Path) -> Iterator[Figure]:
    """Line 23."""
    del data  # there are no files
    config = EngineConfig()
    found: dict[str, list[Found]] = {name: [] for name in WHITE | WANDERING}
    for seed in SEEDS:
        route = simulate_drive("stereo", UNITS, seed, config, work / f"route {seed}", progress=lambda *_: None)
        for name, receiver in (WHITE | WANDERING).items():
            found[name].append(_reconstructed(route, receiver, seed, work / f"route {seed}, {name}"))
    for name, routes in found.items():
        title = f"{len(routes)} stereo routes of {UNITS} m, {name}"
        yield exactly("23", f"{title}: georeferenced", sum(one.georeferenced for one in routes), len(routes))
        for what, values, unit, most in (
            ("metric RMSE, median", [r.metric_rmse_m for r in routes], "m", MAX_RMSE_M if name in WHITE else None),
            ("similarity RMSE, median", [r.similarity_rmse_m for r in routes], "m", MAX_SHAPE_M),
        ):
            yield Figure(line="23", what=f"{title}: {what}", value=float(np.median(values)), unit=unit, most=most)
        worst = max(one.scale_sigmas for one in routes)
        yield Figure(line="23", what=f"{title}: worst error of the scale in sigmas", value=worst, most=MAX_SIGMAS)


def _reconstructed(route: SimulatedDrive, receiver: Receiver, seed: int, folder: Path) -> Found:
    drive = _given(route, receiver, seed)
    # There are no files whose fingerprint the key could be.
    run = stages.Run(
        drive, EngineConfig(), StageStore(folder), lambda *_: None, lambda: False, key=fingerprint(folder.name)
    )
    run.report["findings"] = []
    prior = stages.prior(run)
    scene, _ = stages.refinement(run, stages.mapping(run, route.features, route.pairs, prior), prior)
    errors = compare_known(scene.world_from_rig, route.world_from_rig)
    if errors is None:
        return Found(georeferenced=False, metric_rmse_m=np.inf, similarity_rmse_m=np.inf, scale_sigmas=np.inf)
    sigma = run.report["stages"][-1]["scale"]["sigma_relative"]
    return Found(
        georeferenced=scene.georeference is not None,
        metric_rmse_m=errors.metric_rmse_m,
        similarity_rmse_m=errors.similarity_rmse_m,
        scale_sigmas=abs(np.log(errors.similarity_scale)) / sigma,
    )


def _given(route: SimulatedDrive, receiver: Receiver, seed: int) -> Drive:
    """The route's drive with cameras that are slightly off and positions of a receiver."""
    rng = np.random.default_rng([seed, 1])
    manifest = route.drive.manifest
    cameras = []
    for camera in manifest.rig.cameras:
        rig_from_cam = matrix_from_pose(camera.rig_from_cam)
        rig_from_cam[:3, :3] = se3.exp_so3(np.radians(OFF_DEG) * rng.normal(size=3)) @ rig_from_cam[:3, :3]
        cameras.append(camera.model_copy(update={"rig_from_cam": pose_from_matrix(rig_from_cam)}))
    antenna_m = se3.apply(route.world_from_rig, ARM_M[None])[:, 0]
    times_us = np.array([frame.timestamp_us for frame in manifest.frames])
    gnss = Gnss.model_validate(receiver.gnss(times_us, antenna_m, ARM_M, rng))
    rig = manifest.rig.model_copy(update={"cameras": cameras})
    return Drive(route.drive.root, manifest.model_copy(update={"rig": rig, "gnss": gnss}))
