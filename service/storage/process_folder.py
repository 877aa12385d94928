"""Folders that are in use by one process each, and are known as left behind once it has ended.

A process holds a lock on its folder, and the kernel ends the lock with the process, however that ends. So every process
that shares the folder above can tell one that is worked in from one that was left behind.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def process_folder(parent: Path, name: str) -> Iterator[Path]:
    """A folder for this process alone, which is gone after the block.

    Raises
    ------
    OSError
        Where it cannot be made, or was there already.
    """
    parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder = parent / name
    with _turn(parent):  # between the next two lines the folder looks left behind
        folder.mkdir(mode=0o700)
        lock = _lock(folder)
    assert lock is not None, "nobody else locks a folder that was just made"
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


@contextmanager
def own_folder(parent: Path, kind: str) -> Iterator[Path]:
    """A folder of this process under a name that no other has; what dead processes left beside it is removed."""
    sweep(parent)
    with process_folder(parent, f"{kind}-{os.getpid()}-{secrets.token_hex(4)}") as folder:
        yield folder


def sweep(parent: Path, left_behind: Callable[[Path], None] = lambda folder: None) -> None:
    """Remove the folders of processes that have ended.

    Parameters
    ----------
    left_behind
        Called with each, before it is removed.
    """
    if not parent.is_dir():
        return
    with _turn(parent):
        locks = {path: _lock(path) for path in parent.iterdir() if path.is_dir()}
    try:
        for folder, lock in locks.items():
            if lock is not None:
                left_behind(folder)
                shutil.rmtree(folder, ignore_errors=True)
    finally:
        for lock in locks.values():
            if lock is not None:
                os.close(lock)


@contextmanager
def _turn(parent: Path) -> Iterator[None]:
    descriptor = os.open(parent, os.O_RDONLY)
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
