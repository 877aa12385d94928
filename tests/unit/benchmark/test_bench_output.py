"""Tables and documents of `mrasfm bench`, and options that do not go together."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.benchmark.datasets import ROUGH_NOISE, SceneResult, nuscenes_setting
from mrasfm_engine.benchmark.mapping import Prepared
from mrasfm_engine.benchmark.scaling import Growth, GrowthRow
from mrasfm_engine.benchmark.side_by_side import Comparison, Row, baselines_named
from mrasfm_engine.commands import bench
from mrasfm_engine.commands.bench_datasets_output import KittiOutput, NuScenesOutput
from mrasfm_engine.commands.bench_output import DriveOutput, GrowthOutput
from mrasfm_engine.errors import InputError
from mrasfm_engine.evaluation.trajectory import compare_trajectories
from mrasfm_engine.geometry import se3

UNITS = 20


def poses(off_m: float = 0.0) -> np.ndarray:
    s = np.linspace(0.0, 3.0, UNITS)
    place = np.stack([10 * np.cos(s), 10 * np.sin(s), off_m * np.cos(20 * s)], axis=-1)
    return se3.transform(np.tile(np.eye(3), (UNITS, 1, 1)), place)


OURS = Row(
    mapper="mrasfm", mapping_s=90.0, refinement_s=30.0, runs_s=[110.0, 120.0, 150.0], start_memory_bytes=300_000_000,
    peak_memory_bytes=700_000_000, registered_images=40, registered_units=UNITS, points=1234, observations=9999,
    revisits_tried=7, revisits_believed=5, errors=compare_trajectories(poses(0.1), poses()), world_from_rig=poses(0.1),
)  # fmt: skip
FAILED = Row(mapper="colmap-global", failure="killed by SIGKILL, maybe because memory ran out")
assert OURS.errors is not None
COMPARISON = Comparison(
    drive="a-drive", images=40, units=UNITS, prepared_peak_memory_bytes=500_000_000, rows=[OURS, FAILED],
    prepared=Prepared(features_s=60.0, matches_s=120.0, keypoints=50, verified_pairs=60, verified_matches=7000),
    truth_world_from_rig=poses(),
)  # fmt: skip


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "180")


def test_a_drive(capsys: pytest.CaptureFixture[str]) -> None:
    output = DriveOutput(COMPARISON)
    output.print()
    printed = capsys.readouterr().out
    rmse = f"{OURS.errors.metric_rmse_m:.4f}"
    for text in ("mrasfm", "colmap-global", "40 of 40", "120.0", "110.0", "150.0", "700", rmse, "SIGKILL"):
        assert text in printed
    document = json.loads(json.dumps(output.document(), allow_nan=False))
    ours, failed = document["mappers"]
    assert (ours["whole_s"], ours["peak_memory_bytes"], ours["errors"]["poses"]) == (120.0, 700_000_000, UNITS)
    assert (failed["mapping_s"], failed["errors"], failed["registered_images"]) == (None, None, 0)
    assert document["features_and_matches"]["matches_s"] == 120.0


def test_stages_of_an_earlier_run_have_no_time(capsys: pytest.CaptureFixture[str]) -> None:
    reused = replace(COMPARISON, prepared=replace(COMPARISON.prepared, features_s=None))
    DriveOutput(reused).print()
    assert "features taken from an earlier run, matches 120.0 s" in capsys.readouterr().out
    KittiOutput([SceneResult(name="04", comparison=reused)]).print()
    assert "5.0" not in capsys.readouterr().out


def test_routes(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        GrowthRow(row=OURS, per_unit_s=6.0, end_error_percent=0.0123, route_error_percent=0.0456),
        GrowthRow(row=FAILED, per_unit_s=None, end_error_percent=None, route_error_percent=None),
    ]
    route = Growth(
        rig="stereo", units=UNITS, seed=0, route_m=19.0, images=40, keypoints=50, verified_matches=60, rows=rows
    )
    output = GrowthOutput([route])
    output.print()
    printed = capsys.readouterr().out
    for text in ("stereo, 20 units", "5 of 7", "0.0123", "0.0456", "1234", "9999", "20 units: killed by SIGKILL"):
        assert text in printed
    document = json.loads(json.dumps(output.document(), allow_nan=False))["routes"][0]
    assert (document["route_m"], document["mappers"][0]["end_error_percent"]) == (19.0, 0.0123)
    assert document["mappers"][1]["per_unit_s"] is None


def test_kitti_stands_beside_what_is_published(capsys: pytest.CaptureFixture[str]) -> None:
    results = [
        SceneResult(name="04", comparison=COMPARISON),
        SceneResult(name="12", comparison=None, failure="nothing matches"),
    ]
    output = KittiOutput(results)
    output.print()
    printed = capsys.readouterr().out
    row = next(line for line in printed.splitlines() if " 04 " in line)
    for text in ("0.1 (0.1)", "0.2 (0.1)", f"{OURS.errors.metric_median_m:.2f} (0.00)", "5.0", "40 of 40"):
        assert text in row
    assert "12: nothing matches" in printed
    assert "04, colmap-global: killed" in printed
    document = json.loads(json.dumps(output.document(), allow_nan=False))["sequences"]
    assert document[0]["published"]["by_method"]["MRASfM"] == {"translation_m": 0.1, "rotation_deg": 0.1}
    assert (document[1]["published"], document[1]["failure"]) == (None, "nothing matches")


def test_nuscenes_has_plane_and_space_apart(capsys: pytest.CaptureFixture[str]) -> None:
    setting = nuscenes_setting(True, ROUGH_NOISE)
    output = NuScenesOutput([SceneResult(name="scene-0061", comparison=COMPARISON)], setting)
    output.print()
    printed = capsys.readouterr().out
    document = json.loads(json.dumps(output.document(), allow_nan=False))
    mapper = document["scenes"][0]["mappers"][0]
    assert 0 < mapper["planar_rmse_m"] < 0.01 < mapper["errors"]["metric_rmse_m"]
    assert f"{mapper['planar_rmse_m']:.3f} / {mapper['errors']['metric_rmse_m']:.3f}" in printed
    assert "mean" in printed
    assert "MRASfM 0.124" in printed
    assert "All images, at 12 Hz, with rough poses: the true ones with noise of 0.5 m and 2 deg" in printed
    assert document["setting"] == setting
    assert nuscenes_setting(False, None) == "Keyframes, at 2 Hz, without rough poses."
    assert document["published_rmse_m"]["MGSfM"] == 0.134


def test_lists_of_baselines() -> None:
    assert baselines_named("colmap-global, colmap-incremental,colmap-global,") == [
        "colmap-global",
        "colmap-incremental",
    ]
    assert baselines_named("") == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "not on nothing"),
        (["drive", "--simulate", "stereo"], "not on DRIVE and --simulate"),
        (["--kitti", "k", "--nuscenes", "n"], "not on --kitti and --nuscenes"),
        (["drive", "--units", "30"], "--units does not go with DRIVE"),
        (["--simulate", "stereo", "--truth", "t.tum"], "--truth does not go with --simulate"),
        (["--kitti", "k", "--scenes", "a"], "--scenes does not go with --kitti"),
        (["--simulate", "stereo", "--frames", "0:10"], "--frames does not go with --simulate"),
        (["--simulate", "stereo", "--units", "many"], "--units 'many'"),
        (["--simulate", "bicycle", "--units", "30"], "no simulated rig 'bicycle'"),
        (["drive", "--baselines", "openmvg"], "no mapper 'openmvg'"),
        (["nowhere"], "drive nowhere does not exist"),
    ],
)
def test_what_does_not_go_together_is_refused(
    options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    parser = argparse.ArgumentParser()
    bench.register(parser.add_subparsers())
    arguments = parser.parse_args(["bench", *options])
    with pytest.raises(InputError) as caught:
        arguments.run(arguments)
    assert message in caught.value.what
