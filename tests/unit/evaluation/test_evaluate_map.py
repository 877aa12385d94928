"""Which file is the truth of which scene of a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.cli import main
from mrasfm_engine.commands.evaluate_map import evaluate_map
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.drive import pose_from_matrix

UNITS = 6
OFF_M = {"drive_0": 0.0, "drive_1": 0.3}  # how far the map has each scene from its truth


def way(start_m: float) -> np.ndarray:
    metres = start_m + np.arange(UNITS)
    yaw = se3.exp_so3(np.outer(0.05 * np.arange(UNITS), [0, 0, 1.0]))
    return se3.transform(yaw, np.column_stack([metres, 0.1 * metres**2, np.zeros(UNITS)]))


def times_us(k: int) -> list[int]:
    return [1_000_000 + 100_000 * (UNITS * k + u) for u in range(UNITS)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a map of two scenes in `map`."""
    monkeypatch.chdir(tmp_path)
    units: list[dict[str, Any]] = []
    for k, (name, off_m) in enumerate(OFF_M.items()):
        for time_us, pose in zip(times_us(k), way(3.0 * k), strict=True):
            pose = se3.transform(np.eye(3), [0.0, 0.0, off_m]) @ pose
            written = pose_from_matrix(pose).model_dump()
            units.append({"timestamp_us": time_us, "registered": True, "scene": name, "world_from_rig": written})
    scenes = [{"name": name, "map_from_scene": np.eye(4).tolist()} for name in OFF_M]
    seam = {"a": "drive_0", "b": "drive_1", "accepted": True, "coarse_a_from_b": np.eye(4).tolist()}
    document = {"version": 1, "scenes": scenes, "seams": [seam], "unconnected": []}
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.json").write_text(json.dumps(document))
    (tmp_path / "map" / "poses.json").write_text(json.dumps({"units": units, "images": []}))
    return tmp_path


def truth_of(file: Path, *numbers: int) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    every = [(time_us, pose) for k in numbers for time_us, pose in zip(times_us(k), way(3.0 * k), strict=True)]
    file.write_text(format_tum([time for time, _ in every], np.stack([pose for _, pose in every])))
    return file


def seam_error_m(*words: object) -> float:
    document, _ = evaluate_map(Path("map"), [str(word) for word in words])
    (seam,) = document["seams"]
    assert document["units_with_truth"] == 2 * UNITS
    return float(seam["translation_m"])


def test_one_truth_of_all_in_a_folder_whose_name_has_an_equals_sign(folder: Path) -> None:
    truth_of(folder / "run=3" / "truth.tum", 0, 1)
    truth_of(folder / "all=drives.tum", 0, 1)
    for word in (folder / "run=3" / "truth.tum", "run=3/truth.tum", "all=drives.tum", "./all=drives.tum"):
        assert 0.25 < seam_error_m(word) < 0.35


def test_a_truth_of_each_in_a_folder_whose_name_has_an_equals_sign(folder: Path) -> None:
    files = [truth_of(folder / f"run={k}" / "t=0.tum", k) for k in range(2)]
    assert 0.25 < seam_error_m(f"drive_0={files[0]}", f"drive_1={files[1]}") < 0.35


def test_a_scene_that_the_map_does_not_have(folder: Path) -> None:
    truth = truth_of(folder / "truth.tum", 0, 1)
    with pytest.raises(InputError, match="names nobody") as raised:
        seam_error_m(f"nobody={truth}")
    assert raised.value.remedy == "Its scenes are drive_0, drive_1. Give a file whose name has '=' as ./FILE."
    for words in ([f"drive_0={truth}", truth], [f"drive_0={truth}", f"drive_0={truth}"]):
        with pytest.raises(InputError, match="without a scene, or a scene twice"):
            seam_error_m(*words)


@pytest.mark.parametrize("rows", [[[1.0]], np.eye(3).tolist(), [[float("nan")] * 4] * 4, None, "a"])
@pytest.mark.parametrize("part", ["scenes", "seams"])
def test_a_map_whose_transforms_are_none(folder: Path, part: str, rows: object) -> None:
    """They are multiplied much later, which ended with a stack trace."""
    file, truth = folder / "map" / "map.json", truth_of(folder / "truth.tum", 0, 1)
    document = json.loads(file.read_text())
    document[part][0]["map_from_scene" if part == "scenes" else "coarse_a_from_b"] = rows
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match="map is not a map"):
        seam_error_m(truth)


def test_a_folder_that_is_not_there_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It passed for a scene, of which one truth would do."""
    truth_of(folder / "truth.tum", 0, 1)
    assert main(["evaluate", "nowhere", "--truth", "drive_0=truth.tum", "drive_1=truth.tum"]) == 2
    assert "nowhere" in capsys.readouterr().err
