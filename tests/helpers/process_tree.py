"""Processes that a test started, by what they run."""

from __future__ import annotations

from contextlib import suppress

import psutil


def children_of(pid: int, word: str) -> list[psutil.Process]:
    """Live children of a process whose command lines contain a word; zombies have none any more."""
    found = []
    for child in psutil.Process(pid).children():
        with suppress(psutil.NoSuchProcess):
            if word in " ".join(child.cmdline()):
                found.append(child)
    return found
