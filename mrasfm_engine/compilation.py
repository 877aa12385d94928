"""Compilation of the engine's inner loops for the machine at hand.

numba compiles a function when it is first called and keeps the result (in `NUMBA_CACHE_DIR`, or beside the sources), so
only the first run on a machine, and the first after an update, takes one to two minutes longer. That shall be seen,
and not pass for slow mapping.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from numba.core import event


@dataclass
class Compilation:
    """Record of the functions compiled while watched; functions from the cache do not count."""

    functions: int = 0
    seconds: float = 0.0
    _depth: int = field(default=0, repr=False)
    _since_s: float = field(default=0.0, repr=False)


class _Watch(event.Listener):  # type: ignore[misc]
    """numba reports its begin and end; functions that a function calls are compiled within."""

    def __init__(self, result: Compilation, begins: Callable[[], None]) -> None:
        self._result, self._begins, self._lock = result, begins, threading.Lock()

    def on_start(self, event: event.Event) -> None:
        with self._lock:
            first = self._result.functions == 0 and self._result._depth == 0
            if self._result._depth == 0:
                self._result._since_s = time.perf_counter()
            self._result._depth += 1
        if first:
            self._begins()

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._result.functions += 1
            self._result._depth -= 1
            if self._result._depth == 0:
                self._result.seconds += time.perf_counter() - self._result._since_s


@contextmanager
def watched_compilation(begins: Callable[[], None] = lambda: None) -> Iterator[Compilation]:
    """Watch what is compiled meanwhile; `begins` is called before the first function is."""
    result = Compilation()
    with event.install_listener("numba:compile", _Watch(result, begins)):
        yield result
