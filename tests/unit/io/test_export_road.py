from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_example import FILES, assert_nothing_published, make_scene

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.io import export_ply, export_road
from mrasfm_engine.io.export_scene import write_scene
from mrasfm_engine.io.road_pictures import ABOVE, BELOW, NAMES, ON
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource, RoadSurface
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import ROAD

OFF_M = 0.4


def scene_with_road(*, far: bool = False) -> Scene:
    """The example with a level road of two patches under its way; points 0 to 19 lie on it."""
    scene = make_scene()
    way = scene.world_from_rig[scene.unit_registered, :3, 3]
    rng = np.random.default_rng(0)
    points = scene.points_m.copy()
    points[:20] = np.column_stack([rng.uniform(0, 10, 20), rng.uniform(-3, 3, 20), rng.normal(-1.5, 0.01, 20)])
    surface = RoadSurface(
        axes=np.eye(3),
        centre_m=np.array([[2.0, 0.0, -1.5], [8.0, 0.0, -1.5]]),
        normal=np.tile([0.0, 0.0, 1.0], (2, 1)),
        radius_m=8.0,
    )
    shift = np.array([0.0, 0.0, OFF_M])
    before = np.concatenate([points[:20], points[:20] + shift, points[:20] - shift])
    if far:
        before[-1] = [1e4, 0.0, 900.0]
    distance, patch = surface.locate(before)
    road = Road(
        source=RoadSource.MASKS,
        surface=surface,
        roughness_m=0.01,
        rig_height_m=float(way[0, 2] + 1.5),
        before=RoadPoints(points_m=before, distance_m=distance, kept=np.arange(60) < 20),
    )
    classes = np.where(np.arange(len(points)) < 20, ROAD, 1).astype(np.uint8)
    patches = np.full(len(points), -1, np.int32)
    patches[:20] = patch[:20]
    return replace(scene, points_m=points, point_classes=classes, point_patches=patches, road=road)


def counted(path: Path) -> dict[str, int]:
    """Pixels of both panels by colour."""
    image = cv2.imread(str(path))[100:950]
    named = {"on": ON, "above": ABOVE, "below": BELOW}
    return {name: int((image == np.array(colour)).all(-1).sum()) for name, colour in named.items()}


def test_the_road_is_written_with_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The points were moved off their keypoints: what the model says of them is another test's matter.
    scene = scene_with_road()
    out = tmp_path / "scene"
    write_scene(scene, out, {})
    assert {p.name for p in out.iterdir()} == FILES | {"road.json", "pictures"}
    document = json.loads((out / "road.json").read_text())
    assert document["source"] == "masks"
    assert [patch["points"] for patch in document["patches"]] == np.bincount(scene.point_patches[:20]).tolist()
    assert document["patches"][1]["centre_m"] == [8.0, 0.0, -1.5]
    head, _, body = (out / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"comment class: 0 unknown, 1 static, 2 road, 3 dynamic, 4 sky, 5 own_car" in head
    assert head.rstrip().endswith(b"property uchar class\nproperty int road_patch")
    rows = np.frombuffer(body, np.uint8).reshape(len(scene.points_m), -1)
    assert rows[:, -5].tolist() == scene.point_classes.tolist()
    assert rows[:, -4:].copy().view("<i4")[:, 0].tolist() == scene.point_patches.tolist()
    # Written again without a road: nothing of the old one stays.
    write_scene(make_scene(), out, {})
    assert {p.name for p in out.iterdir()} - {"pictures"} == FILES
    assert not list(out.glob("pictures/*"))


def test_pictures_show_what_was_dropped(tmp_path: Path) -> None:
    scene = scene_with_road()
    write_scene(scene, tmp_path / "scene", {})
    before, after = (counted(tmp_path / "scene" / "pictures" / name) for name in NAMES)
    assert min(before.values()) > 100
    assert after["above"] == after["below"] == 0
    assert 0.5 * before["on"] < after["on"]


def test_points_at_the_end_of_the_world_do_not_spoil_the_picture(tmp_path: Path) -> None:
    write_scene(scene_with_road(far=True), tmp_path / "scene", {})
    near = counted(tmp_path / "scene" / "pictures" / NAMES[0])
    assert min(near.values()) > 100


@pytest.mark.parametrize("name", ["point_classes", "point_patches"])
def test_a_ply_with_other_classes_or_patches_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    scene, original = scene_with_road(), export_ply.write_ply
    wrong = replace(scene, **{name: np.roll(getattr(scene, name), 1)})
    monkeypatch.setattr(export_ply, "write_ply", lambda _, path: original(wrong, path))
    with pytest.raises(MrasfmError, match=r"points\.ply was written but does not read back"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


def test_a_road_file_that_says_something_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, original = scene_with_road(), export_road.road_document
    assert scene.road is not None
    surface = replace(scene.road.surface, centre_m=scene.road.surface.centre_m + 0.01)
    wrong = replace(scene, road=replace(scene.road, surface=surface))
    monkeypatch.setattr(export_road, "road_document", lambda _: original(wrong))
    with pytest.raises(MrasfmError, match=r"road\.json was written but does not read back"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


def test_patches_without_a_road_are_refused(tmp_path: Path) -> None:
    scene = replace(scene_with_road(), road=None)
    with pytest.raises(MrasfmError, match="a point lies on no patch of the road"):
        write_scene(scene, tmp_path / "scene", {})
