"""Line 37: maps of simulated scenes, a few and many, without images: how time and memory grow with their number.

A scene costs as much as the pairs that it is in. Scenes of both maps are therefore in the same surroundings: they
follow one another twice round a closed path, whose corners are as far apart and whose scenes overlap as much, and which
is four times as long where there are four times as many. A drive through a city comes back to more streets the longer
it is.
"""

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
from mrasfm_engine.synthetic.city import Junction, route_over
from mrasfm_engine.synthetic.gnss import receive
from mrasfm_engine.synthetic.long_route import RIGS, SPACING_M, LongRoute, observe_route
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.rigs import true_cameras
from tests.benchmarks.commands import cpu_time_s, mrasfm, read_report
from tests.benchmarks.table import Figure, exactly

FEW, MANY, UNITS = 15, 60, 30
# Every street ends at a corner. The first round takes half of the scenes: those of the second one are half a scene on.
RINGS: dict[int, tuple[Junction, ...]] = {
    FEW: ((0, 0), (1, 0), (1, 1), (0, 1)),
    MANY: (
        (2, 0), (3, 0), (3, 1), (4, 1), (4, 2), (3, 2), (3, 3), (2, 3),
        (2, 4), (1, 4), (1, 3), (0, 3), (0, 2), (1, 2), (1, 1), (2, 1),
    ),
}  # fmt: skip
LAPS = 3  # two, and what the last scenes are longer
STEP = 2  # of the route's units in a scene; the next scene has the units between
RIG, KEYPOINTS, SEED, GNSS_NOISE_M = "stereo", 600, 3, 1.0
MOST_TIMES = 1.2
MAX_RMSE_M = 1.0  # the receiver's noise: what places the map as a whole


def many_scenes(data: Path, work: Path) -> Iterator[Figure]:
    """Line 37."""
    figure = partial(Figure, line="37")
    per_scene: dict[int, tuple[float, float, float]] = {}
    for count in (FEW, MANY):
        route, starts = _ring(count)
        out = work / f"map of {count} scenes"
        scenes = [_scene(route, k, start, work / f"{count} scenes") for k, start in enumerate(starts)]
        settings = out.with_suffix(".toml")
        settings.write_text("[output]\npictures = false\n", encoding="utf-8")
        before_s, started = cpu_time_s(), time.perf_counter()
        mrasfm("aggregate", *scenes, "--config", settings, "--out", out)
        taken_s, cpu_s = time.perf_counter() - started, cpu_time_s() - before_s
        # Of the largest command so far: the map of few scenes comes first.
        memory_bytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )
        pairs = read_report(out)["by_stage"]["seams"]["pairs"]
        per_scene[count] = cpu_s / count, memory_bytes / count, pairs / count
        truths = [f"{scene.name}={_drive_of(scene) / 'truth.tum'}" for scene in scenes]
        errors = json.loads(mrasfm("evaluate", out, "--json", "--truth", *truths))
        what = f"{count} scenes of {UNITS} units"
        yield exactly("37", f"{what}: scenes not connected", len(errors["unconnected"]), 0)
        yield figure(what=f"{what}: pairs of scenes", value=pairs)
        yield figure(what=f"{what}: seams", value=len(errors["seams"]), above=count - 2, most=count * count)
        yield figure(what=f"{what}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=MAX_RMSE_M)
        worst_m = max(seam["translation_m"] for seam in errors["seams"])
        yield figure(what=f"{what}: worst seam", value=worst_m, unit="m", most=0.1)
        yield figure(what=f"{what}: time", value=taken_s, unit="s")
        yield figure(what=f"{what}: peak memory", value=memory_bytes / 1e9, unit="GB")
    for name, few, many in zip(("CPU time", "memory", "pairs"), per_scene[FEW], per_scene[MANY], strict=True):
        what = f"{name} of a scene, in a map of {MANY} to one of {FEW}"
        yield figure(what=what, value=many / few, most=MOST_TIMES)


def _drive_of(scene: Path) -> Path:
    return scene.parent.parent / "simulated drives" / scene.name


def _ring(count: int) -> tuple[LongRoute, list[int]]:
    """Two rounds of a closed path for so many scenes, and the route's unit at which each of them begins."""
    ring, rng = RINGS[count], np.random.default_rng(SEED)
    every = route_over([*ring * LAPS, ring[0]], rng)
    round_m = every.travelled_m[-1] / LAPS
    apart = 2.0 * round_m / SPACING_M / count
    # A round of an even number of scenes ends where one begins.
    shift = (0.0 if count % 2 else 0.5) * apart * (np.arange(count) >= count / 2)
    starts = np.round(apart * np.arange(count) + shift).astype(int).tolist()
    travelled_m = SPACING_M * np.arange(starts[-1] + STEP * UNITS + 1)
    number, (width, height) = RIGS[RIG]
    cameras = true_cameras(number, width=width, height=height, rng=rng)
    return observe_route(cameras, every.world_from_rig(travelled_m), seed=SEED), starts


def _scene(route: LongRoute, number: int, start: int, work: Path) -> Path:
    """The scene of a drive along a part of the route, from its unit `start`."""
    scene = work / "simulated scenes" / f"drive_{number:02d}"
    cameras = len(route.cameras)
    units = start + np.arange(number % STEP, STEP * UNITS, STEP)
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
    refined, _ = stages.refinement(run, stages.mapped(run, [], prior), prior)
    write_scene(refined, scene, run.report)
    return scene


def _no_progress(stage: str, done: int, total: int) -> None:
    """Progress of what takes some seconds."""
