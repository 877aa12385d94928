from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from mrasfm_engine.parallel import FEW, even_bounds, in_order, in_parts, in_ranges, mapped


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, FEW - 1, FEW, 5 * FEW + 3])
def test_ranges_cover_every_item_once(threads: int, count: int) -> None:
    seen = np.zeros(count, dtype=np.int64)

    def work(lo: int, hi: int) -> None:
        seen[lo:hi] += 1

    in_ranges(threads, count, work)
    assert (seen == 1).all()


@pytest.mark.parametrize("parts", [1, 2, 5])
def test_parts_lie_between_their_bounds(parts: int) -> None:
    bounds, seen = even_bounds(100, parts), np.full(100, -1)

    def work(lo: int, hi: int, part: int) -> None:
        seen[lo:hi] = part

    in_parts(bounds, work)
    np.testing.assert_array_equal(seen, np.repeat(np.arange(parts), np.diff(bounds)))


def test_the_caller_works_beside_the_others() -> None:
    meeting, threads = threading.Barrier(2, timeout=20.0), set()

    def work(lo: int, hi: int, part: int) -> None:
        threads.add(threading.get_ident())
        meeting.wait()  # both parts are done at the same time

    in_parts(np.array([0, 1, 2]), work)
    assert len(threads) == 2
    assert threading.get_ident() in threads


@pytest.mark.parametrize("failing", [0, 1])
def test_an_error_of_any_part_comes_when_all_have_ended(failing: int) -> None:
    ended = []

    def work(lo: int, hi: int, part: int) -> None:
        if part == failing:
            raise ValueError("no such part")
        time.sleep(0.05)
        ended.append(part)

    with pytest.raises(ValueError, match="no such part"):
        in_parts(np.array([0, 1, 2]), work)
    assert ended == [1 - failing]


def test_results_come_in_the_order_of_the_items() -> None:
    items = list(range(300))
    assert list(mapped(2, lambda i: i * i, items)) == [i * i for i in items]
    assert list(in_order(2, lambda i: i * i, items)) == [i * i for i in items]
