"""Line 3: rendered drives whose truth is known exactly. The worst of all seeds counts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.evaluation.trajectory import FIRST_UNITS, end_error_m
from mrasfm_engine.io.read_scene import read_calibration, read_poses
from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.edited_drives import edited_drive
from tests.benchmarks.table import Figure, exactly
from tests.helpers.camera_errors import compare_calibrations

SEEDS = (1, 2, 3, 4, 5)
CAMERAS, UNITS = 6, 40
LOOP_UNITS = 64
LOOP_SPACING_M = 2.0
LOOP_SIZE = ("--width", 640, "--height", 360)  # the time of the whole run is bounded
PERTURBATION = ("--perturb-rotation-deg", 0.3, "--perturb-translation-m", 0.02)
# What `mrasfm synth --tight` declares.
TIGHT = {"sigma_rotation_deg": 0.01, "sigma_translation_m": 0.001}


def rendered(work: Path, seed: int) -> Iterator[Figure]:
    """Lines 3a and 3b."""
    drive = work / f"seed {seed}"
    mrasfm("synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", seed, *PERTURBATION, "--out", drive)
    yield from perturbed(drive, work / f"seed {seed} perturbed scene", seed)
    yield from tight(_with_true_calibration(drive, work / f"seed {seed} tight"), work / f"seed {seed} tight scene")


def rendered_loop(work: Path, seed: int) -> Iterator[Figure]:
    """Line 3c."""
    drive = work / f"loop {seed}"
    route = ("--world", "loop", "--units", LOOP_UNITS, "--spacing-m", LOOP_SPACING_M)
    mrasfm("synth", "--cameras", CAMERAS, "--seed", seed, *route, *LOOP_SIZE, "--no-masks", "--tight", "--out", drive)
    yield from loop(drive, work / f"loop {seed} scene", seed)


def perturbed(drive: Path, scene: Path, seed: int) -> Iterator[Figure]:
    """Line 3a: the calibration is found again, and the scale is as good as the report says."""
    mrasfm("reconstruct", drive, "--out", scene)
    errors = evaluate(scene, drive)
    title = f"seed {seed}, calibration off by 0.3 deg and 2 cm"
    yield exactly("3a", f"{title}: images registered", errors["registered_images"], CAMERAS * UNITS)
    similarity = errors["similarity"]
    yield Figure(line="3a", what=f"{title}: similarity RMSE", value=similarity["rmse_m"], unit="m", most=0.03)
    pairs = compare_calibrations(
        read_calibration(scene / "calibration.json"), read_calibration(drive / "truth_calibration.json")
    )
    worst = max(pairs, key=lambda pair: pair.rotation_deg)
    yield Figure(
        line="3a",
        what=f"{title}: worst relative rotation ({worst.camera_a}, {worst.camera_b})",
        value=worst.rotation_deg,
        unit="deg",
        most=0.05,
    )
    sigma = read_report(scene)["by_stage"]["refinement"]["scale"]["sigma_relative"]
    yield Figure(line="3a", what=f"{title}: sigma of the scale, as reported", value=100 * sigma, unit="%")
    yield Figure(
        line="3a",
        what=f"{title}: error of the scale in sigmas",
        value=abs(similarity["scale"] - 1) / sigma,
        most=3.0,
    )


def tight(drive: Path, scene: Path) -> Iterator[Figure]:
    """Line 3b: with a calibration known to 0.01 deg and 1 mm the scale is that of the rig."""
    mrasfm("reconstruct", drive, "--out", scene)
    errors = evaluate(scene, drive)
    yield exactly("3b", f"{drive.name}: images registered", errors["registered_images"], CAMERAS * UNITS)
    yield Figure(line="3b", what=f"{drive.name}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=0.05)


def _with_true_calibration(drive: Path, out: Path) -> Path:
    """The drive that `synth --tight` would render without the perturbation: the same images under another manifest."""
    truth = json.loads((drive / "truth_calibration.json").read_text(encoding="utf-8"))

    def edit(manifest: dict[str, Any]) -> None:
        for camera in manifest["rig"]["cameras"]:
            camera |= {"rig_from_cam": truth[camera["name"]], **TIGHT}

    return edited_drive(drive, out, edit)


def error_of_the_end(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Length of a path in metres, and the error of its end in per cent of that; NaN where the end is missing."""
    length_m = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    error_m = end_error_m(found, truth)
    return length_m, float("nan") if error_m is None else 100 * error_m / length_m


def loop(drive: Path, scene: Path, seed: int) -> Iterator[Figure]:
    """Line 3c: a route that returns, without GNSS."""
    mrasfm("reconstruct", drive, "--out", scene, "--no-gnss")
    poses = read_poses(scene)
    yield exactly("3c", f"loop {seed}: units registered", len(poses.trajectory.timestamps_us), LOOP_UNITS)
    if len(poses.trajectory.timestamps_us) < LOOP_UNITS:
        return
    truth = read_tum(drive / "truth.tum").world_from_rig
    length_m, percent = error_of_the_end(poses.trajectory.world_from_rig, truth)
    # The end lies beside the start, so the error there shows that the loop closed and nothing of the way between.
    whole_m = evaluate(scene, drive)["metric"]["rmse_m"]
    yield Figure(line="3c", what=f"loop {seed}: metric RMSE of the whole way", value=whole_m, unit="m")
    yield Figure(line="3c", what=f"loop {seed}: length of the way", value=length_m, unit="m")
    yield Figure(
        line="3c",
        what=f"loop {seed}: error at the end, of the way's length (aligned on the first {FIRST_UNITS} units)",
        value=percent,
        unit="%",
        most=0.2,
    )
