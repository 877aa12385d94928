"""A drive whose cameras see their own car, without masks: no keypoint on it, the mask is kept, the report tells."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.synthetic.drive_writer import TRUE_OWN_CAR_FOLDER
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, synth

SEEN_BY = ("front", "back")
UNITS = 16


@pytest.mark.slow
def test_the_own_car_is_left_out(tmp_path: Path, mrasfm: Callable[..., CommandResult]) -> None:
    drive, scene = tmp_path / "drive", tmp_path / "scene"
    size = ("--width", 384, "--height", 216)  # of smaller images, the car's edge is not found well enough
    synth(drive, *size, "--cameras", 4, "--units", UNITS, "--spacing-m", 1.5, "--own-car", "--no-masks", "--seed", 3)
    assert mrasfm("reconstruct", drive, "--out", scene, *WITHOUT_PICTURES).code == 0
    report = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    assert set(report["own_car"]) == {"front", "left", "right", "back"}
    assert {path.name for path in (scene / "own_car").iterdir()} == {f"{camera}.png" for camera in SEEN_BY}
    for camera in ("left", "right"):
        assert report["own_car"][camera]["reason"]
    for camera in SEEN_BY:
        found = cv2.imread(str(scene / "own_car" / f"{camera}.png"), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(found)) == {0, 255}
        assert report["own_car"][camera]["share"] == round(float((found > 0).mean()), 4)
        true = cv2.imread(str(drive / TRUE_OWN_CAR_FOLDER / f"{camera}.png"), cv2.IMREAD_UNCHANGED)
        assert 0.85 < ((found > 0) & (true > 0)).sum() / ((found > 0) | (true > 0)).sum() <= 1
        column, row = _keypoints(scene, camera).astype(int).T
        assert len(row) > 100 * UNITS
        assert not found[row, column].any()
        assert (true[row, column] > 0).mean() < 0.01
    again = mrasfm("reconstruct", drive, "--out", scene, *WITHOUT_PICTURES)
    assert again.code == 0
    assert json.loads((scene / "report.json").read_text(encoding="utf-8"))["own_car"] == report["own_car"]
    assert (scene / "own_car" / "front.png").is_file()


@pytest.mark.slow
def test_the_search_can_be_switched_off(variant: Variant, tmp_path: Path, mrasfm: Callable[..., CommandResult]) -> None:
    config, scene = tmp_path / "off.toml", tmp_path / "scene"
    config.write_text("[features]\nown_car = false\n[output]\npictures = false\n", encoding="utf-8")
    drive = variant.keep(cameras=["front", "left"], units=3).save().root
    assert mrasfm("reconstruct", drive, "--out", scene, "--config", config).code == 0
    assert json.loads((scene / "report.json").read_text(encoding="utf-8"))["own_car"] == {}
    assert not (scene / "own_car").exists()


def _keypoints(scene: Path, camera: str) -> np.ndarray:
    """Positions (n, 2) of all keypoints of a camera."""
    with sqlite3.connect(scene / "features.db") as database:
        rows = database.execute(
            "SELECT rows, cols, data FROM keypoints JOIN images USING (image_id) WHERE name LIKE ?", (f"%/{camera}/%",)
        ).fetchall()
    return np.concatenate([np.frombuffer(data, np.float32).reshape(n, k)[:, :2] for n, k, data in rows])
