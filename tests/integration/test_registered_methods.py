"""An extractor or matcher is added by one module and its line in `schemas.methods`; nothing else knows its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from mrasfm_engine.config import EngineConfig
from schemas.api.jobs import ReconstructionSettings
from schemas.methods import EXTRACTORS, MATCHERS
from tests.integration.conftest import CommandResult, Variant, read_report


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRACTORS, "orb", "tests.helpers.orb_extractor")
    monkeypatch.setitem(MATCHERS, "cross-check", "tests.helpers.cross_check_matcher")


@pytest.mark.usefixtures("registered")
def test_settings_and_requests_take_its_name() -> None:
    config = EngineConfig.model_validate({"features": {"extractor": "orb"}, "matching": {"matcher": "cross-check"}})
    assert (config.features.extractor, config.matching.matcher) == ("orb", "cross-check")
    asked = ReconstructionSettings(extractor="orb", matcher="cross-check")
    assert (asked.extractor, asked.matcher) == ("orb", "cross-check")


def test_a_name_without_a_line_is_refused() -> None:
    with pytest.raises(ValidationError, match="Input should be 'sift', 'superpoint', 'aliked' or 'xfeat'"):
        EngineConfig.model_validate({"features": {"extractor": "orb"}})
    with pytest.raises(ValidationError, match="'nearest', 'superglue', 'lightglue' or 'lighterglue'"):
        ReconstructionSettings(matcher="cross-check")


@pytest.mark.slow
@pytest.mark.usefixtures("registered")
def test_a_drive_is_reconstructed_with_it(
    mrasfm: Callable[..., CommandResult], variant: Variant, tmp_path: Path
) -> None:
    config = tmp_path / "config.toml"
    features = '[features]\nextractor = "orb"\nmax_keypoints = 1000\n'  # the matcher is slow
    config.write_text(f'{features}[matching]\nmatcher = "cross-check"\n[output]\npictures = false\n')
    drive, scene = variant.keep(cameras=["front", "left", "right"], units=6).save().root, tmp_path / "scene"
    ran = mrasfm("reconstruct", drive, "--out", scene, "--config", config)
    assert ran.code == 0, ran.err
    report = read_report(scene)
    assert report["settings"]["features"]["extractor"] == "orb"
    errors = json.loads(mrasfm("evaluate", scene, "--truth", drive / "truth.tum", "--json").out)
    assert errors["registered_units"] == 6
    assert 0 < errors["metric"]["rmse_m"] < 0.5
    assert 0 < errors["similarity"]["rmse_m"] < 0.1
