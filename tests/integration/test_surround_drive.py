"""A rendered surround drive from end to end: accuracy, every file, and what a second run does."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from schemas.artifacts import CHECKPOINTED
from tests.helpers.slow import slow
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, leftovers, read_report

Run = Callable[..., CommandResult]
UNITS, IMAGES = 8, 32


def test_accuracy(surround_drive: Path, surround_scene: Path, mrasfm: Run) -> None:
    result = mrasfm("evaluate", surround_scene, "--truth", surround_drive / "truth.tum", "--json")
    assert result.code == 0
    errors = json.loads(result.out)
    assert (errors["registered_units"], errors["registered_images"]) == (UNITS, IMAGES)
    assert 0 < errors["metric"]["rotation_median_deg"] < 0.1
    assert 0 < errors["similarity"]["rmse_m"] < 0.02
    # On 8 m of way, cameras that share little of their views know scale to some percent: the report says how well.
    sigma = read_report(surround_scene)["by_stage"]["refinement"]["scale"]["sigma_relative"]
    assert 0 < sigma < 0.15
    assert 0 < abs(errors["similarity"]["scale"] - 1.0) < 3 * sigma


def test_every_file_is_there_and_readable(surround_scene: Path) -> None:
    expected = {"model", "points.ply", "poses.tum", "poses.json", "calibration.json", "frame.json", "features.db"}
    expected |= {"points.copc.laz", "trajectory.gpkg", "rig", "autoware", "view.json", "report.html"}
    expected |= {"manifest.json", "road.json", "pictures"}  # the drive has masks, and its cameras see the road
    assert {path.name for path in surround_scene.iterdir()} == {*expected, "report.json", ".stages"}
    assert leftovers(surround_scene.parent) == []
    points = read_report(surround_scene)["summary"]["points"]
    assert points > 500
    for folder in (surround_scene / "model", surround_scene / "model" / "text"):
        model = pycolmap.Reconstruction(str(folder))
        assert (model.num_reg_frames(), model.num_reg_images(), model.num_points3D()) == (UNITS, IMAGES, points)
        assert 0 < model.compute_mean_reprojection_error() < 1.5
    assert f"element vertex {points}".encode() in (surround_scene / "points.ply").read_bytes()[:1000]
    calibration = json.loads((surround_scene / "calibration.json").read_text())
    assert set(calibration["cameras"]) == {"front", "back", "left", "right"}
    assert len((surround_scene / "poses.tum").read_text().splitlines()) == UNITS + 1


def test_the_road_is_found(surround_scene: Path) -> None:
    road = read_report(surround_scene)["by_stage"]["refinement"]["road"]
    assert road["source"] == "masks"
    assert road["kept"] + road["dropped"] == road["points"] > 100
    assert 0 < road["thickness_after_m"] < 0.15
    # The rig's origin is on the ground below the rear axle, the cameras 1.6 m above; scale is known to 10 %.
    assert abs(road["rig_height_above_road_m"]) < 0.2
    document = json.loads((surround_scene / "road.json").read_text())
    assert len(document["patches"]) == road["patches"] > 1
    normals = np.array([patch["normal"] for patch in document["patches"]])
    assert (normals @ document["up"] > np.cos(np.radians(6))).all()
    assert sum(patch["points"] for patch in document["patches"]) <= road["kept"]
    assert {"road_before.png", "road_after.png"} < {path.name for path in (surround_scene / "pictures").iterdir()}


def test_features_are_a_colmap_database(surround_scene: Path, tmp_path: Path) -> None:
    copy = tmp_path / "features.db"  # COLMAP writes into what it opens
    copy.write_bytes((surround_scene / "features.db").read_bytes())
    with pycolmap.Database.open(str(copy)) as database:
        assert (database.num_images(), database.num_frames(), database.num_rigs()) == (IMAGES, UNITS, 1)
        assert 0 < database.num_verified_image_pairs() <= database.num_matched_image_pairs()


def test_georeferenced_frame(surround_drive: Path, surround_scene: Path) -> None:
    frame = json.loads((surround_scene / "frame.json").read_text())
    assert frame["georeferenced"] is True
    origin = json.loads((surround_drive / "drive.json").read_text())["gnss"]["samples"][0]
    assert abs(frame["origin"]["latitude_deg"] - origin["latitude_deg"]) < 1e-3
    assert np.array(frame["ecef_from_local"]).shape == (4, 4)
    poses = json.loads((surround_scene / "poses.json").read_text())
    assert all("geodetic" in item for item in (*poses["units"], *poses["images"]))


@pytest.mark.parametrize("options", [("--no-gnss",), *slow(())])
def test_second_run_reuses_everything(variant: Variant, mrasfm: Run, options: tuple[str, ...]) -> None:
    variant.keep(cameras=["front", "left"], units=4).save()
    command = ("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES, *options)
    assert mrasfm(*command).code == 0
    before, first = _contents(variant.scene), read_report(variant.scene)
    assert [stage["reused"] for stage in first["stages"]] == [False] * len(first["stages"])
    assert mrasfm(*command).code == 0
    again = read_report(variant.scene)
    assert all(again["by_stage"][name]["reused"] for name in CHECKPOINTED)
    assert _contents(variant.scene) == before
    assert [_of_what_was_found(stage) for stage in again["stages"]] == [_of_what_was_found(s) for s in first["stages"]]
    assert (again["findings"], again["summary"]) == (first["findings"], first["summary"])
    if options:
        _check_not_georeferenced(variant.scene)


def _contents(scene: Path) -> dict[str, bytes]:
    """Files of a scene that hold no times."""
    files = (path for path in scene.rglob("*") if path.is_file() and ".stages" not in path.parts)
    timed = ("report.json", "report.html", "features.db")
    return {str(path.relative_to(scene)): path.read_bytes() for path in files if path.name not in timed}


def _of_what_was_found(stage: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in stage.items() if name not in ("seconds", "reused")}


def _check_not_georeferenced(scene: Path) -> None:
    """Geodetic fields are absent, not zero or null."""
    frame = json.loads((scene / "frame.json").read_text())
    assert frame["georeferenced"] is False
    assert not {"world_crs", "world_crs_wkt2", "height_datum", "origin", "ecef_from_local"} & set(frame)
    poses = json.loads((scene / "poses.json").read_text())
    assert not any("geodetic" in item for item in (*poses["units"], *poses["images"]))
