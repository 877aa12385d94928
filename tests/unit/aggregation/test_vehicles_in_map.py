"""A map says what drives of one vehicle share, and which camera was knocked between them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.aggregation import calibrations
from mrasfm_engine.aggregation.pipeline import aggregate
from tests.helpers.small_scenes import configured, drive_along, make_street

WAYS = {"a": np.arange(0.0, 12.0, 2.0), "b": np.arange(4.0, 16.0, 2.0), "c": np.arange(8.0, 20.0, 2.0)}
CAMERA = 2


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three drives of one vehicle; a camera was knocked before the last one."""
    folder, street = tmp_path_factory.mktemp("vehicles"), make_street(length_m=22.0, points=800)
    return {
        name: drive_along(
            street,
            folder / name,
            way,
            cameras_off_deg=0.02,
            vehicle="van-7",
            rig_seed=60,
            knocked_deg={CAMERA: 1.0} if name == "c" else None,
            seed=60 + k,
        ).folder
        for k, (name, way) in enumerate(WAYS.items())
    }


def made(folders: dict[str, Path], out: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    config = configured()
    config = config.model_copy(update={"output": config.output.model_copy(update={"pictures": False})})
    report = aggregate(folders, out, config)
    return json.loads((out / "map.json").read_text()), report


@pytest.mark.slow
def test_the_drive_is_named_whose_camera_was_knocked(folders: dict[str, Path], tmp_path: Path) -> None:
    document, report = made(folders, tmp_path / "map")
    (vehicle,) = document["vehicles"]
    assert (vehicle["vehicle"], vehicle["scenes"]) == ("van-7", ["a", "b", "c"])
    assert 0.009 < vehicle["deviation_deg"] < 0.05
    camera = list(json.loads((folders["c"] / "calibration.json").read_text())["cameras"])[CAMERA]
    (knocked,) = vehicle["knocked"]
    assert (knocked["camera"], knocked["scenes"]) == (camera, ["c"])
    assert knocked["sigmas"] > 4
    (finding,) = report["findings"]
    assert (finding["code"], finding["severity"]) == ("camera-contradicts-vehicle", "warning")
    assert f"camera {camera} of vehicle van-7 was knocked or exchanged, in c, the other drives agree" in finding["what"]
    assert json.loads((tmp_path / "map" / "calibration" / "c.json").read_text())["vehicle"] == "van-7"


def test_a_map_too_large_to_share_calibrations_says_so(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrations, "MAX_COUPLINGS", 10)
    document, report = made({name: folders[name] for name in ("a", "b")}, tmp_path / "map")
    assert document["vehicles"][0]["learning"] == []
    (finding,) = report["findings"]
    assert finding["code"] == "calibrations-not-shared"
    assert "no drive learns from others of its vehicle, and calibrations stay" in finding["what"]


def test_of_two_drives_either_may_be_the_odd_one(folders: dict[str, Path], tmp_path: Path) -> None:
    document, report = made({name: folders[name] for name in "bc"}, tmp_path / "map")
    assert document["vehicles"][0]["knocked"][0]["scenes"] == ["b", "c"]
    (finding,) = report["findings"]
    assert "in b or in c: nothing says in which" in finding["what"]


def test_sound_drives_have_no_finding(folders: dict[str, Path], tmp_path: Path) -> None:
    document, report = made({name: folders[name] for name in "ab"}, tmp_path / "map")
    assert document["vehicles"][0]["knocked"] == report["findings"] == []
