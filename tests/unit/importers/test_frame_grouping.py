from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.importers.frame_grouping import grouped_by_time

PERIOD_US = 100_000


def times(count: int, *, late_us: int = 0, period_us: int = PERIOD_US) -> np.ndarray:
    return np.arange(count, dtype=np.int64) * period_us + late_us


@pytest.mark.parametrize("late_us", [0, 31_000, 49_000, 60_000, -50_000])
def test_cameras_with_constant_delays(late_us: int) -> None:
    given = {"a": times(10, late_us=50_000), "b": times(10, late_us=50_000 + late_us), "c": times(10, late_us=62_000)}
    frames = grouped_by_time(given)
    inner = [f for f in frames if len(f) == 3]
    assert len(inner) >= 9
    # A camera late by over half a period may be taken with the frame after: always the same.
    assert {f["b"] - f["a"] for f in inner} <= ({0} if abs(late_us) < 50_000 else {0, -1, 1})
    assert len({f["b"] - f["a"] for f in inner}) == 1
    assert sum(len(f) for f in frames) == 30


def test_lost_images_and_jitter() -> None:
    rng = np.random.default_rng(5)
    given = {name: times(200, late_us=late) for name, late in (("a", 0), ("b", 20_000), ("c", 45_000))}
    kept = {name: rng.random(200) > 0.1 for name in given}
    noisy = {name: (t + rng.integers(-3000, 3000, 200))[kept[name]] for name, t in given.items()}
    frames = grouped_by_time(noisy)
    number = {name: np.flatnonzero(kept[name]) for name in given}
    for frame in frames:
        assert len({int(number[name][i]) for name, i in frame.items()}) == 1
    assert sum(len(frame) for frame in frames) == sum(len(t) for t in noisy.values())
    assert len(frames) == int(np.any(list(kept.values()), axis=0).sum())


def test_cameras_of_different_rates() -> None:
    frames = grouped_by_time({"slow": times(5), "fast": times(15, period_us=33_333)})
    assert sum(len(frame) == 2 for frame in frames) == 5
    assert len(frames) == 15


def test_one_image() -> None:
    assert grouped_by_time({"a": times(1), "b": times(1)}) == [{"a": 0, "b": 0}]


def test_cameras_that_are_not_there_at_one_time_make_no_frame() -> None:
    """One ends before the other begins: the time between them is no delay."""
    frames = grouped_by_time({"early": times(20), "late": times(10, late_us=20 * PERIOD_US + 30_000)})
    assert [len(frame) for frame in frames] == [1] * 30
    assert [len(frame) for frame in grouped_by_time({"a": times(20), "b": times(1, late_us=5_000_000)})] == [1] * 21
    frames = grouped_by_time({"a": times(20), "b": times(8, late_us=15 * PERIOD_US + 40_000)})
    assert [frame for frame in frames if len(frame) == 2] == [{"a": 15 + i, "b": i} for i in range(5)]


def test_one_image_of_each_camera_is_one_frame_where_it_is_of_one_time() -> None:
    assert len(grouped_by_time({"a": times(1), "b": times(1, late_us=3_000_000)})) == 2
