"""A written scene read back for aggregation, and what is refused."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.aggregation.load import name_scenes, read_scene
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.errors import InputError
from mrasfm_engine.export.scene import write_scene
from schemas import Gnss, GnssSample
from tests.helpers.export_example import make_scene, withheld_files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_scene(make_scene(), tmp_path / "scene", {"settings": {"features": {"extractor": "sift"}}})
    return tmp_path / "scene"


def test_everything_comes_back(folder: Path) -> None:
    written, read = make_scene(), read_scene(folder, "one")
    assert np.array_equal(read.unit_registered, written.unit_registered)
    kept = written.unit_registered
    assert np.abs(read.world_from_rig[kept] - written.world_from_rig[kept]).max() < 1e-9
    assert np.array_equal(read.points_m, written.points_m)
    assert np.array_equal(read.point_colors, written.point_colors)
    assert np.array_equal(read.point_classes, written.point_classes)
    seen = np.isfinite(written.world_from_cam[:, 0, 0])
    assert np.abs(read.world_from_cam[seen] - written.world_from_cam[seen]).max() < 1e-8
    rows = read.keypoint_first[written.observation_image] + written.observation_keypoint
    assert np.array_equal(read.keypoint_point[rows], written.observation_point)
    assert (read.keypoint_point >= 0).sum() == len(rows)
    for row, image, keypoint in zip(rows, written.observation_image, written.observation_keypoint, strict=True):
        descriptor = read.descriptors[read.descriptor_row[row]]
        assert np.array_equal(descriptor, written.features[image].descriptors[keypoint])


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    """With what SQLite takes for parts of a URI."""
    folder = tmp_path / "a#1 b%25?"
    write_scene(make_scene(), folder, {"settings": {"features": {"extractor": "sift"}}})
    assert (folder / "trajectory.gpkg").is_file()
    assert withheld_files(folder) == []
    assert len(read_scene(folder, "one").keypoint_point) > 0


def test_the_receiver_is_as_the_scene_found_it(tmp_path: Path) -> None:
    """Its antenna and its clock; the scene's own manifest has what was given."""
    example = make_scene()
    sigmas = {"sigma_horizontal_m": 1.0, "sigma_vertical_m": 2.0}
    samples = [
        GnssSample(timestamp_us=second * 1_000_000, latitude_deg=49.0, longitude_deg=8.4, height_m=110.0, **sigmas)
        for second in range(4)
    ]
    gnss = Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[0.0, 0.0, 1.6], samples=samples)
    example = replace(
        example,
        drive=replace(example.drive, manifest=example.drive.manifest.model_copy(update={"gnss": gnss})),
    )
    found = {"antenna": {"used_in_rig_m": [0.5, -0.3, 1.7]}, "clock_offset_s": -0.25}
    stages = [{"stage": "mapping"}, {"stage": "refinement", "gnss": found}]
    write_scene(example, tmp_path / "scene", {"settings": {"features": {"extractor": "sift"}}, "stages": stages})
    read = read_scene(tmp_path / "scene", "one").manifest.gnss
    assert read is not None
    assert list(read.antenna_in_rig_m) == [0.5, -0.3, 1.7]
    assert [sample.timestamp_us for sample in read.samples] == [750_000, 1_750_000, 2_750_000]
    report = json.loads((tmp_path / "scene" / "report.json").read_text())
    report["stages"][1]["gnss"]["antenna"]["used_in_rig_m"] = [1e9, 0.0, 0.0]
    (tmp_path / "scene" / "report.json").write_text(json.dumps(report))
    with pytest.raises(InputError, match=r"scene one: .*report.json is damaged"):
        read_scene(tmp_path / "scene", "one")


def test_packing_changes_nothing(folder: Path) -> None:
    read = read_scene(folder, "one")
    again = SourceScene.unpack("two", *read.pack())
    assert again.fingerprint == read.fingerprint
    assert again.name == "two"


def test_certainty_of_cameras_is_without_errors_that_drives_share(folder: Path) -> None:
    calibration = json.loads((folder / "calibration.json").read_text()) | {"adjusted": True}
    for camera in calibration["cameras"].values():
        camera["sigma"] = {"rotation_deg": [0.1] * 3, "translation_m": [0.01] * 3}
        camera["repeatability"] = {"rotation_deg": [0.02] * 3, "translation_m": [0.005] * 3}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    stated = read_scene(folder, "one").certainty_of_cameras
    assert stated is not None
    np.testing.assert_allclose(stated[0], [[*[np.radians(0.02)] * 3, *[0.005] * 3]] * len(stated[0]))
    for camera in calibration["cameras"].values():
        del camera["repeatability"]  # a scene of an earlier version
    (folder / "calibration.json").write_text(json.dumps(calibration))
    stated = read_scene(folder, "one").certainty_of_cameras
    assert stated is not None
    np.testing.assert_allclose(stated[0], [[*[np.radians(0.1)] * 3, *[0.01] * 3]] * len(stated[0]))


def test_damage_is_said_by_name(folder: Path) -> None:
    data = (folder / "model" / "points3D.bin").read_bytes()
    (folder / "model" / "points3D.bin").write_bytes(data[:-9])
    with pytest.raises(InputError, match=r"scene one: .* is damaged"):
        read_scene(folder, "one")
    (folder / "model" / "points3D.bin").write_bytes(data)
    calibration = json.loads((folder / "calibration.json").read_text()) | {"adjusted": True}
    for camera in calibration["cameras"].values():
        camera["repeatability"] = {"rotation_deg": [0.1] * 3, "translation_m": [0.01] * 3}
    for wrong in (float("nan"), 0.0, "x"):
        broken = json.loads(json.dumps(calibration))
        next(iter(broken["cameras"].values()))["repeatability"]["rotation_deg"][1] = wrong
        (folder / "calibration.json").write_text(json.dumps(broken))
        with pytest.raises(InputError, match=r"scene one: .*calibration.json is damaged"):
            read_scene(folder, "one")
    unknown = json.loads(json.dumps(calibration))
    next(iter(unknown["cameras"].values()))["repeatability"] = {}
    (folder / "calibration.json").write_text(json.dumps(unknown))
    assert read_scene(folder, "one").certainty_of_cameras is None
    (folder / "calibration.json").write_text(json.dumps(calibration))
    assert read_scene(folder, "one").certainty_of_cameras is not None
    frame = json.loads((folder / "frame.json").read_text())
    (folder / "frame.json").write_text(json.dumps({**frame, "version": 9}))
    with pytest.raises(InputError, match="is of version 9") as raised:
        read_scene(folder, "one")
    assert raised.value.code == "scene-version"
    (folder / "frame.json").write_text(json.dumps({**frame, "georeferenced": False}))
    assert not read_scene(folder, "one").is_placed


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("poses.json", ["units", None], r"scene/poses.json is damaged"),
        ("poses.json", ["units", 0, "sigma_position_m", [1.0]], r"scene/poses.json is damaged"),
        (
            "poses.json",
            ["units", 0, "world_from_rig", "translation_m", 0, float("nan")],
            r"poses.json is .* finite number\n",
        ),
        ("poses.json", ["units", 0, "registered", False], "images with a pose of units without one"),
        ("poses.json", ["images", 0, "world_from_cam", "translation_m", 0, 3.0], "have different poses of .*000.png"),
        ("frame.json", ["ecef_from_local", 0, 3, 2e7], r"frame.json is damaged.* near the earth's surface"),
        ("calibration.json", ["cameras", "left", "refined", "params", 0, 0.0], r"scene one: .*calibration.json is dam"),
        ("calibration.json", ["cameras", "left", "refined", "params", 0, -800.0], "focal length fx"),
        ("calibration.json", ["cameras", "left", "refined", "params", [800.0]], "has 4 parameters"),
        ("calibration.json", ["cameras", {}], r"scene one: .*/scene/calibration.json is damaged"),
    ],
)
def test_files_that_no_run_has_written_are_refused_before_any_work(
    folder: Path, file: str, change: list[Any], said: str
) -> None:
    document = json.loads((folder / file).read_text())
    *path, last, value = change
    inner = document
    for step in path:
        inner = inner[step]
    inner[last] = value
    (folder / file).write_text(json.dumps(document))
    with pytest.raises(InputError, match=said) as raised:
        read_scene(folder, "one")
    assert raised.value.code == "damaged-scene"


@pytest.mark.parametrize("file", ["model/images.bin", "model/points3D.bin", "points.ply", "features.db"])
def test_the_file_that_is_damaged_is_named(folder: Path, file: str) -> None:
    """What is said was that something in the scene's folder is."""
    data = (folder / file).read_bytes()
    (folder / file).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=rf"scene one: .*/scene/{file} is damaged: .*") as raised:
        read_scene(folder, "one")
    assert "\n" not in raised.value.what


def test_descriptors_that_are_missing_are_named_by_their_image(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "features.db")) as database:
        database.execute("DELETE FROM descriptors WHERE image_id = 1")
        database.commit()
    with pytest.raises(InputError, match=r"features.db is damaged: .* no descriptors of image 1\n"):
        read_scene(folder, "one")


def test_a_unit_that_is_not_where_its_images_are_is_refused(folder: Path) -> None:
    """Images may be away from their unit as far as it drives until they are taken."""
    document = json.loads((folder / "poses.json").read_text())
    document["units"][0]["world_from_rig"]["translation_m"][0] += 5.0
    (folder / "poses.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"left/000.png 5.00 m from its unit") as raised:
        read_scene(folder, "one")
    assert raised.value.code == "damaged-scene"
    manifest = json.loads((folder / "manifest.json").read_text())
    for image in manifest["frames"][0]["images"].values():
        image["timestamp_us"] = manifest["frames"][0]["timestamp_us"] + 100_000
    (folder / "manifest.json").write_text(json.dumps(manifest))
    read_scene(folder, "one")


def test_names() -> None:
    assert name_scenes([Path("/a/x"), Path("/b/y")]) == {"x": Path("/a/x"), "y": Path("/b/y")}
    with pytest.raises(InputError, match="called 'x'"):
        name_scenes([Path("/a/x"), Path("/b/x")])
    with pytest.raises(InputError, match="cannot be the name"):
        name_scenes({"../x": Path("/a/x")})
    with pytest.raises(InputError, match="cannot be the name"):
        name_scenes({"x\n": Path("/a/x")})
    with pytest.raises(InputError, match="cannot be the name"):
        name_scenes({"a~b": Path("/a/x")})
