"""The beginning of a reconstruction."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.stages import _begin
from mrasfm_engine.stages._begin import PROBE_UNITS, held_findings, probe


def track(held: list[int]) -> GnssTrack:
    is_held = np.isin(np.arange(20), held)
    return GnssTrack(
        timestamps_us=1_000_000 + 100_000 * np.arange(20),
        position_m=np.zeros((20, 3)),
        sigma_m=np.ones((20, 3)),
        good=~is_held,
        held=is_held,
    )


def test_positions_that_are_held_are_a_finding_with_the_longest_time() -> None:
    (finding,) = held_findings(track([3, 8, 9, 10, 11, 15, 16]))
    assert finding.code == "gnss-held"
    assert "2 times, for up to 0.5 s after 1700000 us" in finding.what
    (finding,) = held_findings(track([17, 18, 19]))
    assert "once, for up to 0.3 s after 2600000 us" in finding.what


def test_a_slow_receiver_that_is_logged_often_is_none() -> None:
    assert held_findings(track([])) == []
    assert held_findings(track([k for k in range(20) if k % 5])) == []


@pytest.mark.parametrize(
    ("units", "against", "refused", "looked_at"),
    [
        (40, {0}, False, [0, 20]),  # beside a vehicle that has just begun to move, others do
        (40, {0, 20}, True, [0, 20]),
        (40, set(), False, [0]),
        (2 * PROBE_UNITS - 2, {0}, True, [0]),  # the middle has the same units
    ],
)
def test_what_speaks_against_the_calibration_has_to_do_so_in_the_middle_of_the_drive_as_well(
    units: int, against: set[int], refused: bool, looked_at: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    forgotten: list[Any] = []

    def look(run: Any, first_unit: int) -> None:
        looked.append(first_unit)
        if first_unit in against:
            raise InputError("the wrong way round", remedy="Turn it.", code="calibration-inverted")

    monkeypatch.setattr(_begin, "_probe", look)
    run: Any = SimpleNamespace(
        drive=SimpleNamespace(cameras=[0, 1], manifest=SimpleNamespace(frames=range(units))),
        store=SimpleNamespace(has=lambda name, key: False, forget=forgotten.append),
        next_key=lambda stage, settings: "",
        feature_settings={},
    )
    if refused:
        with pytest.raises(InputError):
            probe(run)
    else:
        probe(run)
    assert looked == looked_at
    assert bool(forgotten) == refused
