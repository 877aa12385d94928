"""Simulated scenes become a map on disk: connected ones, one that overlaps nothing, one whose cameras take turns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.io.read_map import MapPoses, read_map
from mrasfm_engine.scene.drive import matrix_from_pose
from schemas import Pose
from tests.helpers.small_scenes import Driven, configured, drive_along, make_street

UNITS = 8
BIAS_M = {"a": (1.0, -0.6, 0.4), "b": (-1.2, 0.8, -0.2), "c": (0.6, 0.4, -0.5), "far": (0.7, 0.2, 0.3)}
SHIFT_DEG = 0.004  # north, 445 m


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Driven]:
    """Three that overlap in turns, the second with cameras that take turns; and one in another street."""
    folder, way = tmp_path_factory.mktemp("simulated"), np.arange(0.0, 2.0 * UNITS, 2.0)
    street = make_street(length_m=26.0, points=1000)
    north = make_street(length_m=18.0, points=600, place=(48.1 + SHIFT_DEG, 11.5, 520.0), seed=2)
    return {
        "a": drive_along(street, folder / "a", way, bias_m=BIAS_M["a"], seed=0),
        "b": drive_along(street, folder / "b", way + 5.0, bias_m=BIAS_M["b"], offset_ms=[0, 20, -25, 40], seed=1),
        "c": drive_along(street, folder / "c", way[::-1] + 9.0, back=True, bias_m=BIAS_M["c"], seed=2),
        "far": drive_along(north, folder / "far", way, bias_m=BIAS_M["far"], missing_units=[2], seed=3),
    }


def made(drives: dict[str, Driven], out: Path, **aggregation: object) -> tuple[dict[str, Any], MapPoses, Path]:
    config = configured(**aggregation).model_copy(deep=True)
    config = config.model_copy(update={"output": config.output.model_copy(update={"pictures": False})})
    aggregate({name: d.folder for name, d in drives.items()}, out, config)
    return json.loads((out / "map.json").read_text()), read_map(out), out


@pytest.fixture(scope="module", params=["overlap", "all"])
def result(
    request: pytest.FixtureRequest, drives: dict[str, Driven], tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], MapPoses, Path]:
    return made(drives, tmp_path_factory.mktemp("map") / "out", final_adjustment=request.param)


def street_from_map(result: tuple[dict[str, Any], MapPoses, Path], name: str, drives: dict[str, Driven]) -> np.ndarray:
    """How the map lies on the earth, in the true street's frame."""
    frame = json.loads((result[2] / "frame.json").read_text())
    place = [48.1 + (SHIFT_DEG if name == "far" else 0.0), 11.5, 520.0]
    return se3.inverse(geodesy.ecef_from_local(place)) @ np.array(frame["ecef_from_local"])


def test_scenes_that_overlap_are_as_they_were_driven(
    result: tuple[dict[str, Any], MapPoses, Path], drives: dict[str, Driven]
) -> None:
    document, poses, _ = result
    assert sorted(document["order"]) == ["a", "b", "c"]
    accepted = {(seam["a"], seam["b"]) for seam in document["seams"] if seam["accepted"]}
    assert accepted == {("a", "b"), ("a", "c"), ("b", "c")}
    assert sum("closes_loop" in seam for seam in document["seams"]) == 1
    off = {}
    for name in "abc":
        found = street_from_map(result, name, drives) @ poses.trajectories[name].world_from_rig
        off[name] = (found[:, :3, 3] - drives[name].street_from_rig[:, :3, 3]).mean(0)
        # But for its place on the earth each is right to centimetres.
        own = found[:, :3, 3] - off[name] - drives[name].street_from_rig[:, :3, 3]
        assert 0 < np.abs(own).max() < 0.05
    assert 0 < np.abs(off["a"] - off["b"]).max() < 0.05
    assert 0 < np.abs(off["a"] - off["c"]).max() < 0.05
    # The place is the middle of what three receivers say, and the map says what each was off.
    told = {scene["name"]: np.array(scene["positions_bias_m"]) for scene in document["scenes"]}
    for name in "abc":
        assert 0 < np.abs(told[name] - (np.array(BIAS_M[name]) - off[name])).max() < 0.1
    assert 0 < np.linalg.norm(off["a"]) < 1.0


def test_a_scene_that_overlaps_nothing_is_placed_by_its_receiver_and_marked(
    result: tuple[dict[str, Any], MapPoses, Path], drives: dict[str, Driven]
) -> None:
    document, poses, out = result
    assert document["unconnected"] == poses.unconnected == ["far"]
    verdicts = {scene["name"]: scene["verdict"] for scene in document["scenes"]}
    assert verdicts == {**dict.fromkeys("abc", "connected"), "far": "placed by positions"}
    findings = json.loads((out / "report.json").read_text())["findings"]
    assert [finding["code"] for finding in findings] == ["positions-contradict", "unconnected"]  # sigmas are 1 cm
    assert "far" in findings[1]["what"]
    found = street_from_map(result, "far", drives) @ poses.trajectories["far"].world_from_rig
    registered = np.arange(UNITS) != 2
    error = found[:, :3, 3] - drives["far"].street_from_rig[registered, :3, 3]
    assert 0 < np.abs(error - BIAS_M["far"]).max() < 0.1  # where its receiver said, with its error
    assert (poses.total_units, len(found)) == (4 * UNITS, UNITS - 1)


def test_the_model_reprojects_although_cameras_of_one_drive_take_turns(
    result: tuple[dict[str, Any], MapPoses, Path], drives: dict[str, Driven]
) -> None:
    out = result[2]
    model = pycolmap.Reconstruction(str(out / "model"))
    assert model.num_reg_images() == 4 * 4 * UNITS - 4
    model.update_point_3d_errors()
    assert 0.3 < model.compute_mean_reprojection_error() < 0.8  # noise of 0.4 px an axis
    scenes: dict[int, set[str]] = {}
    for key, point in model.points3D.items():
        scenes[key] = {model.images[e.image_id].name.split("/")[0] for e in point.track.elements}
    joined = sum(len(found) > 1 for found in scenes.values())
    assert joined == json.loads((out / "report.json").read_text())["stages"][-1]["joined_points"] > 200
    assert sum(found == {"a", "b", "c"} for found in scenes.values()) > 50
    assert not any("far" in found and len(found) > 1 for found in scenes.values())
    calibrations = {name: json.loads((out / "calibration" / f"{name}.json").read_text()) for name in drives}
    assert calibrations == {name: driven.source.calibration for name, driven in drives.items()}


def test_images_are_where_their_own_time_puts_them(
    result: tuple[dict[str, Any], MapPoses, Path], drives: dict[str, Driven]
) -> None:
    """Of the drive whose cameras take turns by up to 65 ms at 20 m/s."""
    b = drives["b"].source
    poses = result[1].trajectories["b"].world_from_rig
    document = json.loads((result[2] / "poses.json").read_text())
    images = [image for image in document["images"] if image["scene"] == "b"]
    found = np.stack([matrix_from_pose(Pose(**image["world_from_cam"])) for image in images])
    at_unit = poses[b.image_unit] @ b.drive.rig_from_cam[b.image_camera]
    np.testing.assert_allclose(
        found, poses[b.image_unit] @ b.unit_from_image @ b.drive.rig_from_cam[b.image_camera], atol=1e-5
    )
    apart = np.linalg.norm(found[:, :3, 3] - at_unit[:, :3, 3], axis=1)
    expected = np.abs(np.array([0, 20, -25, 40]))[b.image_camera] * 0.02
    assert np.abs(apart - expected).max() < 0.02
    seconds = np.array([image["timestamp_us"] for image in images]) - b.drive.timestamps_us[b.image_unit]
    assert (seconds == 1000 * np.array([0, 20, -25, 40])[b.image_camera]).all()
