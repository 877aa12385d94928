"""Which scenes can be in one map: frames, worlds and height datums."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.aggregation import stages
from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.errors import InputError
from mrasfm_engine.io.stage_store import StageStore
from tests.helpers.small_scenes import CONFIG, Driven, Street, drive_along, make_street


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=6.0, points=150)


def driven(street: Street, folder: Path, name: str, common_world: str | None = None) -> Driven:
    seed = sum(name.encode())
    way = np.arange(0.0, 6.0, 2.0) + 0.1 * (seed % 10)
    return drive_along(street, folder / name, way, cameras=2, common_world=common_world, seed=seed)


def together(folder: Path, *drives: Driven) -> tuple[list[str], stages.Run]:
    run = stages.Run(CONFIG, StageStore(folder / ".stages"), None, lambda *_: None, lambda: False)
    found = stages.scenes(run, {d.source.name: d.folder for d in drives}, [])
    return [scene.name for scene in found], run


def test_one_common_world_or_gnss_for_all(street: Street, tmp_path: Path) -> None:
    one, two = (driven(street, tmp_path, name, "survey-2019") for name in ("one", "two"))
    other, gnss = driven(street, tmp_path, "other", "map-of-the-client"), driven(street, tmp_path, "gnss")
    assert together(tmp_path, one, two)[0] == ["one", "two"]
    for pair, words in (
        ((one, other), "one and other have different worlds: survey-2019 and map-of-the-client"),
        ((gnss, two), "gnss and two have different worlds: of positions and survey-2019"),
    ):
        with pytest.raises(InputError, match=words) as raised:
            together(tmp_path, *pair)
        assert raised.value.code == "different-worlds"
        assert "common_world" in raised.value.remedy


def test_rough_poses_of_a_world_of_their_own_place_nothing(street: Street, tmp_path: Path) -> None:
    scene = driven(street, tmp_path, "one", "survey")
    path = scene.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["rough_poses"]["common_world"]
    path.write_text(json.dumps(manifest))
    assert not read_scene(scene.folder, "one").is_placed
    two = driven(street, tmp_path, "two")
    assert together(tmp_path, scene, two)[0] == ["one", "two"]
    shutil.copytree(scene.folder, tmp_path / "three")
    other = replace(scene, source=replace(scene.source, name="three"), folder=tmp_path / "three")
    with pytest.raises(InputError, match="scene one is not georeferenced") as raised:
        together(tmp_path, scene, other)
    assert raised.value.code == "not-georeferenced"


def test_height_datums_that_differ_are_said_and_change_nothing(street: Street, tmp_path: Path) -> None:
    """Heights in scenes are ellipsoidal already; what the drive declared is only repeated."""
    one, two = driven(street, tmp_path, "one"), driven(street, tmp_path, "two")
    names, run = together(tmp_path, one, two)
    assert run.report["findings"] == []
    path = two.folder / "frame.json"
    frame = json.loads(path.read_text())
    path.write_text(json.dumps({**frame, "height_datum": "EPSG:5773"}))
    names, run = together(tmp_path, one, two)
    assert names == ["one", "two"]
    assert [finding["code"] for finding in run.report["findings"]] == ["height-datums"]
    assert "EPSG:5773, ellipsoidal" in run.report["findings"][0]["what"]
    again = read_scene(two.folder, "two")
    assert again.height_datum == "EPSG:5773"
    np.testing.assert_array_equal(again.ecef_from_local, two.source.ecef_from_local)


@pytest.mark.parametrize(
    ("row", "column", "factor"), [(0, 0, 1.01), (1, 3, float("nan")), (3, 3, 2.0), (None, 2, -1.0)]
)  # fmt: skip
def test_a_frame_that_is_no_rigid_transform_is_refused(
    street: Street, tmp_path: Path, row: int | None, column: int, factor: float
) -> None:
    """Stretched, not a number, homogeneous, mirrored."""
    scene = driven(street, tmp_path, "one")
    path = scene.folder / "frame.json"
    frame = json.loads(path.read_text())
    matrix = np.array(frame["ecef_from_local"])
    matrix[slice(0, 3) if row is None else row, column] *= factor
    path.write_text(json.dumps({**frame, "ecef_from_local": matrix.tolist()}))
    with pytest.raises(InputError, match="not a rigid one") as raised:
        read_scene(scene.folder, "one")
    assert raised.value.code == "damaged-scene"


def test_the_same_drive_twice(street: Street, tmp_path: Path) -> None:
    one = driven(street, tmp_path, "one")
    run = stages.Run(CONFIG, StageStore(tmp_path / ".stages"), None, lambda *_: None, lambda: False)
    with pytest.raises(InputError, match="of the same drive"):
        stages.scenes(run, {"one": one.folder, "copy": one.folder}, [])
