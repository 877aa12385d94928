"""What an aggregation refuses before it touches any file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.aggregation.stages import map_document
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.export.map import REPLACED
from mrasfm_engine.export.publishing import only_run
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.pipeline import reconstruct
from tests.helpers.export_example import make_scene

# The example has 50 points; its scenes lie upon one another.
CONFIG = EngineConfig.model_validate({"aggregation": {"min_inliers": 20}, "threads": 1})
REPORT = {"settings": {"features": {"extractor": "sift"}}}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_no_map_over_a_scene_and_no_scene_over_a_map(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        write_scene(make_scene(folder=folder.name), folder, REPORT)
    before = contents(one)
    with pytest.raises(InputError, match="holds a scene"):
        aggregate([one, two], one, EngineConfig())
    assert contents(one) == before
    (one / "map.json").write_text("{}")
    with pytest.raises(InputError, match="holds a map"):
        reconstruct(tmp_path / "nowhere", one, EngineConfig())


def test_a_folder_with_files_that_no_map_has_made_is_refused(tmp_path: Path) -> None:
    """Most of all the folder in which somebody keeps scenes in `scenes/`: a map would replace it."""
    for name in ("one", "two"):
        write_scene(make_scene(folder=name), tmp_path / "scenes" / name, REPORT)
    scenes, before = [tmp_path / "scenes" / name for name in ("one", "two")], contents(tmp_path)
    with pytest.raises(InputError, match="scenes was made by no map") as found:
        aggregate(scenes, tmp_path, CONFIG)
    assert found.value.code == "bad-out-folder"
    assert contents(tmp_path) == before


def test_one_run_at_a_time_makes_a_map_in_a_folder(tmp_path: Path) -> None:
    """Two would look for the same seams, and the later one would replace the map of the other."""
    with only_run(tmp_path / "map"), pytest.raises(InputError, match=r"another run is making .*map") as found:
        aggregate([tmp_path / "one", tmp_path / "two"], tmp_path / "map", CONFIG)
    assert found.value.code == "output-in-use"
    assert list(tmp_path.iterdir()) == []


def test_a_map_is_replaced_by_the_next_and_no_name_of_it_is_unknown(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_scene(make_scene(folder=name), tmp_path / name, REPORT)
    out = tmp_path / "map"
    aggregate([tmp_path / "one", tmp_path / "two"], out, CONFIG)
    (out / "notes.txt").touch()  # what is no map's stays
    aggregate([tmp_path / "one", tmp_path / "two"], out, CONFIG)
    made = {path.name for path in out.iterdir()} - {".stages", "report.json"}
    always = {"notes.txt", "model", "points.ply", "poses.tum", "poses.json", "frame.json", "map.json"}
    assert always <= made <= always.union(REPLACED)


def test_a_map_of_another_version_is_refused_by_name(tmp_path: Path) -> None:
    one, two, into = (tmp_path / name for name in ("one", "two", "map"))
    for folder in (one, two):
        write_scene(make_scene(folder=folder.name), folder, REPORT)
    scene = read_scene(one, "one")
    document = {"version": 1, "scenes": [{"name": "one", "fingerprint": scene.fingerprint}], "seams": []}
    into.mkdir()
    (into / "report.json").write_text("{}")

    def refusal(version: int, *, without: str) -> InputError:
        arrays, documents = scene.pack()
        del arrays[without]
        StageStore(into / "scenes").save("one", scene.fingerprint, arrays, documents)
        (into / "map.json").write_text(json.dumps({**document, "version": version}))
        with pytest.raises(InputError) as raised:
            aggregate([two], tmp_path / "out", EngineConfig(), into=into)
        assert raised.value.code == "map-version"
        return raised.value

    assert "map.json is of version 2, not of 1" in refusal(2, without="points_m").what
    assert re.search("scenes/one.npz: .*points_m", refusal(1, without="points_m").what)


@pytest.mark.parametrize(
    "edit",
    [
        {"seams": None},
        {"seams": [{}]},
        {"seams": [{"accepted": True, "a": "one"}]},
        {"seams": [{"accepted": True, "a": "one", "b": 2}]},
        {"scenes": [{"name": "one"}]},
        {"scenes": {"one": {}}},
    ],
)
def test_a_map_whose_document_lacks_parts_is_refused(tmp_path: Path, edit: dict[str, object]) -> None:
    """They are missed after all scenes were read, which ended with a stack trace."""
    (tmp_path / "report.json").write_text("{}")
    scenes = [{"name": "one", "fingerprint": "1"}]
    (tmp_path / "map.json").write_text(json.dumps({"version": 1, "scenes": scenes, "seams": [], **edit}))
    with pytest.raises(InputError, match="is no map"):
        map_document(tmp_path)
