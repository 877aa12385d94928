"""Line 20f: two drives of one vehicle, a turn and a short straight street, whose given calibration is off."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from mrasfm_engine.evaluation.trajectory import compare_trajectories, match_timestamps
from mrasfm_engine.io.read_map import read_map
from mrasfm_engine.io.read_scene import read_calibration
from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.aggregation import AGGREGATION_SEEDS
from tests.benchmarks.commands import mrasfm
from tests.benchmarks.table import Figure, exactly

TURN, STRAIGHT = "turn", "straight"
WORLDS = {TURN: ("--world", "turn", "--units", 30), STRAIGHT: ("--world", "street", "--straight", "--units", 14)}
CALIBRATION = ("--perturb-rotation-deg", 1.0, "--perturb-translation-m", 0.05, "--declare-sigmas")
SIZE = ("--cameras", 3, "--width", 640, "--height", 360, "--no-masks")
TOLERANCE_US = 1000


def vehicles(work: Path, seed: int) -> Iterator[Figure]:
    """Line 20f."""
    if seed not in AGGREGATION_SEEDS:
        return
    folder = work / f"vehicle {seed}"
    drives = {name: folder / name for name in WORLDS}
    for name, drive in drives.items():
        mrasfm("synth", *WORLDS[name], *CALIBRATION, *SIZE, "--seed", seed, "--out", drive)
        mrasfm("reconstruct", drive, "--out", folder / f"scene {name}")
    rms_mm, rmse_m = {}, {}
    for title, named in (("apart", ("van-7", "van-8")), ("together", ("van-7", "van-7"))):
        out = _map(folder, title, dict(zip(WORLDS, named, strict=True)))
        learning = [n for v in json.loads((out / "map.json").read_text())["vehicles"] for n in v["learning"]]
        yield exactly("20f", f"vehicle {seed}, {title}: drives that learn", len(learning), int(title == "together"))
        for name, drive in drives.items():
            rms_mm[title, name] = _camera_places_mm(out / "calibration" / f"{name}.json", drive)
            rmse_m[title, name] = _metric_rmse_m(out, name, drive)
    for name in WORLDS:
        what = f"vehicle {seed}, {name}"
        most = 0.8 if name == STRAIGHT else 1.1
        for kind, values in (("places of cameras", rms_mm), ("metric RMSE", rmse_m)):
            share = values["together", name] / values["apart", name]
            yield Figure(line="20f", what=f"{what}: {kind}, together of apart", value=share, most=most)
        yield Figure(line="20f", what=f"{what}: places of cameras, together", value=rms_mm["together", name], unit="mm")
        yield Figure(line="20f", what=f"{what}: metric RMSE, together", value=rmse_m["together", name], unit="m")


def _map(folder: Path, title: str, vehicle_of: Mapping[str, str]) -> Path:
    """The map of the scenes as if their drives had named these vehicles."""
    scenes = []
    for name, vehicle in vehicle_of.items():
        scene = folder / title / name
        shutil.copytree(folder / f"scene {name}", scene)
        manifest = json.loads((scene / "manifest.json").read_text())
        (scene / "manifest.json").write_text(json.dumps({**manifest, "version": 2, "vehicle": vehicle}))
        scenes.append(scene)
    mrasfm("aggregate", *scenes, "--out", folder / f"map {title}")
    return folder / f"map {title}"


def _camera_places_mm(calibration: Path, drive: Path) -> float:
    """RMS error of where cameras are on the vehicle, but for what all have in common."""
    found, true = read_calibration(calibration), read_calibration(drive / "truth_calibration.json")
    off_m = np.stack([found[name][:3, 3] - true[name][:3, 3] for name in true])
    return 1000.0 * float(np.sqrt(((off_m - off_m.mean(0)) ** 2).sum(1).mean()))


def _metric_rmse_m(out: Path, name: str, drive: Path) -> float:
    own, true = read_map(out).trajectories[name], read_tum(drive / "truth.tum")
    rows, of_truth = match_timestamps(own.timestamps_us, true.timestamps_us, tolerance_us=TOLERANCE_US)
    return compare_trajectories(own.world_from_rig[rows], true.world_from_rig[of_truth]).metric_rmse_m
