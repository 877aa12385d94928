"""Maps of the small example scene: what is checked of scenes together, and what a map's files are called."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.commands.stage_progress import StageLines
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.scene.drive import Drive
from schemas import Pose
from schemas.drive import RoughPose, RoughTrajectory
from tests.helpers.export_example import UNITS, make_scene

# The example has 50 points; its scenes lie upon one another.
CONFIG = EngineConfig.model_validate({"aggregation": {"min_inliers": 20}, "threads": 1})
REPORT: dict[str, Any] = {"settings": {"features": {"extractor": "sift"}}}


@pytest.mark.slow
def test_pictures_of_seams_whose_names_could_be_mixed_up(tmp_path: Path) -> None:
    """`a-b` and `c` against `a` and `b-c`."""
    names = ("a", "a-b", "b-c", "c")
    for name in names:
        write_scene(make_scene(folder=name), tmp_path / name, REPORT)
    out = tmp_path / "map"
    aggregate([tmp_path / name for name in names], out, CONFIG)
    seams = json.loads((out / "map.json").read_text())["seams"]
    accepted = {(seam["a"], seam["b"]): seam.get("pictures", {}) for seam in seams if seam["accepted"]}
    assert {("a-b", "c"), ("a", "b-c")} <= accepted.keys()
    named = [picture for pictures in accepted.values() for picture in pictures.values()]
    assert [*accepted[("a-b", "c")]] == ["before", "after"]
    assert sorted(named) == sorted(f"pictures/{file.name}" for file in (out / "pictures").iterdir())
    assert len(named) == len(set(named)) == 2 * len(accepted)
    assert len(list((out / "seams").iterdir())) == len(seams), "each is kept for the next version"


def test_stages_tell_when_they_begin_end_and_are_reused(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_scene(make_scene(folder=name), tmp_path / name, REPORT)
    said: list[list[str]] = []
    for _ in range(2):
        said.append([])
        lines = StageLines(said[-1].append, lambda: 0.0)
        aggregate([tmp_path / "one", tmp_path / "two"], tmp_path / "map", CONFIG, progress=lines.update)
        lines.finish("done")
    stages = ["scenes", "association", "seams", "multi-scene-adjustment", "map-adjustment", "pictures", "export"]
    whats = [f"[00:00] {stage}: {what}" for stage in stages for what in ("begins", "done")]
    assert [line.split(",")[0] for line in said[0]] == whats
    reused = "[00:00] seams: reused from an earlier run"
    assert [line.split(",")[0] for line in said[1]] == [*whats[:4], reused, *whats[6:]]


def rough_scene(folder: Path, start_m: float, *, world: str = "site", sigma_m: float = 0.5) -> Path:
    """The example on a clock that begins at zero, with rough poses alone."""
    scene = make_scene(georeferenced=False)
    manifest = scene.drive.manifest
    poses = [
        RoughPose(
            timestamp_us=500_000 * u,
            world_from_rig=Pose(rotation_xyzw=(0.0, 0.0, 0.0, 1.0), translation_m=(start_m + 2.0 * u, 0.0, 0.0)),
        )
        for u in range(UNITS)
    ]
    rough = RoughTrajectory(poses=poses, common_world=world, sigma_translation_m=sigma_m)
    frames = [frame.model_copy(update={"timestamp_us": 500_000 * u}) for u, frame in enumerate(manifest.frames)]
    drive = Drive(Path("nowhere"), manifest.model_copy(update={"frames": frames, "rough_poses": rough}))
    write_scene(replace(scene, drive=drive), folder, REPORT)
    return folder


def test_drives_with_rough_poses_alone_and_the_same_names_of_frames(tmp_path: Path) -> None:
    """As of a recorder that counts from zero every time."""
    first, other = rough_scene(tmp_path / "first", 0.0), rough_scene(tmp_path / "other", 1.0)
    aggregate([first, other], tmp_path / "map", CONFIG)
    scenes = json.loads((tmp_path / "map" / "map.json").read_text())["scenes"]
    assert [scene["name"] for scene in scenes] == ["first", "other"]
    again = rough_scene(tmp_path / "again", 0.0, sigma_m=0.7)
    with pytest.raises(InputError, match="again and first are of the same drive") as raised:
        aggregate([first, again], tmp_path / "twice", CONFIG)
    assert raised.value.code == "same-drive"


def test_a_map_is_exported_with_a_sequence_for_each_scene(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_scene(make_scene(folder=name, moving=True), tmp_path / name, REPORT)
    aggregate([tmp_path / "one", tmp_path / "two"], tmp_path / "map", CONFIG)
    request = ExportRequest(folder=tmp_path / "map", out=tmp_path / "export", formats=["kitti", "geojson"], drives={})
    report = run_export(request, progress=lambda *_: None, cancel=lambda: False)
    assert report["source"] == {"name": "map", "kind": "map"}
    files = [file["path"] for file in report["formats"]["kitti"]["files"]]
    assert files == [f"kitti/{scene}/{name}.txt" for scene in ("one", "two") for name in KITTI_FILES]
    assert (tmp_path / "export" / "kitti" / "two" / "calib.txt").read_text().startswith("Tr_left: 1.000000000 ")
    positions = json.loads((tmp_path / "export" / "geojson" / "unit_positions.geojson").read_text())["features"]
    units = json.loads((tmp_path / "map" / "poses.json").read_text())["units"]
    assert [f["properties"]["scene"] for f in positions] == [u["scene"] for u in units if u["registered"]]


KITTI_FILES = ("calib", "frames", "poses", "times")
