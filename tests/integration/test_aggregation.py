"""Rendered drives of one street become a map; one is added and taken out; what cannot be in a map is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from mrasfm_engine.cli import main
from tests.integration.conftest import CommandResult, leftovers, read_report, synth

Run = Callable[..., CommandResult]
UNITS = 12
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives, the second 3 m ahead of the first in the same lane, with their scenes in `scenes/`."""
    folder = tmp_path_factory.mktemp("aggregation") / "street"
    synth(folder, "--drives", 3, "--cameras", 4, "--units", UNITS, "--seed", 4, "--no-masks", "--tight")
    for k in range(3):
        assert main(["reconstruct", str(folder / f"drive_{k}"), "--out", str(folder / "scenes" / f"drive_{k}")]) == 0
    return folder


@pytest.fixture(scope="module")
def two(street: Path) -> Path:
    """The map of the first two scenes. Tests only read it."""
    out = street / "map"
    scenes = [str(street / "scenes" / f"drive_{k}") for k in range(2)]
    assert main(["aggregate", *scenes, "--out", str(out)]) == 0
    return out


def truths(street: Path, *numbers: int) -> list[str]:
    return [f"drive_{k}={street / f'drive_{k}' / 'truth.tum'}" for k in numbers]


def test_accuracy_and_files(street: Path, two: Path, mrasfm: Run) -> None:
    errors = json.loads(mrasfm("evaluate", two, "--json", "--truth", *truths(street, 0, 1)).out)
    assert errors["unconnected"] == []
    assert [(seam["a"], seam["b"]) for seam in errors["seams"]] == [("drive_0", "drive_1")]
    seam = errors["seams"][0]
    assert 0 < seam["translation_m"] < 0.05
    assert 0 < seam["rotation_deg"] < 0.1
    assert seam["coarse"]["translation_m"] > 2 * seam["translation_m"]
    expected = {"model", "points.ply", "poses.tum", "poses.json", "calibration", "frame.json", "map.json", "pictures"}
    expected |= {"points.copc.laz", "trajectory.gpkg", "rigs", "autoware", "view.json", "report.html"}
    assert {p.name for p in two.iterdir()} == {*expected, "scenes", "seams", "report.json", ".stages"}
    assert {p.name for p in (two / "pictures").iterdir()} == {
        f"seam-drive_0~drive_1-{when}.png" for when in ("before", "after")
    }
    assert leftovers(two.parent) == []
    model = pycolmap.Reconstruction(str(two / "model"))
    assert (model.num_rigs(), model.num_reg_frames(), model.num_reg_images()) == (2, 2 * UNITS, 8 * UNITS)
    assert 0 < model.compute_mean_reprojection_error() < 1.5
    document = json.loads((two / "map.json").read_text())
    assert document["seams"][0]["inliers"] >= 60
    assert document["seams"][0]["residual_after_px"] < document["seams"][0]["residual_before_px"]
    assert 0 < errors["metric"]["rmse_m"] < 0.1
    adjusted = [turned_deg(street, k, two / "calibration" / f"drive_{k}.json") for k in range(2)]
    before = [turned_deg(street, k, street / "scenes" / f"drive_{k}" / "calibration.json") for k in range(2)]
    assert 0 < np.median(adjusted) < np.median(before) < 0.3


def turned_deg(street: Path, number: int, calibration: Path) -> list[float]:
    """By how much every camera of a drive is turned from where it truly was."""
    truth = json.loads((street / f"drive_{number}" / "truth_calibration.json").read_text())
    found = json.loads(calibration.read_text())["cameras"]
    turns = [
        [Rotation.from_quat(pose["rotation_xyzw"]) for pose in (found[name]["refined"]["rig_from_cam"], truth[name])]
        for name in truth
    ]
    return [float(np.degrees((a * b.inv()).magnitude())) for a, b in turns]


def test_adding_and_removing_reuses_what_is_there(street: Path, two: Path, tmp_path: Path, mrasfm: Run) -> None:
    out = tmp_path / "three"
    assert mrasfm("aggregate", "--into", two, street / "scenes" / "drive_2", "--out", out).code == 0
    seams = read_report(out)["by_stage"]["seams"]
    assert (seams["pairs"], seams["pairs_reused"]) == (3, 1)
    errors = json.loads(mrasfm("evaluate", out, "--json", "--truth", *truths(street, 0, 1, 2)).out)
    assert 0 < max(seam["translation_m"] for seam in errors["seams"]) < 0.05
    assert mrasfm("aggregate", "--into", out, "--remove", "drive_2").code == 0
    assert read_report(out)["by_stage"]["seams"]["reused"]
    before, after = (np.loadtxt(folder / "poses.tum") for folder in (two, out))
    assert before.shape == after.shape
    assert np.abs(before - after).max() < 1e-6
    assert not (out / "calibration" / "drive_2.json").exists()


def test_what_cannot_be_in_a_map(street: Path, two: Path, tmp_path: Path, mrasfm: Run) -> None:
    scene = street / "scenes" / "drive_0"
    old = (two / "map.json").read_bytes()

    def refused(*words: object) -> str:
        ran = mrasfm("aggregate", *words)
        assert ran.code == 2
        assert (two / "map.json").read_bytes() == old
        return ran.err

    out = ("--out", tmp_path / "out")
    other = street / "scenes" / "drive_2"
    assert "needs 2 drives" in refused(scene, *out)
    assert "called 'drive_0'" in refused(scene, scene, *out)
    assert "of the same drive" in refused(scene, f"again={scene}", *out)
    assert "does not exist" in refused(scene, tmp_path / "nowhere", *out)
    assert "is a map" in refused(scene, two, *out)
    assert "holds a scene" in refused("--into", scene, other)
    assert "has a scene called drive_0 already" in refused("--into", two, scene)
    assert "not in the map" in refused("--into", two, "--remove", "nobody")
    assert "twice" in refused("--into", two, "--remove", "drive_1", "--remove", "drive_1")
    assert "needs 2 drives" in refused("--into", two, "--remove", "drive_1")
    for file, change, said in (
        ("frame.json", {"version": 7}, "is of version 7"),
        ("poses.json", {"units": []}, "is damaged"),
    ):
        copy = changed_copy(other, tmp_path / "copy", file, change)
        assert said in refused(scene, copy, *out)
        shutil.rmtree(copy)
    # One scene that is georeferenced would place the other.
    unplaced = [changed_copy(of, tmp_path / of.name, "frame.json", {"georeferenced": False}) for of in (scene, other)]
    assert "is not georeferenced" in refused(*unplaced, *out)
    copy = changed_copy(other, tmp_path / "copy", "frame.json", {})
    (copy / "manifest.json").unlink()
    assert "earlier version" in refused(scene, copy, *out)
    assert not (tmp_path / "out").exists() or not (tmp_path / "out" / "report.json").exists()


def changed_copy(scene: Path, copy: Path, file: str, change: dict[str, object]) -> Path:
    """A copy of a scene of which one file says something else."""
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns(".stages", "pictures"))
    document = json.loads((copy / file).read_text()) | change
    (copy / file).write_text(json.dumps(document))
    return copy
