"""Large documents are read one at a time, also by several API processes."""

from __future__ import annotations

import fcntl
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from service.api.manifests.bounded_process import LARGE_BYTES, TooCostlyError, run_on_document


def test_large_documents_wait_for_those_of_other_processes(tmp_path: Path) -> None:
    done: list[int] = []

    def run(size_bytes: int) -> None:
        command = (sys.executable, "-c", "pass")
        run_on_document(command, size_bytes=size_bytes, folder=tmp_path, timeout_s=60)
        done.append(size_bytes)

    other = os.open(tmp_path, os.O_RDONLY)  # locks are of whoever opened, as if by another process
    fcntl.flock(other, fcntl.LOCK_EX)
    waiting = threading.Thread(target=run, args=(LARGE_BYTES + 1,))
    waiting.start()
    run(1)
    time.sleep(0.2)
    assert done == [1]
    os.close(other)
    waiting.join()
    assert done == [1, LARGE_BYTES + 1]


KILLED = """
import os, signal, sys
from pathlib import Path
runs = Path("runs")
count = int(runs.read_text()) if runs.exists() else 0
runs.write_text(str(count + 1))
if count < int(sys.argv[1]):
    os.kill(os.getpid(), getattr(signal, sys.argv[2]))
print(sys.stdin.read())
"""


def run_killed(folder: Path, *, times: int, by: str) -> tuple[int, bytes]:
    command = (sys.executable, "-c", KILLED, str(times), by)
    done = run_on_document(command, size_bytes=1, folder=folder, timeout_s=60, given=b"document")
    return done.returncode, done.stdout


def test_a_program_that_was_killed_runs_once_more(tmp_path: Path) -> None:
    """A kill says nothing of the document: neither once nor twice is it too costly."""
    assert run_killed(tmp_path, times=1, by="SIGKILL") == (0, b"document\n")
    assert (tmp_path / "runs").read_text() == "2"
    (tmp_path / "runs").unlink()
    assert run_killed(tmp_path, times=9, by="SIGKILL") == (-9, b"")
    assert (tmp_path / "runs").read_text() == "2"


@pytest.mark.parametrize("by", ["SIGABRT", "SIGSEGV"])
def test_a_program_whose_allocator_gave_up_does_not(tmp_path: Path, by: str) -> None:
    with pytest.raises(TooCostlyError):
        run_killed(tmp_path, times=1, by=by)
    assert (tmp_path / "runs").read_text() == "1"
