"""What of a published data set is to be reconstructed: found, checked, and refused before any long work."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.benchmark import datasets
from mrasfm_engine.benchmark.datasets import bench_kitti, kitti_sequences, nuscenes_scenes, planar_rmse_m
from mrasfm_engine.benchmark.side_by_side import Settings
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError, ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.preflight.drive_reader import read_drive

CALIBRATION = "".join(f"P{k}: 40 0 23.5 {-20.0 * (k % 2)} 0 40 15.5 0 0 0 1 0\n" for k in range(4))
FRAMES = 5
SETTINGS = Settings(config=EngineConfig())


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Sequences 00 (grey and colour), 01 (colour) and 11 (colour, no truth) of five frames."""
    root = tmp_path / "kitti"
    (root / "poses").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for name, cameras in (("00", range(4)), ("01", (2, 3)), ("11", (2, 3))):
        sequence = root / "sequences" / name
        for camera in cameras:
            (sequence / f"image_{camera}").mkdir(parents=True)
            for frame in range(FRAMES):
                image = rng.integers(0, 255, (32, 48, 3), dtype=np.uint8)
                cv2.imwrite(str(sequence / f"image_{camera}" / f"{frame:06d}.png"), image)
        (sequence / "calib.txt").write_text(CALIBRATION)
        (sequence / "times.txt").write_text("".join(f"{0.1 * frame:e}\n" for frame in range(FRAMES)))
        if name != "11":
            rows = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.5 * frame}\n" for frame in range(FRAMES))
            (root / "poses" / f"{name}.txt").write_text(rows)
    return root


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Drives that would have been reconstructed."""
    drives: list[Path] = []

    def note(drive: Path, truth: Any, work: Path, settings: Settings) -> None:
        assert truth is not None
        drives.append(drive)

    monkeypatch.setattr(datasets, "compare_mappers", note)
    return drives


@pytest.mark.parametrize(
    ("wanted", "names"),
    [(None, ["00", "01"]), ("00", ["00"]), ("0-1", ["00", "01"]), ("01, 00,01", ["01", "00"]), ("00-01", ["00", "01"])],
)
def test_sequences(kitti: Path, wanted: str | None, names: list[str]) -> None:
    assert kitti_sequences(kitti, wanted) == names


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("00-02", "02 does not exist"),
        ("07", "07 does not exist"),
        ("11", "11 has no true poses"),
        ("01-00", "'01-00' is no sequence"),
        ("00,", "'' is no sequence"),
        ("all", "'all' is no sequence"),
        ("000", "'000' is no sequence"),
    ],
)
def test_sequences_that_are_not_there(kitti: Path, wanted: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        kitti_sequences(kitti, wanted)


def test_folders_that_are_no_data_set(tmp_path: Path, kitti: Path) -> None:
    with pytest.raises(InputError, match="has no sequences/00"):
        kitti_sequences(tmp_path, None)
    for file in (kitti / "poses").iterdir():
        file.unlink()
    with pytest.raises(InputError, match=r"no sequence of .* has true poses"):
        kitti_sequences(kitti, None)
    with pytest.raises(InputError, match=r"has no table v1\.0-\*/scene\.json"):
        nuscenes_scenes(kitti, None)


def test_the_grey_pair_is_taken_where_there_are_both(kitti: Path, tmp_path: Path, compared: list[Path]) -> None:
    results = bench_kitti(kitti, ["00", "01"], tmp_path / "work", SETTINGS, frames=":4")
    assert [result.name for result in results] == ["00", "01"]
    drives = [read_drive(drive) for drive in compared]
    assert [[c.name for c in drive.cameras] for drive in drives] == [["image_0", "image_1"], ["image_2", "image_3"]]
    assert [len(drive.images) for drive in drives] == [8, 8]
    assert (compared[0] / "truth.tum").is_file()


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("sequences/01/calib.txt", CALIBRATION.splitlines()[2], "no P3"),
        ("poses/01.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "has 3 lines, but there are images of frame 4"),
        ("poses/01.txt", "1 0 0 0 0 1 0 0 0 0 1\n" * FRAMES, "line 1: .* is not 12 numbers"),
        ("sequences/01/times.txt", "0.0\n0.1\n", "has 2 lines"),
    ],
)
def test_nothing_is_reconstructed_where_a_sequence_is_broken(
    kitti: Path, tmp_path: Path, compared: list[Path], file: str, text: str, message: str
) -> None:
    (kitti / file).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        bench_kitti(kitti, ["00", "01"], tmp_path / "work", SETTINGS)
    assert str(kitti / file) in caught.value.what
    assert compared == []


def test_a_sequence_that_fails_does_not_stop_the_others(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(drive: Path, *rest: Any) -> None:
        if "00" in drive.parent.name:
            raise ReconstructionError("nothing matches", remedy="Look at the images.")

    monkeypatch.setattr(datasets, "compare_mappers", fail)
    results = bench_kitti(kitti, ["00", "01"], tmp_path / "work", SETTINGS)
    assert [result.failure for result in results] == ["nothing matches", ""]


def test_scenes(tmp_path: Path) -> None:
    table = tmp_path / "v1.0-mini" / "scene.json"
    table.parent.mkdir()
    names = ["scene-0103", "scene-0061"]
    table.write_text(json.dumps([{"token": n, "name": n, "first_sample_token": "s"} for n in names]))
    assert nuscenes_scenes(tmp_path, None) == names
    assert nuscenes_scenes(tmp_path / "v1.0-mini", "scene-0061") == ["scene-0061"]
    with pytest.raises(InputError, match="no scene 'scene-9'") as caught:
        nuscenes_scenes(tmp_path, "scene-0061,scene-9")
    assert "scene-0103, scene-0061" in caught.value.remedy
    table.write_text(json.dumps([{"token": "a"}]))
    with pytest.raises(InputError, match=r"scene\.json"):
        nuscenes_scenes(tmp_path, None)


def test_heights_do_not_count_in_the_plane() -> None:
    s = np.linspace(0.0, 6.0, 200)
    truth = se3.transform(np.tile(np.eye(3), (200, 1, 1)), np.stack([30 * np.cos(s), 30 * np.sin(s), 0 * s], axis=-1))
    estimate = truth.copy()
    estimate[:, 2, 3] += 0.2 * np.sin(9 * s)
    estimate[:, 0, 3] += 0.05 * np.cos(11 * s)
    moved = se3.transform(se3.exp_so3([0.1, 0.2, 2.0]), [3.0, 4.0, 5.0]) @ estimate
    moved[7] = np.nan
    planar = planar_rmse_m(moved, truth)
    assert planar == pytest.approx(0.05 / np.sqrt(2), rel=0.02)
    assert planar_rmse_m(moved[:2], truth[:2]) is None
