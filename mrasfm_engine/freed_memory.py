"""Memory that was freed and that the C library keeps for later, and objects that are never freed."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# Of glibc; others give memory back by themselves. Looked up once.
_malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def return_freed_memory() -> None:
    """Give freed memory back to the system.

    Images and their pyramids, in many threads, leave hundreds of megabytes in pieces that are free but not at the end
    of their heaps; the next stage allocates other sizes and takes new ones.
    """
    if _malloc_trim is not None:
        _malloc_trim(0)


@contextmanager
def loading() -> Iterator[None]:
    """Look for no garbage while modules load, nor later among what they have made, which stays.

    The interpreter would look every few hundred objects of some hundred thousand: an eighth of the time of the start.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
