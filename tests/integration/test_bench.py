"""`mrasfm bench` on a simulated route, beside COLMAP, and on folders in the layouts of KITTI and nuScenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive
from tests.integration.conftest import CommandResult, Variant, synth

Run = Callable[..., CommandResult]
UNITS = 6


@pytest.mark.slow
def test_a_simulated_route(mrasfm: Run) -> None:
    ran = mrasfm("bench", "--simulate", "stereo", "--units", 30, "--json")
    assert ran.code == 0, ran.err
    (route,) = json.loads(ran.out)["routes"]
    (ours,) = route["mappers"]
    assert (route["units"], route["images"], ours["registered_units"]) == (30, 60, 30)
    assert 28.0 < route["route_m"] < 30.0
    assert 22_000 < route["keypoints"] < 26_000
    assert 500 < ours["points"] < ours["observations"] < route["keypoints"]
    assert 0 < ours["route_error_percent"] < 0.3
    assert 0 < ours["end_error_percent"] < 0.6
    assert ours["per_unit_s"] == pytest.approx((ours["mapping_s"] + ours["refinement_s"]) / 30)
    assert 50e6 < ours["start_memory_bytes"] <= ours["peak_memory_bytes"] < 2e9


@pytest.mark.slow
def test_a_drive_beside_colmap(variant: Variant, mrasfm: Run, tmp_path: Path) -> None:
    drive = variant.keep(cameras=["front", "left"], units=UNITS).save().root
    out = tmp_path / "bench"
    ran = mrasfm("bench", drive, "--baselines", "colmap-global", "--out", out, "--json")
    assert ran.code == 0, ran.err
    document = json.loads(ran.out)
    assert json.loads((out / "bench.json").read_text()) == document
    assert document["features_and_matches"]["features_s"] > 0
    ours, baseline = document["mappers"]
    assert (ours["mapper"], baseline["mapper"]) == ("mrasfm", "colmap-global")
    for mapper in (ours, baseline):
        assert mapper["failure"] == ""
        assert mapper["registered_images"] == 2 * UNITS
        assert 50e6 < mapper["start_memory_bytes"] <= mapper["peak_memory_bytes"] < 2e9
        assert 0 < mapper["errors"]["similarity_rmse_m"] < 0.05
        assert mapper["mapping_s"] > 0
    assert baseline["refinement_s"] is None
    # Six units that go straight leave the scale to the calibration, which this drive has off by some hundredths.
    assert 0 < ours["errors"]["metric_rmse_m"] < 0.5


@pytest.mark.slow
def test_features_are_kept_and_the_median_mapping_counts(variant: Variant, mrasfm: Run, tmp_path: Path) -> None:
    drive = variant.keep(cameras=["front", "left"], units=UNITS).save().root
    out = tmp_path / "bench"
    assert mrasfm("bench", drive, "--out", out).code == 0
    # Without GNSS there are other matches of the same features.
    ran = mrasfm("bench", drive, "--no-gnss", "--repeat", 2, "--out", out, "--truth", drive / "truth.tum")
    assert ran.code == 0, ran.err
    assert "features taken from an earlier run" in ran.out
    (ours,) = json.loads((out / "bench.json").read_text())["mappers"]
    assert len(ours["runs_s"]) == 2
    assert ours["whole_s"] == min(ours["runs_s"])


def test_a_truth_of_another_drive_is_refused(variant: Variant, mrasfm: Run) -> None:
    truth = variant.root.parent / "other.tum"
    truth.write_text("".join(f"{t} 0 0 0 0 0 0 1\n" for t in range(5)))
    ran = mrasfm("bench", variant.root, "--truth", truth)
    assert ran.code == 2
    assert "0 timestamps in common" in ran.err


@pytest.mark.slow
def test_kitti(mrasfm: Run, tmp_path: Path) -> None:
    size = ("--width", 320, "--height", 180)
    drive = synth(tmp_path / "drive", *size, "--cameras", 2, "--units", UNITS, "--seed", 1, "--no-masks")
    root = as_kitti(read_drive(drive), tmp_path / "kitti")
    ran = mrasfm("bench", "--kitti", root, "--sequences", "04", "--json")
    assert ran.code == 0, ran.err
    (sequence,) = json.loads(ran.out)["sequences"]
    assert sequence["published"]["by_method"]["MRASfM"]["translation_m"] == 0.1
    (ours,) = sequence["mappers"]
    assert ours["registered_images"] == 2 * UNITS
    assert 0 < ours["errors"]["metric_median_m"] < 0.1
    assert 0 < ours["errors"]["rotation_median_deg"] < 0.3
    refused = mrasfm("bench", "--kitti", root, "--sequences", "04-05")
    assert refused.code == 2
    assert "sequences/05 does not exist" in refused.err


@pytest.mark.slow
def test_nuscenes(variant: Variant, mrasfm: Run, tmp_path: Path) -> None:
    drive = variant.keep(cameras=["front", "left", "right"], units=UNITS).save().root
    root = as_nuscenes(read_drive(drive), tmp_path / "nuscenes", scene="scene-0007")
    ran = mrasfm("bench", "--nuscenes", root, "--json")
    assert ran.code == 0, ran.err
    assert "noise of 0.5 m and 2 deg" in json.loads(ran.out)["setting"]
    (scene,) = json.loads(ran.out)["scenes"]
    (ours,) = scene["mappers"]
    assert (scene["name"], scene["units"], ours["registered_images"]) == ("scene-0007", UNITS, 3 * UNITS)
    assert 0 < ours["planar_rmse_m"] <= ours["errors"]["metric_rmse_m"] < 0.3
    (root / "v1.0-mini" / "ego_pose.json").unlink()
    refused = mrasfm("bench", "--nuscenes", root)
    assert refused.code == 2
    assert "ego_pose.json does not exist" in refused.err


def as_kitti(drive: Drive, root: Path) -> Path:
    """The drive as sequence 04: images turned as if both cameras looked straight ahead, as KITTI's are rectified."""
    sequence = root / "sequences" / "04"
    rdf_from_flu = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    centres = drive.rig_from_cam[:, :3, 3] @ rdf_from_flu.T
    lines = []
    for c, camera in enumerate(drive.cameras):
        folder = sequence / f"image_{c}"
        folder.mkdir(parents=True)
        fx, fy, cx, cy = camera.params
        k = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
        turn = k @ rdf_from_flu @ drive.rig_from_cam[c, :3, :3] @ np.linalg.inv(k)
        for image in drive.images:
            if image.camera == c:
                pixels = cv2.imread(str(drive.root / image.file))
                assert pixels is not None
                straight = cv2.warpPerspective(pixels, turn, pixels.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
                cv2.imwrite(str(folder / f"{image.unit:06d}.png"), straight)
        p = np.column_stack([k, k @ (centres[0] - centres[c])])
        lines.append(f"P{c}: " + " ".join(f"{v:.12e}" for v in p.ravel()))
    (sequence / "calib.txt").write_text("\n".join(lines) + "\n")
    start_us = drive.timestamps_us[0]
    (sequence / "times.txt").write_text("".join(f"{(t - start_us) / 1e6:e}\n" for t in drive.timestamps_us))
    rig_from_cam0 = se3.transform(rdf_from_flu.T, drive.rig_from_cam[0, :3, 3])
    world_from_cam0 = read_tum(drive.root / "truth.tum").world_from_rig @ rig_from_cam0
    rows = (se3.inverse(world_from_cam0[0]) @ world_from_cam0)[:, :3].reshape(-1, 12)
    (root / "poses").mkdir()
    (root / "poses" / "04.txt").write_text("".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows))
    return root


def as_nuscenes(drive: Drive, root: Path, *, scene: str) -> Path:
    """The drive as a data set of one scene of keyframes, whose truth knows no heights."""

    def posed(token: str, pose: np.ndarray) -> dict[str, Any]:
        x, y, z, w = se3.quaternion_from_rotation(pose[:3, :3])
        return {"token": token, "rotation": [w, x, y, z], "translation": pose[:3, 3].tolist()}

    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": scene, "name": scene, "first_sample_token": "0"}],
        "sample": [], "sensor": [], "calibrated_sensor": [], "sample_data": [], "ego_pose": [],
    }  # fmt: skip
    for camera, pose in zip(drive.cameras, drive.rig_from_cam, strict=True):
        fx, fy, cx, cy = camera.params
        k = [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]]
        channel = f"CAM_{camera.name.upper()}"
        tables["sensor"].append({"token": channel, "channel": channel, "modality": "camera"})
        calibrated = posed(camera.name, pose) | {"sensor_token": channel, "camera_intrinsic": k}
        tables["calibrated_sensor"].append(calibrated)
    for unit, time_us in enumerate(drive.timestamps_us.tolist()):
        following = str(unit + 1) if unit + 1 < len(drive.timestamps_us) else ""
        tables["sample"].append({"token": str(unit), "timestamp": time_us, "scene_token": scene, "next": following})
    truth = read_tum(drive.root / "truth.tum").world_from_rig
    for image in drive.images:
        camera, token = drive.cameras[image.camera], f"{image.unit}-{image.camera}"
        file = root / "samples" / f"CAM_{camera.name.upper()}" / f"{image.unit:06d}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.hardlink_to(drive.root / image.file)
        flat = truth[image.unit].copy()
        flat[2, 3] = 0.0
        tables["ego_pose"].append(posed(token, flat))
        tables["sample_data"].append(
            {
                "token": token, "sample_token": str(image.unit), "ego_pose_token": token,
                "calibrated_sensor_token": camera.name, "timestamp": image.timestamp_us, "is_key_frame": True,
                "filename": str(file.relative_to(root)), "width": camera.width, "height": camera.height,
            }
        )  # fmt: skip
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root
