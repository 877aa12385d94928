"""Line 37: maps of simulated scenes, a few and many, without images: how time and memory grow with their number."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from mrasfm_engine import stages
from mrasfm_engine.benchmark.mapping import simulated_run
from mrasfm_engine.benchmark.simulated_descriptors import store_descriptors
from mrasfm_engine.benchmark.simulated_drive import drive_of_route
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.synthetic.gnss import receive
from mrasfm_engine.synthetic.long_route import LongRoute, simulate_long_route
from mrasfm_engine.synthetic.options import SynthOptions
from tests.benchmarks.commands import cpu_time_s, mrasfm
from tests.benchmarks.table import Figure, exactly

FEW, MANY, UNITS = 15, 60, 30
STEP = 2  # of the route's units in a scene; the next scene has the units between
AHEAD = 40  # of the route's units, from the begin of a scene to that of the next one: a third of each is shared
RIG, KEYPOINTS, SEED, GNSS_NOISE_M = "stereo", 600, 3, 1.0
MOST_TIMES = 1.2
MAX_RMSE_M = 1.0  # the receiver's noise: what places the map as a whole


def many_scenes(data: Path, work: Path) -> Iterator[Figure]:
    """Line 37."""
    route = simulate_long_route(RIG, AHEAD * MANY + STEP * UNITS + 1, seed=SEED)
    every = [_scene(route, k, work) for k in range(MANY)]
    figure = partial(Figure, line="37")
    per_scene: dict[int, tuple[float, float]] = {}
    for count in (FEW, MANY):
        scenes, out = every[:count], work / f"map of {count} scenes"
        settings = out.with_suffix(".toml")
        settings.write_text("[output]\npictures = false\n", encoding="utf-8")
        before_s, started = cpu_time_s(), time.perf_counter()
        mrasfm("aggregate", *scenes, "--config", settings, "--out", out)
        taken_s, cpu_s = time.perf_counter() - started, cpu_time_s() - before_s
        # Of the largest command so far: the map of few scenes comes first.
        memory_bytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )
        per_scene[count] = cpu_s / count, memory_bytes / count
        truths = [f"{scene.name}={_drive_of(scene) / 'truth.tum'}" for scene in scenes]
        errors = json.loads(mrasfm("evaluate", out, "--json", "--truth", *truths))
        what = f"{count} scenes of {UNITS} units"
        yield exactly("37", f"{what}: scenes not connected", len(errors["unconnected"]), 0)
        yield figure(what=f"{what}: seams", value=len(errors["seams"]), above=count - 2, most=count * count)
        yield figure(what=f"{what}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=MAX_RMSE_M)
        worst_m = max(seam["translation_m"] for seam in errors["seams"])
        yield figure(what=f"{what}: worst seam", value=worst_m, unit="m", most=0.1)
        yield figure(what=f"{what}: time", value=taken_s, unit="s")
        yield figure(what=f"{what}: peak memory", value=memory_bytes / 1e9, unit="GB")
    for name, few, many in zip(("CPU time", "memory"), per_scene[FEW], per_scene[MANY], strict=True):
        what = f"{name} of a scene, in a map of {MANY} to one of {FEW}"
        yield figure(what=what, value=many / few, most=MOST_TIMES)


def _drive_of(scene: Path) -> Path:
    return scene.parent.parent / "simulated drives" / scene.name


def _scene(route: LongRoute, number: int, work: Path) -> Path:
    """The scene of a drive along a part of the route."""
    scene = work / "simulated scenes" / f"drive_{number:02d}"
    cameras = len(route.cameras)
    units = np.arange(AHEAD * number + number % STEP, AHEAD * number + STEP * UNITS, STEP)
    images = (cameras * units[:, None] + np.arange(cameras)).ravel().tolist()
    part = LongRoute(
        cameras=route.cameras,
        world_from_rig=route.world_from_rig[units],
        points_m=route.points_m,
        xy_px=[route.xy_px[i] for i in images],
        point=[route.point[i] for i in images],
    )
    out = _drive_of(scene)
    drive = drive_of_route(RIG, part, out)
    rng = np.random.default_rng([SEED, number])
    options = SynthOptions(gnss_noise_m=GNSS_NOISE_M, gnss_drift_m=0.0, gnss_bias_m=0.0, gnss_outliers=0.0)
    gnss = receive(options, part.world_from_rig, drive.timestamps_us, rng)
    drive = Drive(out, drive.manifest.model_copy(update={"name": out.name, "gnss": gnss}))
    out.mkdir(parents=True)
    (out / "truth.tum").write_text(format_tum(drive.timestamps_us.tolist(), part.world_from_rig), encoding="utf-8")
    config = EngineConfig.model_validate({"features": {"max_keypoints": KEYPOINTS}})
    store_descriptors(simulated_run(_no_progress, drive, config, stages.store_of(out)), part, seed=SEED, number=number)
    run = simulated_run(_no_progress, drive, config, stages.store_of(out))
    run.report["drive"], run.report["settings"] = drive.manifest.name, config.model_dump(mode="json")
    stages.load_models(run)
    prior = stages.prior(run)
    features, matches, (model, *_) = stages.mapped(run, [], prior)
    write_scene(stages.scene(run, model, features, matches, prior), scene, run.report)
    return scene


def _no_progress(stage: str, done: int, total: int) -> None:
    """Progress of what takes some seconds."""
