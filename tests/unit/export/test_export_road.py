from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export import ply, road
from mrasfm_engine.export.scene import write_scene
from tests.helpers.export_example import FILES, assert_nothing_published, make_scene, scene_with_road


def test_the_road_is_written_with_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The points were moved off their keypoints: what the model says of them is another test's matter.
    scene = scene_with_road()
    out = tmp_path / "scene"
    write_scene(scene, out, {})
    assert {p.name for p in out.iterdir()} == FILES | {"road.json"}
    document = json.loads((out / "road.json").read_text())
    assert document["source"] == "masks"
    assert [patch["points"] for patch in document["patches"]] == np.bincount(scene.point_patches[:20]).tolist()
    assert document["patches"][1]["centre_m"] == [8.0, 0.0, -1.5]
    head, _, body = (out / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"comment class: 0 unknown, 1 static, 2 road, 3 dynamic, 4 sky, 5 own_car" in head
    assert head.rstrip().endswith(b"property uchar class\nproperty int road_patch\nproperty int component")
    rows = np.frombuffer(body, np.uint8).reshape(len(scene.points_m), -1)
    assert rows[:, -9].tolist() == scene.point_classes.tolist()
    assert rows[:, -8:-4].copy().view("<i4")[:, 0].tolist() == scene.point_patches.tolist()
    # Written again without a road: nothing of the old one stays.
    write_scene(make_scene(), out, {})
    assert {p.name for p in out.iterdir()} == FILES


def test_the_surface_is_computed_from_the_file_as_it_says(tmp_path: Path) -> None:
    scene = scene_with_road()
    assert scene.road is not None
    write_scene(scene, tmp_path / "scene", {})
    document = json.loads((tmp_path / "scene" / "road.json").read_text())
    axes, relief = np.array(document["axes"]), document["relief"]
    for x, y in ((5.0, 0.0), (4.2, 0.9), (2.0, 1.0), (7.7, -0.4)):
        away = np.array([x, y]) - np.array(relief["node_m"])[:, :2]
        weight = np.maximum(1 - (away**2).sum(1) / relief["radius_m"] ** 2, 0.0) ** 2
        value = np.array(relief["height_m"]) + (away * np.array(relief["slope"])).sum(1)
        height = (weight * value).sum() / (weight.sum() + 0.05)
        distance, _ = scene.road.surface.locate(np.array([[x, y, -1.5 + height]]) @ axes)
        assert distance == pytest.approx([0.0], abs=2e-4)
        assert (height != 0.0) == (x != 7.7 and x != 2.0)


@pytest.mark.parametrize("name", ["point_classes", "point_patches"])
def test_a_ply_with_other_classes_or_patches_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    scene, original = scene_with_road(), ply.write_ply
    wrong = replace(scene, **{name: np.roll(getattr(scene, name), 1)})
    monkeypatch.setattr(ply, "write_ply", lambda _, path: original(wrong, path))
    with pytest.raises(MrasfmError, match=r"points\.ply was written but does not read back"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


@pytest.mark.parametrize("part", ["patches", "relief"])
def test_a_road_file_that_says_something_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    scene, original = scene_with_road(), road.road_document
    assert scene.road is not None
    surface = scene.road.surface
    surface = (
        replace(surface, centre_m=surface.centre_m + 0.01)
        if part == "patches"
        else replace(surface, relief=replace(surface.relief, height_m=surface.relief.height_m + 0.001))
    )
    wrong = replace(scene, road=replace(scene.road, surface=surface))
    monkeypatch.setattr(road, "road_document", lambda _: original(wrong))
    with pytest.raises(MrasfmError, match=r"road\.json was written but does not read back"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


def test_patches_without_a_road_are_refused(tmp_path: Path) -> None:
    scene = replace(scene_with_road(), road=None)
    with pytest.raises(MrasfmError, match="a point lies on no patch of the road"):
        write_scene(scene, tmp_path / "scene", {})
