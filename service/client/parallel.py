"""Doing the same with many files, several at a time, and saying how far it is."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Report = Callable[[str, int, int], None]  # stage, bytes done, bytes in total
_GRACE_S = 1.0


def no_report(stage: str, done_bytes: int, total_bytes: int) -> None:
    """Report nothing, for callers who want no progress."""


class Meter:
    """Counts bytes of several threads."""

    def __init__(self, report: Report, stage: str, total_bytes: int) -> None:
        self._lock = threading.Lock()
        self._report, self._stage, self._total_bytes = report, stage, total_bytes
        self.done_bytes = 0
        self.add(0)

    def add(self, some_bytes: int) -> None:
        """Report so many bytes more; fewer, where a file is sent again from its beginning."""
        with self._lock:
            self.done_bytes += some_bytes
            self._report(self._stage, self.done_bytes, self._total_bytes)


class FileMeter:
    """Counts the bytes of one file in a meter of many."""

    def __init__(self, meter: Meter) -> None:
        self._meter = meter
        self.done_bytes = 0

    def set(self, done_bytes: int) -> None:
        """Report so many bytes of the file; fewer than before, where it begins again."""
        self._meter.add(done_bytes - self.done_bytes)
        self.done_bytes = done_bytes


def in_parallel(
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int, stop: Callable[[], None]
) -> list[Result]:
    """The results of `work` for all items, in their order.

    The first error ends it: what has not begun is not begun, what is under way is finished, and the error is raised.
    `stop` is called where the whole is interrupted, and must end the work that is under way soon.
    """
    tasks = [(item, Future[Result]()) for item in items]
    waiting = deque(tasks)

    def serve() -> None:
        while True:
            try:
                item, future = waiting.popleft()
            except IndexError:
                return
            try:
                future.set_result(work(item))
            except BaseException as error:
                future.set_exception(error)

    # Not the pool of concurrent.futures: the interpreter waits for its threads at the end, and one that asks a name
    # server, or waits for a connection to be made, cannot be told to end.
    count = min(threads, len(tasks))
    pool = [threading.Thread(target=serve, name=f"mrasfm-client-{i}", daemon=True) for i in range(count)]
    try:
        for thread in pool:
            thread.start()
        done, _ = wait([future for _, future in tasks], return_when=FIRST_EXCEPTION)
        waiting.clear()
        for thread in pool:
            thread.join()
        failed = next((future for future in done if future.exception() is not None), None)
        if failed is not None:
            failed.result()
        return [future.result() for _, future in tasks]
    except BaseException as error:
        if not isinstance(error, Exception):
            waiting.clear()
            stop()
            end_s = time.monotonic() + _GRACE_S
            for thread in pool:
                if thread.is_alive():
                    thread.join(max(0.0, end_s - time.monotonic()))
        raise
