"""Programs that read documents from outside, each in a process of its own.

A monstrous document can take down nothing but the process that reads it, and the memory that it took is given back.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

LARGE_BYTES = 2_000_000  # beyond, one document is read at a time

# Of the environment a program gets what it runs with; the rest may hold the API's secrets.
_KEPT = frozenset({"PATH", "HOME", "USER", "LANG", "TZ", "LD_LIBRARY_PATH", "VIRTUAL_ENV"})
_KEPT_PREFIXES = ("LC_", "PYTHON", "PROJ_", "XDG_")
# How a process ends whose allocator is refused memory. A SIGKILL comes from outside and says nothing of the document.
_OUT_OF_MEMORY = frozenset({-signal.SIGABRT, -signal.SIGSEGV})


class TooCostlyError(Exception):
    """The program was refused memory, or took too long."""


def run_on_document(
    command: Sequence[str],
    *,
    size_bytes: int,
    folder: Path,
    timeout_s: float,
    given: bytes = b"",
) -> subprocess.CompletedProcess[bytes]:
    """The ended program. It bounds its memory itself; large documents wait for each other.

    A program that was killed is run once more.

    Parameters
    ----------
    size_bytes
        Of the document.
    folder
        Where it runs; the API's processes that share it take turns.
    given
        Its standard input.

    Raises
    ------
    TooCostlyError
        Where it took too much memory or time.
    OSError
        Where it cannot be started.
    """
    kept = {name: value for name, value in os.environ.items() if name in _KEPT or name.startswith(_KEPT_PREFIXES)}
    with _turn(folder) if size_bytes > LARGE_BYTES else nullcontext():
        done = _run(command, folder=folder, environment=kept, timeout_s=timeout_s, given=given)
        if done.returncode == -signal.SIGKILL:
            done = _run(command, folder=folder, environment=kept, timeout_s=timeout_s, given=given)
    if done.returncode in _OUT_OF_MEMORY or b"MemoryError" in done.stderr:
        raise TooCostlyError
    return done


def _run(
    command: Sequence[str], *, folder: Path, environment: Mapping[str, str], timeout_s: float, given: bytes
) -> subprocess.CompletedProcess[bytes]:
    try:
        return subprocess.run(
            command, cwd=folder, env=environment, input=given, capture_output=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise TooCostlyError from None


@contextmanager
def _turn(folder: Path) -> Iterator[None]:
    """Turn of one process at a time: a lock of the folder, which ends with its holder."""
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def end_of_log(done: subprocess.CompletedProcess[bytes]) -> str:
    """The last that an ended program said."""
    return done.stderr[-2000:].decode(errors="replace")
