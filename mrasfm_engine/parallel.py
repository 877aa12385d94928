"""Short passes over many items in several threads: compiled kernels release the interpreter's lock.

Work must not start such passes of its own: the threads that it would wait for are those that wait for it.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from mrasfm_engine.types import Ints

Item = TypeVar("Item")
Result = TypeVar("Result")

FEW = 512  # items that one thread has done before others have heard of them
RANGES = 4  # a thread: items take unequal times, and starting on a range takes some, too
BATCH = 128  # items whose results are held at one time
# Items that wait for a thread, or for the result of an earlier one, by thread: one that takes several times the usual
# time does not leave the other threads without work.
IN_FLIGHT = 4


def in_ranges(threads: int, count: int, work: Callable[[int, int], None]) -> None:
    """Run `work(lo, hi)` over `count` items in so many threads; each takes the next range when it is done with one."""
    if threads <= 1 or count < FEW:
        work(0, count)
        return
    ranges = iter(list(pairwise(even_bounds(count, threads * RANGES).tolist())))  # a list's iterator is thread-safe

    def run() -> None:
        for lo, hi in ranges:
            work(lo, hi)

    _together([run] * threads)


def even_bounds(count: int, parts: int) -> Ints:
    """Bounds (parts + 1,) of even parts of `count` items."""
    return np.arange(parts + 1, dtype=np.int64) * count // parts


def in_parts(bounds: Ints, work: Callable[[int, int, int], None]) -> None:
    """Run `work(lo, hi, part)` between any two neighbouring bounds, each in a thread."""
    parts = len(bounds) - 1
    if parts == 1:
        work(int(bounds[0]), int(bounds[1]), 0)
        return
    _together([partial(work, lo, hi, part) for part, (lo, hi) in enumerate(pairwise(bounds.tolist()))])


def mapped(threads: int, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results of `work` in the items' order; only those of some are held at one time."""
    if threads <= 1:
        yield from map(work, items)
        return
    for begin in range(0, len(items), BATCH):
        yield from _pool(threads).map(work, items[begin : begin + BATCH])


def in_order(threads: int, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result]:
    """Results of long work in the items' order, in threads of its own; `IN_FLIGHT` items of a thread are under way.

    Closing the iterator waits for the work that has begun, and does no more.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) >= IN_FLIGHT * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _together(tasks: Sequence[Callable[[], None]]) -> None:
    """Run tasks at the same time, the last in the caller's thread: it need not wait for others to wake up."""
    *others, own = tasks
    futures = [_pool(len(others)).submit(task) for task in others]
    try:
        own()
    finally:
        for future in futures:
            future.exception()
    for future in futures:
        future.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that wait for the next of many short passes: starting them anew would take as long as one."""
    return ThreadPoolExecutor(threads, thread_name_prefix="parallel")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
