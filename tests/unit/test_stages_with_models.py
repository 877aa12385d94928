"""Models in a run: refused before any work, part of what a stage depends on, named in the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.io.images import mask_of_png
from mrasfm_engine.learned.model_folder import ModelFolder
from mrasfm_engine.learned.onnx_file import sha256_of
from mrasfm_engine.pipeline import reconstruct
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.visualization.birds_eye import read_view
from tests.helpers import learned_graphs
from tests.helpers.export_example import make_scene

CAR, BUILDING = 13, 2  # Cityscapes
WriteDrive = Callable[[dict[str, Any]], Path]


def run_of(drive: Path, models: Path, **sections: dict[str, Any]) -> stages.Run:
    config = EngineConfig.model_validate({"models": {"folder": models}, **sections})
    store = stages.store_of(drive.parent / "scene")
    return stages.Run(read_drive(drive), config, store, lambda stage, done, total: None, lambda: False)


def add(models: Path, name: str, data: bytes) -> None:
    given = models.parent / "given.onnx"
    given.write_bytes(data)
    ModelFolder(models).add(given, name)


def test_what_does_not_go_together_is_refused_before_any_work(
    drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path
) -> None:
    drive, steps = write_drive(drive_document), []
    config = EngineConfig.model_validate({"matching": {"matcher": "lightglue"}})
    with pytest.raises(InputError, match="lightglue"):
        reconstruct(drive, tmp_path / "scene", config, progress=lambda *step: steps.append(step))
    assert steps == []
    assert not (tmp_path / "scene").exists()


def test_features_depend_on_the_models_and_matches_too(
    drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path
) -> None:
    drive, models = write_drive(drive_document), tmp_path / "models"
    sections = {"features": {"extractor": "superpoint"}, "matching": {"matcher": "superglue"}}
    add(models, "superpoint", learned_graphs.superpoint())
    add(models, "superglue", learned_graphs.superglue())
    first = run_of(drive, models, **sections)
    again = run_of(drive, models, **sections)
    plain = run_of(drive, models)
    assert first.feature_settings == again.feature_settings
    assert first.feature_settings != plain.feature_settings
    add(models, "superpoint", learned_graphs.superpoint(threshold=0.3))
    changed = run_of(drive, models, **sections)
    assert changed.feature_settings != first.feature_settings
    assert changed.components.fingerprint_of("matcher") == first.components.fingerprint_of("matcher")


def test_masks_made_by_a_model_are_kept_with_the_features_and_shown(
    drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path
) -> None:
    drive_document["frames"][0]["images"]["left"]["mask"] = "masks/left/000000.png"
    drive, models = write_drive(drive_document), tmp_path / "models"
    image = np.full((32, 48, 3), 40, np.uint8)
    image[:, 24:] = 220
    for file in ("left/000000.png", "right/000000.png"):
        assert cv2.imwrite(str(drive / "images" / file), image)
    add(models, "bright", learned_graphs.segmenter())
    runs = [run_of(drive, models, semantics={"model": "bright"}) for _ in range(2)]
    first, again = (stages.features(run) for run in runs)
    assert [run.report["stages"][0]["reused"] for run in runs] == [False, True]
    for run, features in zip(runs, (first, again), strict=True):
        assert run.report["stages"][0]["images_with_mask"] == {"given": 1, "made_by_model": 9}
        assert features[0].made_mask is None
        mask = features[1].made_mask
        assert mask is not None
        assert 50 < len(mask) < image[..., 0].size
        np.testing.assert_array_equal(mask_of_png(mask), np.where(image[..., 0] > 128, CAR, BUILDING))
    seen = replace(make_scene(), drive=runs[1].drive, features=again)
    rgb, usable = read_view(seen, 1)
    np.testing.assert_array_equal(rgb, image)
    assert usable is not None
    np.testing.assert_array_equal(usable, np.broadcast_to(np.arange(48) < 23, (32, 48)))  # a pixel less: the margin
    by_given = read_view(seen, 0)[1]
    assert by_given is not None
    assert by_given.all()  # road everywhere
    plain = run_of(drive, models)
    features = stages.features(plain)
    assert plain.report["stages"][0]["images_with_mask"] == {"given": 1, "made_by_model": 0}
    assert read_view(replace(seen, features=features), 1)[1] is None


def test_learned_features_come_back_from_the_store_as_they_were(
    drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path
) -> None:
    drive, models = write_drive(drive_document), tmp_path / "models"
    add(models, "superpoint", learned_graphs.superpoint())
    runs = [run_of(drive, models, features={"extractor": "superpoint"}) for _ in range(2)]
    made, kept = (stages.features(run) for run in runs)
    assert [run.report["stages"][0]["reused"] for run in runs] == [False, True]
    for a, b in zip(made, kept, strict=True):
        assert len(a.xy_px) > 5
        assert a.descriptors.dtype == b.descriptors.dtype == "float32"
        assert (a.descriptors == b.descriptors).all()
        assert a.scores is not None
        assert b.scores is not None
        assert (a.scores == b.scores).all()
    stages.load_models(runs[0])
    described = runs[0].report["models"]["extractor"]
    assert described["sha256"] == sha256_of(learned_graphs.superpoint())
    assert described["licence"] == "Magic Leap, research only"
    assert described["provider"].endswith("ExecutionProvider")
