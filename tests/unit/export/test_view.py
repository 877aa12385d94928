"""`view.json`, read as the console reads it: positions in the points' coordinates, observations at their pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pycolmap
import pytest

from mrasfm_engine.export import view_readback
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.view import image_places
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import COPC_FILE, VIEW_FILE
from tests.helpers.export_example import MISSING_IMAGE, MISSING_UNIT, UNITS, make_scene


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "scene"
    write_scene(make_scene(), out, {})
    return out


@pytest.fixture(scope="module")
def document(written: Path) -> dict[str, Any]:
    return dict(json.loads((written / VIEW_FILE).read_text()))


def test_it_has_what_is_registered(document: dict[str, Any]) -> None:
    (scene,) = document["scenes"]
    assert scene["name"] == "example"
    assert scene["units"] == [u for u in range(UNITS) if u != MISSING_UNIT]
    assert len(scene["trajectory_m"]) == len(scene["longitude_latitude_deg"]) == UNITS - 1
    registered = make_scene().image_registered
    assert len(scene["images"]) == int(registered.sum()) < UNITS * 2
    files = [image.file for image in make_scene().drive.images]
    assert [image["file"] for image in scene["images"]] == [f for f, r in zip(files, registered, strict=True) if r]
    assert files[MISSING_IMAGE] not in {image["file"] for image in scene["images"]}


def test_its_offset_is_that_of_the_points(written: Path, document: dict[str, Any]) -> None:
    las = laspy.read(written / COPC_FILE)
    np.testing.assert_array_equal(document["offset_m"], las.header.offsets)
    assert f"zone {document['epsg'] - 32600}N" in las.header.parse_crs().name


def test_rays_through_keypoints_meet_the_points_of_the_cloud(written: Path, document: dict[str, Any]) -> None:
    """Points of the cloud, seen through a frustum, lie at the pixels of its observations."""
    las = laspy.read(written / COPC_FILE)
    cloud = las.xyz - document["offset_m"]
    by_id = {int(point): xyz for point, xyz in zip(las["point_id"], cloud, strict=True)}
    data = (written / document["observations"]).read_bytes()
    (scene,) = document["scenes"]
    left = [image for image in scene["images"] if image["camera"] == "left"]  # without distortion
    checked = 0
    for image in left:
        at, count = image["observations"]
        rows = np.frombuffer(data, view_readback.KEYPOINT, count, at)
        rows = rows[rows["point"] != view_readback.NO_POINT]
        centre, *corners = np.array(image["frustum_m"])
        width, height = image["size_px"]
        right, down = corners[1] - corners[0], corners[3] - corners[0]
        normal = np.cross(right, down)
        for row in rows:
            ray = by_id[int(row["point"])] - centre
            met = ray * (normal @ (corners[0] - centre)) / (normal @ ray) - (corners[0] - centre)
            pixel = np.array([met @ right / (right @ right) * width, met @ down / (down @ down) * height])
            # Millimetres of the corners are 1.2 px at 800 px per metre.
            assert np.abs(pixel - row["xy_px"]).max() < 4.0
            checked += 1
    assert checked > 50


def test_places_of_keypoints_are_those_that_colmap_reads(written: Path) -> None:
    model = pycolmap.Reconstruction(str(written / "model"))
    data = (written / "model" / "images.bin").read_bytes()
    places = image_places(data)
    assert set(places) == set(model.images)
    for image_id, (at, count) in places.items():
        rows = np.frombuffer(data, view_readback.KEYPOINT, count, at)
        np.testing.assert_array_equal(rows["xy_px"], [p.xy for p in model.images[image_id].points2D])


def test_without_a_place_on_the_earth_it_is_local(tmp_path: Path) -> None:
    scene = make_scene(georeferenced=False)
    write_scene(scene, tmp_path / "scene", {})
    document = json.loads((tmp_path / "scene" / VIEW_FILE).read_text())
    assert document["offset_m"] == [0.0, 0.0, 0.0]
    assert "epsg" not in document
    assert "longitude_latitude_deg" not in document["scenes"][0]
    units = document["scenes"][0]["units"]
    np.testing.assert_allclose(document["scenes"][0]["trajectory_m"], scene.world_from_rig[units, :3, 3], atol=6e-4)


def moved(scene: Scene) -> Scene:
    poses = scene.world_from_rig.copy()
    poses[0, 0, 3] += 0.01
    return replace(scene, world_from_rig=poses)


def other_pixels(scene: Scene) -> Scene:
    features = [replace(f, xy_px=f.xy_px + 0.5) for f in scene.features]
    return replace(scene, features=features)


@pytest.mark.parametrize("change", [moved, other_pixels])
def test_a_scene_that_says_something_else_is_noticed(written: Path, change: Any) -> None:
    read = view_readback.read_view(written / VIEW_FILE)
    assert all(row.agrees for row in view_readback.view(make_scene(), read))
    assert not all(row.agrees for row in view_readback.view(change(make_scene()), read))
