"""The road from above, before and after recalibration, against the streets of the rendered world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mrasfm_engine.cli import main
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.streets import lay_out
from schemas.artifacts import CHECKPOINTED
from tests.integration.conftest import CommandResult, Variant, read_report, synth

Run = Callable[..., CommandResult]
SEED = 3  # of all these drives


@pytest.fixture(scope="module")
def perturbed_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six cameras, each turned by half a degree against what is given."""
    size = ("--cameras", 6, "--units", 16, "--seed", SEED)
    return synth(tmp_path_factory.mktemp("perturbed") / "drive", *size, "--perturb-rotation-deg", 0.5)


@pytest.fixture(scope="module")
def perturbed_scene(perturbed_drive: Path) -> Path:
    out = perturbed_drive.parent / "scene"
    assert main(["reconstruct", str(perturbed_drive), "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_cameras_agree_better_with_the_refined_calibration(perturbed_scene: Path) -> None:
    found = read_report(perturbed_scene)["by_stage"]["pictures"]["birds_eye"]
    assert found["calibration_changed"] is True
    assert 90 <= found["images"] <= 96  # some see no cell best
    before, after = found["before"], found["after"]
    assert before["blocks"] == after["blocks"] > 20
    assert 0.7 < after["correlation"] < 1.0
    assert before["correlation"] < after["correlation"] - 0.03
    assert 0 < after["displacement_m"] < 0.7 * before["displacement_m"] < 0.3


@pytest.mark.slow
def test_markings_are_where_they_are(surround_scene: Path, surround_drive: Path) -> None:
    off_m = _off_the_stripes_m(surround_scene, surround_drive, "birds_eye_after.png")
    assert 0.01 < np.median(off_m) < 0.05  # the stripes are 12 to 14 cm wide
    assert (off_m < 0.12).mean() > 0.9


@pytest.mark.slow
def test_markings_are_where_they_are_after_recalibration_only(perturbed_scene: Path, perturbed_drive: Path) -> None:
    before_m, after_m = (
        _off_the_stripes_m(perturbed_scene, perturbed_drive, f"birds_eye_{name}.png") for name in ("before", "after")
    )
    assert 0.01 < np.median(after_m) < 0.05
    assert (after_m < 0.12).mean() > 0.9
    assert (before_m < 0.06).mean() < (after_m < 0.06).mean() - 0.03


def _off_the_stripes_m(scene: Path, drive: Path, name: str) -> np.ndarray:
    """How far (n,) bright pixels of the right border's and the middle's stripes are from their centre lines."""
    picture = cv2.cvtColor(cv2.imread(str(scene / "pictures" / name)), cv2.COLOR_BGR2GRAY)
    affine = np.array(read_report(scene)["by_stage"]["pictures"]["birds_eye"]["world_from_pixel"])
    own, true = read_tum(scene / "poses.tum").world_from_rig, read_tum(drive / "truth.tum").world_from_rig
    # The scale of so short a way is known to some percent only, which is another matter.
    scale = align_similarity(true[:, :3, 3], own[:, :3, 3], collinear_ratio=0.0).scale
    truth_from_world = true[len(true) // 2] @ se3.inverse(_scaled(own[len(own) // 2], scale))
    v, u = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]] + 0.5
    xy = scale * (np.stack([u, v, np.ones_like(u)], -1) @ affine.T)
    xy = xy @ truth_from_world[:2, :2].T + truth_from_world[:2, 3]
    stripes = _stripe_centres()
    near_way = cKDTree(true[:, :2, 3]).query(xy.reshape(-1, 2))[0].reshape(picture.shape) < 4.0
    off = cKDTree(stripes).query(xy[near_way])[0]
    # Paint is brighter than what is around it, in the sun as in the shade.
    surroundings = cv2.GaussianBlur(picture.astype(np.float32), None, 16.0)
    paint = (picture > 1.6 * surroundings)[near_way] & (off < 0.4)
    assert paint.sum() > 300
    return off[paint]


def _scaled(world_from_rig: np.ndarray, scale: float) -> np.ndarray:
    return se3.transform(world_from_rig[:3, :3], scale * world_from_rig[:3, 3])


def _stripe_centres() -> np.ndarray:
    layout = lay_out(SynthOptions(seed=SEED), np.random.default_rng([SEED, 0]))
    s = np.arange(0.0, layout.streets[0].length_m, 0.02)
    return np.concatenate([layout.streets[0].at(s, lateral)[0] for lateral in (-3.3, 0.0, 3.3)])


def test_pictures_can_be_turned_off_and_leave_with_the_scene_they_show(variant: Variant, mrasfm: Run) -> None:
    variant.keep(cameras=["front", "left"], units=4).save()
    config = variant.root.parent / "config.toml"
    config.write_text("[output]\npictures = true\n", encoding="utf-8")
    assert mrasfm("reconstruct", variant.root, "--out", variant.scene, "--no-gnss", "--config", config).code == 0
    drawn = {f"{what}_{when}.png" for what in ("birds_eye", "road") for when in ("before", "after")}
    drawn |= {"road.png", "road.pgw", "road.tif"}
    assert {p.name for p in (variant.scene / "pictures").iterdir()} == drawn
    poses = (variant.scene / "poses.tum").read_bytes()
    config.write_text("[output]\npictures = false\n", encoding="utf-8")
    assert mrasfm("reconstruct", variant.root, "--out", variant.scene, "--no-gnss", "--config", config).code == 0
    assert not (variant.scene / "pictures").exists()
    report = read_report(variant.scene)
    assert "pictures" not in report["by_stage"]
    assert all(report["by_stage"][name]["reused"] for name in CHECKPOINTED)
    assert (variant.scene / "poses.tum").read_bytes() == poses
