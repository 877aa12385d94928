"""Routes and settings that make no sense."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrasfm_engine.benchmark.scaling import measure_growth
from mrasfm_engine.benchmark.side_by_side import Settings
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError


def test_routes_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--units 2"):
        measure_growth("stereo", [100, 2], 0, tmp_path, Settings(config=EngineConfig()))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"baselines": ["colmap-global", "openmvg"]}, "no mapper 'openmvg'"),
        ({"repeat": 0}, "map 0 times"),
        ({"timeout_s": 0.0}, "within 0 s"),
        ({"timeout_s": float("nan")}, "within nan s"),
    ],
)
def test_settings_that_make_no_sense_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Settings(config=EngineConfig(), **options)
