"""What an aggregation refuses before it touches any file."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.pipeline import reconstruct
from tests.helpers.export_example import make_scene

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
