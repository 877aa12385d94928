"""Fields that a document does not have are answered with the one that is meant."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.config import read_config
from mrasfm_engine.errors import InputError
from schemas.api.aggregations import AggregationRequest
from schemas.api.jobs import ReconstructionRequest
from schemas.drive import DriveManifest
from schemas.misspelt import similar_name
from schemas.parsing import DocumentError, parse_document
from tests.helpers.tiny_drive import tiny_drive


@pytest.mark.parametrize("model", [ReconstructionRequest, AggregationRequest])
@pytest.mark.parametrize(
    ("settings", "answer"),
    [
        ({"max_keypoint": 512}, "settings.max_keypoint: is not a field of this document; did you mean max_keypoints?"),
        ({"Use_GNSS": False}, "settings.Use_GNSS: is not a field of this document; did you mean use_gnss?"),
        (
            {"featurs": {}},
            "settings.featurs: is not a field of this document; allowed here: use_gnss, max_keypoints, max_side_px, ",
        ),
    ],
)
def test_settings_of_a_request(model: type[Any], settings: dict[str, object], answer: str) -> None:
    body = {**model.model_config["json_schema_extra"]["examples"][0], "settings": settings}
    with pytest.raises(DocumentError) as refused:
        parse_document(json.dumps(body).encode(), model)
    assert str(refused.value).startswith(answer)
    assert len(refused.value.problems) == 1


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("[features]\nmax_keypoint = 512", "features.max_keypoint: is not a setting; did you mean max_keypoints?"),
        ("[featurs]\nmax_keypoints = 512", "featurs: is not a setting; did you mean features?"),
        ("max_keypoints = 512", "max_keypoints: is not a setting; did you mean features.max_keypoints?"),
        ("[matching]\nmax_side_px = 512", "matching.max_side_px: is not a setting; did you mean features.max_side_px?"),
        (
            "[features]\nthreads = 2",
            "features.threads: is not a setting; did you mean threads at the top of the document?",
        ),
        ("[semantics]\ngravity = 9.81", "semantics.gravity: is not a setting; allowed here: model\n"),
    ],
)
def test_settings_of_a_file(tmp_path: Path, text: str, answer: str) -> None:
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(InputError) as refused:
        read_config(tmp_path / "settings.toml")
    assert f"settings.toml: {answer}" in str(refused.value)


@pytest.mark.parametrize(
    ("spoil", "answer"),
    [
        (lambda d: d["rig"]["cameras"][1].update(param=[1]), "rig.cameras.1.param: is not .*; did you mean params"),
        (lambda d: d["frames"][0]["images"]["front"].update(fille="x"), "frames.0.images.front.fille: .* mean file"),
        (lambda d: d.update(frame=[]), "frame: .*; did you mean frames"),
    ],
)
def test_fields_of_a_manifest(spoil: Callable[[dict[str, Any]], None], answer: str) -> None:
    document = json.loads(tiny_drive().raw)
    spoil(document)
    with pytest.raises(DocumentError, match=answer):
        parse_document(json.dumps(document).encode(), DriveManifest)


def test_a_name_of_any_length_is_compared_in_little_time() -> None:
    assert similar_name("max_keypoint" + "s" * 10_000_000, ["max_keypoints", "seed"]) is None
    assert similar_name("", ["seed"]) is None
    assert similar_name("seeed", []) is None
