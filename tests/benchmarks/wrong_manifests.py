"""Line 18: a real drive whose manifest is wrong about the cameras, with receivers of different quality."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_scene import read_calibration
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.types import Floats
from schemas import Pose
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.edited_drives import Edit, turned
from tests.benchmarks.positions import Receiver
from tests.benchmarks.real_drives import imported
from tests.benchmarks.recalibration import AS_DECLARED
from tests.benchmarks.table import Figure, exactly

TURNED = 1  # of the rig's two cameras
FOCAL, SIGMA_FOCAL = 1.01, 0.02
TURNING = ("--cameras", 6, "--units", 40, "--seed", 1, "--width", 640, "--height", 360)
RTK = Receiver(white_m=0.02, declared_m=0.02)
ARM_M = np.array([0.5, 0.1, 1.5])


def wrong_manifests(data: Path, work: Path) -> Iterator[Figure]:
    """Line 18."""
    drive = imported(data, "kitti06", work)
    rtk = _rtk(drive)
    for what, turn_deg, without_gnss_m in (
        ("pitched by +1 deg", (1.0, 0.0, 0.0), 0.20),
        ("pitched by -1 deg", (-1.0, 0.0, 0.0), 0.20),
        ("pitched by 12 deg", (12.0, 0.0, 0.0), 0.40),
        ("yawed by 10 deg", (0.0, 10.0, 0.0), 0.40),
        ("rolled by 12 deg", (0.0, 0.0, 12.0), 0.40),
    ):
        turn = turned(TURNED, turn_deg)
        title = f"kitti06, a camera {what}"
        for receiver, edits, options, most_m in (
            ("without GNSS", [turn], ("--no-gnss",), without_gnss_m),
            ("GNSS", [turn], (), 0.04),
            ("RTK of 2 cm", [turn, rtk], (), 0.04),
        ):
            scene = _reconstructed(drive, work / f"{title}, {receiver}", edits, *options)
            errors = evaluate(scene, drive)
            yield exactly("18", f"{title}, {receiver}: images registered", errors["registered_images"], 102)
            yield rmse(f"{title}, {receiver}", errors, most_m)
            yield Figure(
                line="18",
                what=f"{title}, {receiver}: error of the relative rotation",
                value=_relative_error_deg(drive, scene),
                unit="deg",
                most=0.1,
            )
    yield from _focal_lengths(drive, work)
    yield from _distortion_left(data, work)


def _distortion_left(data: Path, work: Path) -> Iterator[Figure]:
    """A real drive that turns, and in whose rectified images distortion is left without a word."""
    drive = imported(data, "kitti01", work)
    rtk = _rtk(drive)
    for title, options, edits, most_m in (
        ("without GNSS", ("--no-gnss",), [], 0.20),
        ("GNSS", (), [], 0.12),
        ("RTK of 2 cm", (), [rtk], 0.05),
    ):
        title = f"kitti01, distortion left, {title}"
        scene = _reconstructed(drive, work / title, edits, *options)
        errors = evaluate(scene, drive)
        yield rmse(title, errors, most_m)
        yield Figure(
            line="18",
            what=f"{title}: position, similarity RMSE",
            value=errors["similarity"]["rmse_m"],
            unit="m",
            most=0.05,
        )
        moved = sum(finding["code"] == "antenna-position" for finding in read_report(scene)["findings"])
        yield exactly("18", f"{title}: findings of an antenna that is elsewhere", moved, 0)


def _focal_lengths(drive: Path, work: Path) -> Iterator[Figure]:
    """A real drive straight on, which does not observe them, and a rendered one that turns by 90 deg."""
    settings = work / "refine_focal.toml"
    settings.write_text(f"[bundle_adjustment]\nrefine_focal = true\nsigma_focal = {SIGMA_FOCAL}\n", encoding="utf-8")
    title = "kitti06, focal lengths 1 % long, GNSS"
    scene = _reconstructed(drive, work / title, [_long_focal_lengths], "--config", settings)
    yield rmse(title, evaluate(scene, drive), 0.03)
    held = sum(finding["code"] == "focal-not-observed" for finding in read_report(scene)["findings"])
    yield exactly("18", f"{title}: cameras whose focal length is held, with a finding", held, 2)
    turning = work / "turning"
    mrasfm("synth", "--world", "turn", *TURNING, *AS_DECLARED, "--out", turning)
    title = "a rendered drive that turns by 90 deg, focal lengths 1 % long, GNSS"
    scene = _reconstructed(turning, work / title, [_long_focal_lengths], "--config", settings)
    cameras = json.loads((scene / "calibration.json").read_text(encoding="utf-8"))["cameras"]
    focal_px = {name: np.mean(camera["refined"]["params"][:2]) for name, camera in cameras.items()}
    true_px = {name: np.mean(camera["given"]["params"][:2]) / FOCAL for name, camera in cameras.items()}
    off_px = {name: abs(focal_px[name] - true_px[name]) for name in cameras}
    worst = max(100 * off_px[name] / true_px[name] for name in cameras)
    yield Figure(line="18", what=f"{title}: worst focal length's error", value=worst, unit="%", most=0.3)
    in_sigmas = max(off_px[name] / cameras[name]["sigma"]["focal_px"] for name in cameras)
    yield Figure(line="18", what=f"{title}: worst focal length's error in sigmas", value=in_sigmas, most=3.0)


def rmse(title: str, errors: dict[str, Any], most_m: float) -> Figure:
    """Position error of a scene, by what `evaluate` says."""
    return Figure(
        line="18", what=f"{title}: position, metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=most_m
    )


def edited(drive: Path, copy: Path, edits: Sequence[Edit]) -> Path:
    """A copy of the drive whose manifest is edited."""
    shutil.copytree(drive, copy)
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    for edit in edits:
        edit(manifest)
    (copy / "drive.json").write_text(json.dumps(manifest), encoding="utf-8")
    return copy


def _reconstructed(drive: Path, out: Path, edits: Sequence[Edit], *options: object) -> Path:
    """The scene of a copy of the drive whose manifest is edited."""
    mrasfm("reconstruct", edited(drive, out.with_name(out.name + ", drive"), edits), "--out", out, *options)
    return out


def _long_focal_lengths(manifest: dict[str, Any]) -> None:
    for camera in manifest["rig"]["cameras"]:
        camera["params"][:2] = [FOCAL * focal_px for focal_px in camera["params"][:2]]


def _rtk(drive: Path) -> Edit:
    """A receiver of white noise of 2 cm, declared so."""
    truth = read_tum(drive / "truth.tum")
    # The truth's frame is the first vehicle's: forward is east, left is north.
    antenna_m = se3.apply(truth.world_from_rig, ARM_M[None])[:, 0]

    def edit(manifest: dict[str, Any]) -> None:
        manifest["gnss"] = RTK.gnss(truth.timestamps_us, antenna_m, ARM_M, np.random.default_rng(1))

    return edit


def _relative_error_deg(drive: Path, scene: Path) -> float:
    """Pitch of the turned camera against the other, refined against what the recording says."""
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    given = np.stack([matrix_from_pose(Pose(**camera["rig_from_cam"])) for camera in manifest["rig"]["cameras"]])
    refined = read_calibration(scene / "calibration.json")
    found = np.stack([refined[camera["name"]] for camera in manifest["rig"]["cameras"]])
    return abs(_pitch_deg(found) - _pitch_deg(given))


def _pitch_deg(rig_from_cam: Floats) -> float:
    turn = se3.log_so3(rig_from_cam[0, :3, :3].T @ rig_from_cam[TURNED, :3, :3])
    return float(np.degrees(turn[0]))
