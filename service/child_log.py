"""The log file of a supervised process: bounded, and readable for the lines that tell why it ended."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

MAX_BYTES = 20_000_000
KEPT = 3  # older files beside the current one
TAIL_LINES = 8
TAIL_BYTES = 8192


class ChildLog:
    """One file that a child appends to, over all of its lives.

    Parameters
    ----------
    path
        The file; older ones are `path.1`, `path.2` and so on.
    max_bytes
        Beyond this the file is moved on.
    """

    def __init__(self, path: Path, *, max_bytes: int = MAX_BYTES) -> None:
        self.path = path
        self._max_bytes = max_bytes
        self._life_starts_at = 0

    def open_for_child(self) -> int:
        """Open the file for a new life of the child; the caller closes the descriptor."""
        self.rotate_if_large()
        descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._life_starts_at = os.fstat(descriptor).st_size
        return descriptor

    def rotate_if_large(self) -> None:
        """Move the content on once it is large.

        It is copied and the file emptied, because a running child keeps it open. Lines that the child writes
        between the two are lost; that is the price of a bound that holds however long the child runs.
        """
        if not self.path.exists() or self.path.stat().st_size <= self._max_bytes:
            return
        for number in range(KEPT, 1, -1):
            younger = self._older(number - 1)
            if younger.exists():
                younger.replace(self._older(number))
        shutil.copy(self.path, self._older(1))
        os.truncate(self.path, 0)
        self._life_starts_at = 0

    def tail(self) -> list[str]:
        """The last lines of the current life."""
        with self.path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self._life_starts_at, size - TAIL_BYTES))
            return file.read().decode("utf-8", "replace").splitlines()[-TAIL_LINES:]

    def _older(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}")
