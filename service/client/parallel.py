"""Doing the same with many files, several at a time, and saying how far it is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Report = Callable[[str, int, int], None]  # stage, bytes done, bytes in total


def no_report(stage: str, done_bytes: int, total_bytes: int) -> None:
    """For callers who want no progress."""


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


def in_parallel(
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int, stop: Callable[[], None]
) -> list[Result]:
    """The results of `work` for all items, in their order.

    The first error ends it: what has not begun is not begun, and the error is raised. `stop` is called where the whole
    is interrupted, and must end the work that is under way soon.
    """
    with ThreadPoolExecutor(max_workers=threads, thread_name_prefix="mrasfm-client") as pool:
        futures = [pool.submit(work, item) for item in items]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            failed = next((future for future in done if future.exception() is not None), None)
            if failed is not None:
                failed.result()
            return [future.result() for future in futures]
        except BaseException as error:
            if not isinstance(error, Exception):
                stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
