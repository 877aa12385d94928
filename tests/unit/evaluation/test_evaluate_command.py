from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.commands import evaluate
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import format_tum
from mrasfm_engine.scene.drive import pose_from_matrix

START_US, STEP_US, UNITS = 1_533_151_603_547_590, 500_000, 20


def truth_poses() -> np.ndarray:
    s = np.linspace(0, 1, UNITS)
    return se3.transform(se3.exp_so3(np.outer(s, [0, 0, 1.0])), np.column_stack([80 * s, 20 * s**2, 0 * s]))


def write_example(folder: Path, *, shift_us: int = 0) -> tuple[Path, Path]:
    """A scene with 18 of 20 units, scaled by 0.5 and in another world; and the truth of all units and more."""
    times = START_US + STEP_US * np.arange(UNITS)
    truth = truth_poses()
    estimate = se3.transform(truth[:, :3, :3], truth[:, :3, 3] * 0.5)
    estimate = se3.transform(se3.exp_so3([0, 0, 1.0]), [5.0, 6, 7]) @ estimate
    registered = np.arange(UNITS) < 18
    scene = folder / "scene"
    scene.mkdir()
    (scene / "poses.tum").write_text(format_tum(times[registered].tolist(), estimate[registered]))
    images: list[dict[str, Any]] = [
        {"file": f"{u}.png", "registered": True, "world_from_cam": pose_from_matrix(estimate[u]).model_dump()}
        if registered[u]
        else {"file": f"{u}.png", "registered": False}
        for u in range(UNITS)
    ]
    units = [{"timestamp_us": int(t), "registered": bool(r)} for t, r in zip(times, registered, strict=True)]
    (scene / "poses.json").write_text(json.dumps({"version": 1, "units": units, "images": images}))
    path = folder / "truth.tum"
    path.write_text(format_tum((times + shift_us).tolist(), truth))
    return scene, path


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser()
    evaluate.register(parser.add_subparsers())
    parsed = parser.parse_args(arguments)
    return int(parsed.run(parsed))


@pytest.mark.parametrize("shift_us", [0, 900, -900])
def test_json(tmp_path: Path, capsys: pytest.CaptureFixture[str], shift_us: int) -> None:
    scene, truth = write_example(tmp_path, shift_us=shift_us)
    assert main(["evaluate", str(scene), "--truth", str(truth), "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    result = json.loads(lines[0])
    assert result.keys() == {"registered_units", "registered_images", "total_images", "metric", "similarity"}
    assert (result["registered_units"], result["registered_images"], result["total_images"]) == (18, 18, 20)
    assert result["metric"].keys() == {"rmse_m", "median_m", "rotation_median_deg"}
    assert 5 < result["metric"]["rmse_m"] < 20
    assert 0 <= result["metric"]["rotation_median_deg"] < 1e-5
    assert 0 < result["similarity"]["rmse_m"] < 1e-6
    assert result["similarity"]["scale"] == pytest.approx(2.0, abs=1e-6)


def test_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, truth = write_example(tmp_path)
    assert main(["evaluate", str(scene), "--truth", str(truth)]) == 0
    out = capsys.readouterr().out
    assert "18 of 20 registered" in out
    assert "scale 2.000000" in out


def refused(scene: Path, truth: Path, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(InputError) as raised:
        main(["evaluate", str(scene), "--truth", str(truth), "--json"])
    assert capsys.readouterr().out == ""
    assert raised.value.remedy
    return str(raised.value)


@pytest.mark.parametrize("shift_us", [1100, -1100, 3_600_000_000])
def test_timestamps_that_do_not_match_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shift_us: int
) -> None:
    scene, truth = write_example(tmp_path, shift_us=shift_us)
    assert "0 timestamps in common within 1 ms, 3 are needed" in refused(scene, truth, capsys)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("nan 0 0 0 0 0 0 1", "not all values are finite"),
        ("1.0 nan 0 0 0 0 0 1", "not all values are finite"),
        ("1.0 0 0 0 0 0 0 inf", "not all values are finite"),
        ("1.0 0 0 0 0 0 1", "7 values instead of 8"),
        ("1.0 0 0 0 0 0 0 0.5", "norm is 0.5"),
        ("one 0 0 0 0 0 0 1", "not all values are numbers"),
        ("1533151603.547590 0 0 0 0 0 0 1", "repeats the timestamp"),
        ("1e300 0 0 0 0 0 0 1", "out of range"),
        ("1e99999999 0 0 0 0 0 0 1", "timestamp 1E+99999999 is out of range"),
        ("-5e12 0 0 0 0 0 0 1", "out of range"),
        ("1.0 0 1e200 0 0 0 0 1", "a position is over 1e+09 m from the origin"),
    ],
)
def test_a_malformed_line_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str, message: str) -> None:
    scene, truth = write_example(tmp_path)
    with truth.open("a") as file:
        file.write(line + "\n")
    error = refused(scene, truth, capsys)
    assert f"truth.tum, line {UNITS + 2}: " in error
    assert message in error


def test_missing_files_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, truth = write_example(tmp_path)
    assert "nothing.tum does not exist" in refused(scene, tmp_path / "nothing.tum", capsys)
    assert "is not a scene" in refused(tmp_path, truth, capsys)
    (scene / "poses.json").write_text("{")
    assert "poses.json cannot be read" in refused(scene, truth, capsys)
    (scene / "poses.json").write_text('{"units": [], "images": [{"file": "a"}]}')
    assert "poses.json is not a scene's poses" in refused(scene, truth, capsys)
    (scene / "poses.json").write_text('{"units": [], "images": []}')
    assert "hold different units" in refused(scene, truth, capsys)


def test_a_truth_that_is_no_text_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, truth = write_example(tmp_path)
    assert "cannot be read as text" in refused(scene, tmp_path, capsys)
    truth.write_bytes(b"\xff\xfe\x00")
    assert "cannot be read as text" in refused(scene, truth, capsys)
