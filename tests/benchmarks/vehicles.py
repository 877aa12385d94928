"""Line 20f: two drives of one vehicle, a turn and a short straight street, whose given calibration is off.

The turn is driven with a usual receiver and with a precise one, the straight street with a usual one.
"""

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
RECEIVERS = {
    "usual": (),
    "precise": ("--gnss-noise-m", 0.02, "--gnss-drift-m", 0, "--gnss-bias-m", 0),
}
MOST_SHARE = {"usual": 0.8, "precise": 0.3}  # of the straight street's error that is left
SIZE = ("--cameras", 3, "--width", 640, "--height", 360, "--no-masks")
TOLERANCE_US = 1000


def vehicles(work: Path, seed: int) -> Iterator[Figure]:
    """Line 20f."""
    if seed not in AGGREGATION_SEEDS:
        return
    folder = work / f"vehicle {seed}"
    straight = _scene(folder / STRAIGHT, STRAIGHT, seed)
    for receiver, options in RECEIVERS.items():
        own = folder / receiver
        drives = {TURN: own / TURN, STRAIGHT: folder / STRAIGHT}
        scenes = {TURN: _scene(drives[TURN], TURN, seed, *options), STRAIGHT: straight}
        yield from _figures(own, drives, scenes, f"vehicle {seed}, {receiver} receiver", MOST_SHARE[receiver])


def _scene(drive: Path, world: str, seed: int, *options: object) -> Path:
    mrasfm("synth", *WORLDS[world], *CALIBRATION, *SIZE, *options, "--seed", seed, "--out", drive)
    scene = drive.with_name(f"scene {drive.name}")
    mrasfm("reconstruct", drive, "--out", scene)
    return scene


def _figures(
    folder: Path, drives: Mapping[str, Path], scenes: Mapping[str, Path], title: str, most_share: float
) -> Iterator[Figure]:
    places_mm, rmse_m = {}, {}
    for how, named in (("apart", ("van-7", "van-8")), ("together", ("van-7", "van-7"))):
        out = _map(folder / how, scenes, dict(zip(scenes, named, strict=True)))
        found = json.loads((out / "map.json").read_text())["vehicles"]
        learning = [name for vehicle in found for name in vehicle["learning"]]
        yield exactly("20f", f"{title}, {how}: drives that learn", len(learning), int(how == "together"))
        for name, drive in drives.items():
            places_mm[how, name] = _camera_places_mm(out / "calibration" / f"{name}.json", drive)
            rmse_m[how, name] = _metric_rmse_m(out, name, drive)
    for name in drives:
        most = most_share if name == STRAIGHT else 1.001
        for kind, unit, values in (("places of cameras", "mm", places_mm), ("metric RMSE", "m", rmse_m)):
            for how in ("apart", "together"):
                yield Figure(line="20f", what=f"{title}, {name}: {kind}, {how}", value=values[how, name], unit=unit)
            share = values["together", name] / values["apart", name]
            most_here = most if kind == "metric RMSE" else max(most, 0.8)
            yield Figure(line="20f", what=f"{title}, {name}: {kind}, of apart", value=share, most=most_here)


def _map(folder: Path, scenes: Mapping[str, Path], vehicle_of: Mapping[str, str]) -> Path:
    """The map of the scenes as if their drives had named these vehicles."""
    named = []
    for name, scene in scenes.items():
        named.append(folder / name)
        shutil.copytree(scene, named[-1])
        manifest = json.loads((scene / "manifest.json").read_text())
        (named[-1] / "manifest.json").write_text(json.dumps({**manifest, "version": 2, "vehicle": vehicle_of[name]}))
    mrasfm("aggregate", *named, "--out", folder / "map")
    return folder / "map"


def _camera_places_mm(calibration: Path, drive: Path) -> float:
    """RMS error of where cameras are on the vehicle, but for what all have in common."""
    found, true = read_calibration(calibration), read_calibration(drive / "truth_calibration.json")
    off_m = np.stack([found[name][:3, 3] - true[name][:3, 3] for name in true])
    return 1000.0 * float(np.sqrt(((off_m - off_m.mean(0)) ** 2).sum(1).mean()))


def _metric_rmse_m(out: Path, name: str, drive: Path) -> float:
    own, true = read_map(out).trajectories[name], read_tum(drive / "truth.tum")
    rows, of_truth = match_timestamps(own.timestamps_us, true.timestamps_us, tolerance_us=TOLERANCE_US)
    return compare_trajectories(own.world_from_rig[rows], true.world_from_rig[of_truth]).metric_rmse_m
