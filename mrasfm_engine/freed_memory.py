"""Memory that was freed, and that the C library keeps for later."""

from __future__ import annotations

import ctypes
import sys

# Of glibc; others give memory back by themselves. Looked up once.
_malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def return_freed_memory() -> None:
    """Give freed memory back to the system.

    Images and their pyramids, in many threads, leave hundreds of megabytes in pieces that are free but not at the end
    of their heaps; the next stage allocates other sizes and takes new ones.
    """
    if _malloc_trim is not None:
        _malloc_trim(0)
