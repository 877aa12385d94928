"""Output of a child process: a bounded file for whoever looks into its folder, and the tail for the outcome."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from worker.log_paths import LogPaths

FILE_BYTES = 4_000_000
TAIL_BYTES = 16_000  # of an abort: the Python stacks of all threads, and below them those of C++

# Databases refuse NUL in text, and a terminal should not be steered by a log.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


class ChildOutput:
    """Takes output in pieces. The file keeps the beginning, the tail the end.

    Parameters
    ----------
    path
        Of the file, in the folder of an attempt; where it cannot be written there is only the tail.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._left = FILE_BYTES
        self._tail = b""
        self._paths = LogPaths([path.parent, path.parent.parent])

    def add(self, data: bytes) -> None:
        """Take in a piece."""
        self._tail = (self._tail + data)[-TAIL_BYTES:]
        kept = data[: self._left]
        if kept:
            self._left -= len(kept)
            with suppress(OSError), self._path.open("ab") as file:
                file.write(kept)

    def tail(self) -> str:
        """The last lines, of at most TAIL_BYTES of UTF-8. Users see them: paths of this machine are shortened."""
        text = _CONTROL.sub("", self._tail.decode("utf-8", "ignore").replace("\r\n", "\n"))
        # Where the beginning is cut off, so is the first line.
        whole = text.partition("\n")[2] if len(self._tail) == TAIL_BYTES and "\n" in text else text
        return self._paths.shorten(whole)
