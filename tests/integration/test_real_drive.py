"""A real drive from import to evaluation, as a user does it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.cli import EXIT_BAD_INPUT, main
from mrasfm_engine.config import BundleAdjustmentConfig
from schemas.artifacts import CHECKPOINTED
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, read_report

pytestmark = pytest.mark.real
Run = Callable[..., CommandResult]


@pytest.fixture(scope="module")
def kitti02(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    drive = tmp_path_factory.mktemp("real") / "kitti02"
    assert main(["import", str(shared_data / "kitti02"), "--out", str(drive)]) == 0
    return drive


def test_kitti02_with_gnss(kitti02: Path, mrasfm: Run) -> None:
    scene = kitti02.parent / "scene"
    result = mrasfm("reconstruct", kitti02, "--out", scene)
    assert result.code == 0
    assert "units registered: 20 of 20" in result.out
    assert "georeferenced:    yes" in result.out
    evaluated = mrasfm("evaluate", scene, "--truth", kitti02 / "truth.tum", "--json")
    errors = json.loads(evaluated.out)
    assert errors["registered_images"] == errors["total_images"] == 40
    assert 0 < errors["metric"]["rmse_m"] < 0.15
    assert 0 < errors["metric"]["rotation_median_deg"] < 0.3
    assert 0 < errors["similarity"]["rmse_m"] < 0.05
    poses = (scene / "poses.tum").read_bytes()
    assert mrasfm("reconstruct", kitti02, "--out", scene, *WITHOUT_PICTURES).code == 0
    stages = read_report(scene)["by_stage"]
    assert all(stages[name]["reused"] for name in CHECKPOINTED)
    assert (scene / "poses.tum").read_bytes() == poses


@pytest.mark.slow
def test_latitude_and_longitude_exchanged(kitti02: Path, variant_of: Callable[[Path], Variant], mrasfm: Run) -> None:
    variant = variant_of(kitti02)
    for sample in variant.document["gnss"]["samples"]:
        sample["latitude_deg"], sample["longitude_deg"] = sample["longitude_deg"], sample["latitude_deg"]
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene)
    if result.code == 0:
        assert "georeferenced:    no (" in result.out
    else:
        assert "latitude" in result.err


@pytest.mark.slow
def test_any_number_of_threads_makes_the_same_scene(shared_data: Path, tmp_path: Path, mrasfm: Run) -> None:
    """A straight street without GNSS tells its scale to a tenth: what rounding decides shows there."""
    drive, positions_m = tmp_path / "drive", []
    assert mrasfm("import", shared_data / "kitti06", "--out", drive).code == 0
    for threads in (1, 2, 3):
        settings, scene = tmp_path / f"{threads}.toml", tmp_path / f"scene {threads}"
        settings.write_text(f"threads = {threads}\nuse_gnss = false\noutput = {{pictures = false}}\n")
        assert mrasfm("reconstruct", drive, "--config", settings, "--out", scene).code == 0
        units = json.loads((scene / "poses.json").read_text())["units"]
        positions_m.append([unit["world_from_rig"]["translation_m"] for unit in units])
    np.testing.assert_allclose(positions_m[1:], positions_m[:1] * 2, atol=1e-5)


@pytest.mark.slow
def test_cameras_that_share_no_view_stay_where_they_were_given(shared_data: Path, tmp_path: Path, mrasfm: Run) -> None:
    """Seven metres of way tell hardly where three cameras are that look apart; what traffic and interpolation leave in
    the images would move the one behind by six sigmas of its prior.
    """
    cameras = "front_camera,left_camera,back_camera"
    drive, scene = tmp_path / "drive", tmp_path / "scene"
    imported = mrasfm("import", shared_data / "pandaset_002", "--frames", "26:52", "--cameras", cameras, "--out", drive)
    assert imported.code == 0
    assert mrasfm("reconstruct", drive, "--out", scene, *WITHOUT_PICTURES).code == 0
    calibration = json.loads((scene / "calibration.json").read_text())["cameras"]
    places_m = {
        which: np.array([camera[which]["rig_from_cam"]["translation_m"] for camera in calibration.values()])
        for which in ("given", "refined")
    }
    moved_m = places_m["refined"] - places_m["given"]
    assert np.linalg.norm(moved_m - moved_m.mean(0), axis=1).max() < 3 * BundleAdjustmentConfig().sigma_translation_m
    errors = json.loads(mrasfm("evaluate", scene, "--truth", drive / "truth.tum", "--json").out)
    assert errors["registered_images"] == errors["total_images"] == 78
    assert 0 < errors["metric"]["rmse_m"] < 0.02


def test_exchanged_cameras_that_share_no_view_are_refused(mrasfm: Run, shared_data: Path, tmp_path: Path) -> None:
    cameras = "front_left_camera,front_right_camera,right_camera"
    drive, scene = tmp_path / "drive", tmp_path / "scene"
    mrasfm("import", shared_data / "pandaset_002", "--frames", "30:38", "--cameras", cameras, "--out", drive)
    document = json.loads((drive / "drive.json").read_text())
    for frame in document["frames"]:
        left, right = frame["images"]["front_left_camera"], frame["images"]["front_right_camera"]
        left["file"], right["file"] = right["file"], left["file"]
    (drive / "drive.json").write_text(json.dumps(document))
    config = tmp_path / "config.toml"
    config.write_text("features = {max_side_px = 960, max_keypoints = 2000}")  # of half the size: it shows as well
    refused = mrasfm("reconstruct", drive, "--out", scene, "--config", config)
    assert refused.code == EXIT_BAD_INPUT
    assert "the images of cameras front_left_camera and front_right_camera look exchanged: in " in refused.err
    assert not (scene / "report.json").exists()
