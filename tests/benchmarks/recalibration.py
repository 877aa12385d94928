"""Line 8: a camera with a wrong extrinsic, and what a straight street lets a drive observe of its calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_scene import read_calibration
from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.table import Figure, exactly
from tests.benchmarks.true_information import ExactScene, camera_information, expected_directions
from tests.helpers.camera_errors import compare_calibrations

CAMERAS, UNITS = 6, 40
SIZE = ("--width", 640, "--height", 360)  # the time of the whole run is bounded
WRONG = ("front", "front_left", "front_right", "back_left", "back_right", "back")  # by seed
WRONG_BY_DEG = 3.0
MAX_WRONG_DEG, MAX_OTHERS_DEG = 0.1, 0.05

STRAIGHT_UNITS = 92  # of 1.1 m: 100 m
SIGMA_DEG, SIGMA_M = 0.1, 0.005  # declared, and true, for each axis
# The options are norms of an error; sigmas are for each axis.
AS_DECLARED = (
    "--perturb-rotation-deg", SIGMA_DEG * np.sqrt(3), "--perturb-translation-m", SIGMA_M * np.sqrt(3),
    "--declare-sigmas",
)  # fmt: skip
GNSS_NOISE_M, VERTICAL = 0.8, 1.5
GNSS = ("--gnss-noise-m", GNSS_NOISE_M, "--gnss-drift-m", 0, "--gnss-bias-m", 0, "--gnss-outliers", 0.05)
MAX_METRIC_RMSE_M = 0.2
MAX_HELD_SHARE = 0.1  # of the prior's sigma
LIKELY_SIGMAS = 3.0
COMMON_MOTIONS = 7  # all cameras by one transform, and their scale
HIDDEN, SEEN = 0.9, 0.5  # of the prior's sigma: more is left in what images do not show, less in what they do


def recalibration(work: Path, seed: int) -> Iterator[Figure]:
    """Line 8a."""
    drive = work / "with a wrong camera"
    name = WRONG[seed % len(WRONG)]
    mrasfm(
        "synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", seed, "--no-masks", *SIZE,
        "--miscalibrated-camera", name, "--miscalibrated-by-deg", WRONG_BY_DEG, "--out", drive,
    )  # fmt: skip
    yield from wrong_camera(drive, work / "with a wrong camera, scene", name, seed)


def straight_street(work: Path, seed: int) -> Iterator[Figure]:
    """Line 8b."""
    drive = work / "straight"
    mrasfm(
        "synth", "--cameras", CAMERAS, "--units", STRAIGHT_UNITS, "--seed", seed, "--straight", "--no-masks",
        *SIZE, *GNSS, *AS_DECLARED, "--out", drive,
    )  # fmt: skip
    yield from straight(drive, work / "straight, scene", seed)


def wrong_camera(drive: Path, scene: Path, name: str, seed: int) -> Iterator[Figure]:
    """Line 8a: the camera is named and recalibrated, the others stay."""
    printed = mrasfm("reconstruct", drive, "--out", scene)
    title = f"seed {seed}, {name} off by {WRONG_BY_DEG:g} deg"
    report = read_report(scene)
    named = [camera["camera"] for camera in report["by_stage"]["refinement"]["calibration"]["cameras_wrong"]]
    yield exactly("8a", f"{title}: named", int(name in named), 1)
    yield exactly("8a", f"{title}: other cameras named + 1", len(set(named) - {name}) + 1, 1)
    yield exactly("8a", f"{title}: named on the command line", int(f"camera {name} is turned" in printed), 1)
    refined, true = read_calibration(scene / "calibration.json"), read_calibration(drive / "truth_calibration.json")
    errors = {n: se3.log_so3(refined[n][:3, :3] @ true[n][:3, :3].T) for n in true}
    others = {n: refined[n] for n in true if n != name}
    median = np.median([errors[n] for n in others], axis=0)
    own = float(np.degrees(np.linalg.norm(errors[name] - median)))
    yield Figure(
        line="8a", what=f"{title}: error left, to the median of the others", value=own, unit="deg", most=MAX_WRONG_DEG
    )
    worst = max(pair.rotation_deg for pair in compare_calibrations(others, true))
    yield Figure(
        line="8a", what=f"{title}: worst relative rotation of two others", value=worst, unit="deg", most=MAX_OTHERS_DEG
    )


def straight(drive: Path, scene: Path, seed: int) -> Iterator[Figure]:
    """Line 8b: 100 m straight on, a calibration as good as declared, a noisy receiver."""
    mrasfm("reconstruct", drive, "--out", scene)
    title = f"straight {seed}"
    yield exactly(
        "8b", f"{title}: images registered", evaluate(scene, drive)["registered_images"], CAMERAS * STRAIGHT_UNITS
    )
    rmse_m = evaluate(scene, drive)["metric"]["rmse_m"]
    yield Figure(line="8b", what=f"{title}: metric RMSE", value=rmse_m, unit="m", most=MAX_METRIC_RMSE_M)
    yield from verdicts(drive, scene, title)


def verdicts(drive: Path, scene: Path, title: str) -> Iterator[Figure]:
    """What is reported unobservable against what the exact scene says, and that it was left alone."""
    document = json.loads((scene / "calibration.json").read_text(encoding="utf-8"))
    names = list(document["cameras"])
    true = read_calibration(drive / "truth_calibration.json")
    rig_from_cam = np.stack([true[name] for name in names])
    antenna_m = json.loads((drive / "drive.json").read_text(encoding="utf-8"))["gnss"]["antenna_in_rig_m"]
    information = camera_information(
        ExactScene.of(
            pycolmap.Reconstruction(scene / "model"), names, read_tum(drive / "truth.tum").world_from_rig, rig_from_cam
        ),
        np.array(antenna_m),
        GNSS_NOISE_M * np.array([1.0, 1.0, VERTICAL]),
    )
    sigma = np.repeat([np.radians(SIGMA_DEG), SIGMA_M], 3)
    expected = expected_directions(information, rig_from_cam[:, :3, 3], sigma)
    hidden = np.sort(expected.hidden)[::-1]
    # Six motions of all cameras are hidden altogether; the seventh, their scale, but for what positions say.
    yield Figure(
        line="8b",
        what=f"{title}: prior sigma left in the 6th least visible motion",
        value=hidden[5],
        above=HIDDEN,
        most=1.0,
    )
    yield Figure(
        line="8b", what=f"{title}: prior sigma left in the scale", value=expected.scale_ratio, above=SEEN, most=1.0
    )
    yield Figure(line="8b", what=f"{title}: prior sigma left in the next one", value=hidden[COMMON_MOTIONS], most=SEEN)
    yield Figure(
        line="8b",
        what=f"{title}: prior sigma left in a camera's direction, at most",
        value=float(np.nanmax(expected.ratio)),
    )
    observed = np.array(
        [[*(seen := document["cameras"][n]["observed"])["rotation"], *seen["translation"]] for n in names]
    )
    common = document["common"]
    reported = [
        *observed.ravel(),
        *common["rotation"]["observed"],
        *common["translation"]["observed"],
        common["scale"]["observed"],
    ]
    right = [*expected.observed.ravel(), *[False] * 6, expected.scale_ratio < SEEN]
    yield exactly(
        "8b", f"{title}: verdicts as the geometry has them", int(np.sum(np.equal(reported, right))), len(right)
    )
    yield Figure(
        line="8b",
        what=f"{title}: verdicts of directions that are not observed",
        value=len(right) - sum(map(bool, reported)),
    )
    corrections = np.array([_correction(document["cameras"][name]) for name in names]) / sigma
    # Positions say a little of the scale, and it moves as far as they and its prior have it: no more than is likely.
    size = np.stack([np.array(document["cameras"][n]["given"]["rig_from_cam"]["translation_m"]) for n in names])
    size = (size - size.mean(0)).ravel() / SIGMA_M
    grown = abs(float(size @ corrections[:, 3:].ravel())) / float(np.linalg.norm(size))
    yield Figure(
        line="8b",
        what=f"{title}: correction of the scale, in sigmas of what positions may move it by",
        value=grown / math.sqrt(1.0 - expected.scale_ratio**2),
        most=LIKELY_SIGMAS,
    )
    left_alone = [np.abs(corrections.mean(0)).max(), *np.abs(corrections[~observed])]
    yield Figure(
        line="8b",
        what=f"{title}: largest correction where nothing is observed, of the prior's sigma",
        value=float(max(left_alone)),
        above=-1.0,  # exactly as given is what to hope for
        most=MAX_HELD_SHARE,
    )


def _correction(camera: dict) -> np.ndarray:  # type: ignore[type-arg]
    difference = camera["difference"]
    return np.concatenate([np.radians(difference["rotation_vector_deg"]), difference["translation_m"]])
