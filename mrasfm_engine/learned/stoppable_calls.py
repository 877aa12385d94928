"""Calls of onnxruntime that end when the work is no longer wanted.

A call of a large network takes minutes on a CPU, and one whose graph loops need not end. No thread can be stopped from
outside, and Python's wait for theirs before a program ends; but a runtime looks between two nodes of a graph whether it
shall go on.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mrasfm_engine.types import Cancel

POLL_S = 0.2


class StoppableCalls:
    """The calls that are under way; one thread looks for all of them, as long as there are any.

    Parameters
    ----------
    cancel
        Called in that thread.
    """

    def __init__(self, cancel: Cancel) -> None:
        self._cancel = cancel
        self._lock = threading.Lock()
        self._running: list[Any] = []
        self._is_watched = False

    @contextmanager
    def one(self, options: Any) -> Iterator[None]:
        """Let a call with these options, a `RunOptions` of its own, fail when the work is no longer wanted."""
        with self._lock:
            self._running.append(options)
            begins, self._is_watched = not self._is_watched, True
        if begins:
            threading.Thread(target=self._watch, name="stoppable-calls", daemon=True).start()
        try:
            yield
        finally:
            with self._lock:
                self._running.remove(options)

    def _watch(self) -> None:
        while True:
            time.sleep(POLL_S)
            is_cancelled = self._cancel()
            with self._lock:
                if not self._running:
                    self._is_watched = False
                    return
                for options in self._running if is_cancelled else ():
                    options.terminate = True
