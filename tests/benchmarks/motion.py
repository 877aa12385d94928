"""Line 9: cameras that are up to 50 ms apart, on a drive that turns at 3 to 12 m/s. The worst of all seeds counts."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mrasfm_engine.io.read_scene import read_calibration
from tests.benchmarks.commands import evaluate, mrasfm
from tests.benchmarks.recalibration import AS_DECLARED
from tests.benchmarks.table import Figure, exactly

CAMERAS, UNITS = 6, 40
SIZE = ("--width", 640, "--height", 360)  # the time of the whole run is bounded
WAY = ("--world", "turn", "--speed-profile", "varying")
SKEW_MS = 50
FLOOR_M = 0.02  # errors below this are as good as none
NEAR, FAR = 1.3, 2.0  # of the simultaneous drive's error: compensated at most, not compensated at least twice that
MEASURES = {"units": "metric RMSE of the units", "cameras": "largest error of a camera's place in the rig"}


def motion(work: Path, seed: int) -> Iterator[Figure]:
    """Line 9."""
    drives = {}
    for name, skew_ms in (("simultaneous", 0), ("apart", SKEW_MS)):
        drives[name] = work / f"motion, {name}"
        size = ("--cameras", CAMERAS, "--units", UNITS, *SIZE, "--seed", seed)
        # The calibration is as good as it is declared to be: what is compared is time, and not a scale that only a
        # wide prior would leave open.
        mrasfm("synth", *size, *WAY, *AS_DECLARED, "--time-skew-ms", skew_ms, "--out", drives[name])
    yield from compared(drives["simultaneous"], drives["apart"], work, seed)


def compared(simultaneous: Path, apart: Path, work: Path, seed: int) -> Iterator[Figure]:
    """One drive with simultaneous cameras, with cameras that are apart, and with these not compensated."""
    ignoring = work / "ignoring.toml"
    ignoring.write_text("[mapping]\nmotion_compensation = false\n", encoding="utf-8")
    scenes = {name: work / f"motion, scene {name}" for name in ("simultaneous", "apart", "ignored")}
    mrasfm("reconstruct", simultaneous, "--out", scenes["simultaneous"])
    mrasfm("reconstruct", apart, "--out", scenes["apart"])
    # Features and matches are the same: their stages are taken over.
    shutil.copytree(scenes["apart"] / ".stages", scenes["ignored"] / ".stages")
    mrasfm("reconstruct", apart, "--out", scenes["ignored"], "--config", ignoring)
    errors = {name: _errors(scene, simultaneous if name == "simultaneous" else apart) for name, scene in scenes.items()}
    for name in ("simultaneous", "apart"):
        yield exactly("9", f"seed {seed}, {name}: images registered", errors[name]["images"], CAMERAS * UNITS)
    for key, what in MEASURES.items():
        title = f"seed {seed}: {what}"
        allowed = max(NEAR * errors["simultaneous"][key], FLOOR_M)
        yield Figure(line="9", what=f"{title}, simultaneous", value=errors["simultaneous"][key], unit="m")
        yield Figure(line="9", what=f"{title}, {SKEW_MS} ms apart", value=errors["apart"][key], unit="m", most=allowed)
        yield Figure(
            line="9",
            what=f"{title}, not compensated",
            value=errors["ignored"][key],
            unit="m",
            above=FAR * allowed,
            most=100.0,
        )
    for scene in scenes.values():
        shutil.rmtree(scene)


def _errors(scene: Path, drive: Path) -> dict[str, float]:
    evaluation = evaluate(scene, drive)
    found, truth = (read_calibration(path) for path in (scene / "calibration.json", drive / "truth_calibration.json"))
    offset = np.array([found[name][:3, 3] - truth[name][:3, 3] for name in sorted(truth)])
    # Where the cameras are as a whole is a gauge: images do not see it.
    offset -= np.median(offset, axis=0)
    return {
        "images": evaluation["registered_images"],
        "units": evaluation["metric"]["rmse_m"],
        "cameras": float(np.linalg.norm(offset, axis=1).max()),
    }
