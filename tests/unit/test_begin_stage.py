"""The beginning of a reconstruction."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.stages._begin import held_findings


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
