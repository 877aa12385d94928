"""The log file of a supervised process: bounded, and readable for the lines that tell why it ended."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

MAX_BYTES = 20_000_000
KEPT = 3  # older files beside the current one
TAIL_LINES = 8
TAIL_BYTES = 8192


class ChildLog:
    """One file that a child appends to, over all of its lives.

    A log is worth less than what it tells of: that it cannot be written, moved or read is no error. Disks fill up, and
    people tidy folders.

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
        """Open the file for a new life of the child; the caller closes the descriptor.

        Raises
        ------
        OSError
            Where this process can open no files at all.
        """
        self.rotate_if_large()
        try:
            self.path.parent.mkdir(mode=0o700, exist_ok=True)
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError:
            descriptor = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
        self._life_starts_at = os.fstat(descriptor).st_size
        return descriptor

    def rotate_if_large(self) -> None:
        """Move the content on once it is large; where there is no room to keep it, it goes.

        It is copied and the file emptied, because a running child keeps it open. Lines that the child writes
        between the two are lost; that is the price of a bound that holds however long the child runs.
        """
        with suppress(OSError):
            if self.path.stat().st_size <= self._max_bytes:
                return
            self._keep()
            os.truncate(self.path, 0)
            self._life_starts_at = 0

    def tail(self) -> list[str]:
        """The last lines of the current life."""
        with suppress(OSError), self.path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self._life_starts_at, size - TAIL_BYTES))
            return file.read().decode("utf-8", "replace").splitlines()[-TAIL_LINES:]
        return []

    def _keep(self) -> None:
        for number in range(KEPT, 1, -1):
            with suppress(OSError):
                self._older(number - 1).replace(self._older(number))
        try:
            shutil.copy(self.path, self._older(1))
        except OSError:
            with suppress(OSError):
                self._older(1).unlink()  # half of it

    def _older(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}")
