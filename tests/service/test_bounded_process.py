"""Large documents are read one at a time, also by several API processes."""

from __future__ import annotations

import fcntl
import os
import sys
import threading
import time
from pathlib import Path

from service.bounded_process import LARGE_BYTES, run_on_document


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
