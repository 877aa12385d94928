"""Results that are kept for a while: as many as the work at hand goes back to, and no more with more items."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class BoundedCache(Generic[Value]):
    """Results of `make` by number, each made once as long as it is kept; any thread may ask.

    Those used least recently go first. The bound is in bytes: of so many results as large as the largest one. Smaller
    ones leave room for more.

    Attributes
    ----------
    peak_bytes
        Most that was ever kept.
    """

    def __init__(self, make: Callable[[int], Value], *, largest: int) -> None:
        self._make = make
        self._largest = largest
        self._lock = Lock()
        self._results: OrderedDict[int, Future[Value]] = OrderedDict()
        self._bytes: dict[int, int] = {}
        self._total_bytes = self._largest_bytes = self.peak_bytes = 0

    def __call__(self, item: int) -> Value:
        """The result for an item."""
        with self._lock:
            known = self._results.get(item)
            if known is None:
                result = self._results[item] = Future[Value]()
            else:
                self._results.move_to_end(item)
        if known is not None:
            return known.result()
        try:
            value = self._make(item)
        except BaseException as error:
            with self._lock:
                del self._results[item]
            result.set_exception(error)
            raise
        with self._lock:
            self._keep(item, bytes_of(value))
        result.set_result(value)
        return value

    def _keep(self, item: int, size: int) -> None:
        self._bytes[item] = size
        self._total_bytes += size
        self._largest_bytes = max(self._largest_bytes, size)
        while self._total_bytes > self._largest * self._largest_bytes and len(self._bytes) > 1:
            oldest = next(other for other in self._results if other in self._bytes)  # others are being made
            del self._results[oldest]
            self._total_bytes -= self._bytes.pop(oldest)
        self.peak_bytes = max(self.peak_bytes, self._total_bytes)


def bytes_of(value: Any) -> int:
    """Bytes of the arrays in a value: an array, several of them, or an object that has some or says its `nbytes`."""
    if isinstance(size := getattr(value, "nbytes", None), int):
        return size
    if isinstance(value, list | tuple):
        return sum(map(bytes_of, value))
    return sum(map(bytes_of, vars(value).values())) if hasattr(value, "__dict__") else 0
