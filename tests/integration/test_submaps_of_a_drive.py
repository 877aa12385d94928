"""A drive that is cut into sub-maps gives the scene that it gives in one piece."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig, OutputConfig, SubmapConfig
from mrasfm_engine.errors import StorageError
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.io.stage_store import content_sha256_of
from mrasfm_engine.pipeline import plan_submaps, reconstruct, reconstruct_submap
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.scene import ImageFeatures
from schemas.artifacts import PLAN_CHECKPOINTS, checkpoint_file, submap_checkpoint
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Variant, read_report, synth

Run = Callable[..., CommandResult]

UNITS = 15
CONFIG = EngineConfig(
    use_gnss=False, submaps=SubmapConfig(count=3, overlap_units=3), output=OutputConfig(pictures=False)
)
STAGES = ("features", "matches", "mapping")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    size = ("--width", 320, "--height", 180)
    out = tmp_path_factory.mktemp("cut") / "drive"
    return synth(out, *size, "--cameras", 2, "--units", UNITS, "--seed", 4, "--no-masks")


@pytest.fixture(scope="module")
def scene(drive: Path) -> Path:
    out = drive.parent / "scene"
    reconstruct(drive, out, CONFIG)
    return out


def names_of(scene: Path) -> set[str]:
    return {path.name for path in (scene / ".stages").iterdir()}


def positions_m(scene: Path) -> np.ndarray:
    units = json.loads((scene / "poses.json").read_text())["units"]
    return np.array([unit["world_from_rig"]["translation_m"] for unit in units])


def errors(mrasfm: Run, scene: Path, drive: Path) -> dict:  # type: ignore[type-arg]
    evaluated = mrasfm("evaluate", scene, "--truth", drive / "truth.tum", "--json")
    result: dict = json.loads(evaluated.out)  # type: ignore[type-arg]
    return result


@pytest.mark.slow
def test_the_scene_is_as_good_as_in_one_piece(drive: Path, scene: Path, tmp_path: Path, mrasfm: Run) -> None:
    assert mrasfm("reconstruct", drive, "--no-gnss", "--out", tmp_path / "one", *WITHOUT_PICTURES).code == 0
    cut, one = (errors(mrasfm, out, drive) for out in (scene, tmp_path / "one"))
    assert cut["registered_units"] == one["registered_units"] == UNITS
    assert 0 < cut["similarity"]["rmse_m"] < 1.2 * one["similarity"]["rmse_m"] + 1e-3
    assert 0 < cut["metric"]["rmse_m"] < 1.2 * one["metric"]["rmse_m"] + 0.02  # metres of way tell little of scale


def test_the_report_has_every_sub_map(drive: Path, scene: Path) -> None:
    report = read_report(scene)
    assert [part["spans"] for part in report["submaps"]] == [[[0, 6]], [[4, 10]], [[8, 14]]]
    for part in report["submaps"]:
        assert [stage["stage"] for stage in part["stages"]] == list(STAGES)
        assert part["stages"][2]["registered_units"] == 7
        assert part["stages"][2]["initial_units"][0] in range(part["spans"][0][0], part["spans"][0][1] + 1)
    assert report["by_stage"]["features"]["images"] == len(read_drive(drive).images)
    assert report["by_stage"]["features"]["keypoints"] > 0
    assert report["by_stage"]["matches"]["verified_pairs"] > 0
    assert {f"{stage}" for stage in report["by_stage"]} >= set(STAGES)


@pytest.mark.slow
def test_sub_maps_that_others_have_done_are_not_done_again(drive: Path, scene: Path, tmp_path: Path) -> None:
    """As workers do them: each has its own files alone, and what the plan left."""
    out, seen = tmp_path / "scene", list[tuple[str, int, int]]()
    contents = content_sha256_of(read_drive(drive), threads=1)
    planned = plan_submaps(drive, out, CONFIG, workers=3, content_sha256=contents)
    assert [(one.number, one.first_unit, one.last_unit) for one in planned] == [(1, 0, 6), (2, 4, 10), (3, 8, 14)]
    assert not any(one.is_finished for one in planned)
    assert names_of(out) == {checkpoint_file(name) for name in PLAN_CHECKPOINTS}
    plan = {name: (out / ".stages" / name).read_bytes() for name in names_of(out)}
    for one in planned:
        part, worker = tmp_path / f"drive {one.number}", tmp_path / f"worker {one.number}"
        (worker / ".stages").mkdir(parents=True)
        for name, data in plan.items():
            (worker / ".stages" / name).write_bytes(data)
        own = [image.file for image in read_drive(drive).images if one.first_unit <= image.unit <= one.last_unit]
        for file in ("drive.json", *own):
            (part / file).parent.mkdir(parents=True, exist_ok=True)
            (part / file).write_bytes((drive / file).read_bytes())
        reconstruct_submap(part, worker, CONFIG, one.number, content_sha256=contents)
        made = {checkpoint_file(submap_checkpoint(one.number, stage)) for stage in STAGES}
        assert names_of(worker) == made | set(plan)
        for name in made:
            (worker / ".stages" / name).rename(out / ".stages" / name)
    assert all(one.is_finished for one in plan_submaps(drive, out, CONFIG, workers=3, content_sha256=contents))
    reconstruct(drive, out, CONFIG, content_sha256=contents, progress=lambda *step: seen.append(step))
    for part in read_report(out)["submaps"]:
        assert all(stage["reused"] for stage in part["stages"])
    assert not [step for step in seen if step[0] == "features" and step[2] > 1]
    np.testing.assert_allclose(positions_m(out), positions_m(scene), atol=1e-6)


def test_a_sub_map_without_its_plan_is_not_done(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="plan of the drive's sub-maps"):
        reconstruct_submap(drive, tmp_path / "scene", CONFIG, 7)


@pytest.mark.slow
def test_images_that_two_machines_extracted_differently_are_matched_again(
    drive: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second sub-map's keypoints come in another order, as scores on another processor might put them."""
    out, extract = tmp_path / "scene", SiftExtractor.extract
    plan_submaps(drive, out, CONFIG, workers=3)
    with monkeypatch.context() as other:
        other.setattr(SiftExtractor, "extract", lambda *given: reversed_order(extract(*given)))
        reconstruct_submap(drive, out, CONFIG, 2)
    reconstruct(drive, out, CONFIG)
    matches = read_report(out)["by_stage"]["matches"]
    assert matches["images_with_unlike_keypoints"] == 2 * 2 * 3  # cameras, neighbours, shared units
    assert read_report(scene)["by_stage"]["matches"]["images_with_unlike_keypoints"] == 0
    np.testing.assert_allclose(positions_m(out), positions_m(scene), atol=0.01)


def reversed_order(found: ImageFeatures) -> ImageFeatures:
    scores = None if found.scores is None else found.scores[::-1].copy()
    return replace(
        found,
        xy_px=found.xy_px[::-1].copy(),
        descriptors=found.descriptors[::-1].copy(),
        colors=found.colors[::-1].copy(),
        classes=found.classes[::-1].copy(),
        scores=scores,
    )


@pytest.mark.slow
def test_processes_make_the_same_scene(drive: Path, scene: Path, tmp_path: Path, mrasfm: Run) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("use_gnss = false\n[submaps]\ncount = 3\noverlap_units = 3\nprocesses = 2\n")
    result = mrasfm("reconstruct", drive, "--config", settings, "--out", tmp_path / "scene")
    assert result.code == 0, result.err
    stages = [stage for part in read_report(tmp_path / "scene")["submaps"] for stage in part["stages"]]
    assert not any(stage["reused"] for stage in stages)
    assert min(stage["seconds"] for stage in stages) > 0.05
    np.testing.assert_allclose(positions_m(tmp_path / "scene"), positions_m(scene), atol=1e-5)


@pytest.mark.slow
def test_a_sub_map_that_sees_nothing_is_a_gap(drive: Path, variant_of: Callable[[Path], Variant]) -> None:
    """A tunnel of the length of the middle one; images across it link the ends, which share no unit."""
    variant = variant_of(drive)
    for unit, frame in enumerate(variant.document["frames"]):
        for image in frame["images"].values():
            if 4 <= unit <= 10:
                shape = cv2.imread(str(variant.root / image["file"])).shape
                suffix = Path(image["file"]).suffix
                variant.write(image["file"], cv2.imencode(suffix, np.full(shape, 90, np.uint8))[1].tobytes())
    variant.save()
    reconstruct(variant.root, variant.scene, CONFIG)
    report = read_report(variant.scene)
    middle = report["submaps"][1]["stages"][2]
    assert middle["components"] == []
    assert middle["reason"]
    (component,) = report["by_stage"]["mapping"]["components"]
    assert component["spans"] == [[0, 3], [11, 14]]
    assert [link["by"] for link in component["links"]] == ["images"]
    assert component["links"][0]["spans"] in ([[0, 3]], [[11, 14]])
    assert [missing["unit"] for missing in report["by_stage"]["mapping"]["units_not_registered"]] == list(range(4, 11))
    assert "units-without-pose" in {finding["code"] for finding in report["findings"]}
