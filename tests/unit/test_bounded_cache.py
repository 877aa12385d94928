from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier

import numpy as np
import pytest

from mrasfm_engine.bounded_cache import BoundedCache, bytes_of


def test_what_was_used_last_is_kept_and_the_rest_made_anew() -> None:
    made: list[int] = []

    def make(item: int) -> np.ndarray:
        made.append(item)
        return np.full(100, item, np.uint8)

    cache = BoundedCache(make, largest=3)
    for item in (0, 1, 2, 0, 3, 0, 2, 1):
        assert cache(item)[0] == item
    assert made == [0, 1, 2, 3, 1]
    assert cache.peak_bytes == 300


def test_small_results_leave_room_for_more() -> None:
    made: list[int] = []

    def make(item: int) -> np.ndarray:
        made.append(item)
        return np.zeros(100 if item == 0 else 10, np.uint8)

    cache = BoundedCache(make, largest=2)
    for item in [*range(11), *range(11)]:
        cache(item)
    assert made == list(range(11))


def test_many_threads_make_a_result_once() -> None:
    barrier, made = Barrier(8), []

    def make(item: int) -> int:
        made.append(item)
        return item

    cache = BoundedCache(make, largest=1)

    def ask(_: int) -> int:
        barrier.wait()
        return cache(5)

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, range(8))) == [5] * 8
    assert made == [5]


def test_what_failed_is_tried_again() -> None:
    tries = iter([ValueError("not yet"), None])

    def make(item: int) -> int:
        if (error := next(tries)) is not None:
            raise error
        return item

    cache = BoundedCache(make, largest=1)
    with pytest.raises(ValueError, match="not yet"):
        cache(1)
    assert cache(1) == 1


def test_arrays_are_counted_wherever_they_are() -> None:
    @dataclass
    class Two:
        first: np.ndarray
        others: list[np.ndarray]

    assert bytes_of(np.zeros(3)) == 24
    assert bytes_of(Two(np.zeros(3), [np.zeros(1), np.zeros(2, np.uint8)])) == 34
    assert bytes_of("a word") == 0
