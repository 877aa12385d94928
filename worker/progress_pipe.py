"""Progress on its way from the child process to its supervisor: one JSON line each."""

from __future__ import annotations

import json
import os
import time
from typing import NamedTuple

INTERVAL_S = 0.2


class StageReport(NamedTuple):
    """Progress of a stage, in the engine's own count."""

    stage: str
    done: int
    total: int


class ProgressWriter:
    """Writes reports into the pipe: the first and last of every stage, and others a few times a second."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._stage = ""
        self._next_s = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report, if it is time.

        Raises
        ------
        BrokenPipeError
            Where nobody reads any more.
        """
        now_s = time.monotonic()
        if stage == self._stage and done != total and now_s < self._next_s:
            return
        self._stage, self._next_s = stage, now_s + INTERVAL_S
        # Far shorter than PIPE_BUF: written whole or not at all.
        os.write(self._descriptor, json.dumps([stage, int(done), int(total)]).encode() + b"\n")


class ProgressReader:
    """Puts reports together from the pieces that arrive."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[StageReport]:
        """The reports that are complete now."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [StageReport(*json.loads(line)) for line in lines]
