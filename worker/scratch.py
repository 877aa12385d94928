"""Folders that attempts work in, each in use by one process.

A process holds a lock on the folder of its attempt, and the kernel ends the lock with the process, however that ends.
So every worker that shares the scratch folder can tell a folder that is worked in from one that was left behind, and
an attempt whose process was killed from one that is silent.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def attempt_folder(scratch: Path, name: str) -> Iterator[Path]:
    """A folder for this process alone, which is gone after the block.

    Raises
    ------
    OSError
        Where it cannot be made, or was there already.
    """
    scratch.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder = scratch / name
    with _turn(scratch):  # between the next two lines the folder looks left behind
        folder.mkdir(mode=0o700)
        lock = _lock(folder)
    assert lock is not None, "nobody else locks a folder that was just made"
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def sweep(scratch: Path, left_behind: Callable[[str], None]) -> None:
    """Remove the folders of attempts whose process has ended.

    Parameters
    ----------
    left_behind
        Called with the name of each, before it is removed.
    """
    if not scratch.is_dir():
        return
    with _turn(scratch):
        locks = {path: _lock(path) for path in scratch.iterdir() if path.is_dir()}
    try:
        for folder, lock in locks.items():
            if lock is not None:
                left_behind(folder.name)
                shutil.rmtree(folder, ignore_errors=True)
    finally:
        for lock in locks.values():
            if lock is not None:
                os.close(lock)


@contextmanager
def _turn(scratch: Path) -> Iterator[None]:
    descriptor = os.open(scratch, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _lock(folder: Path) -> int | None:
    """The descriptor that holds the lock, or None where somebody else has it or the folder is gone."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), os.stat(folder)):
                return descriptor
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)
    return None
