"""Folders of processes: in use by a live one, or left behind by a dead one."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from service.storage.process_folder import process_folder, sweep
from tests.helpers.service_world import wait_until

HOLDER = """
import sys, time
from pathlib import Path
from service.storage.process_folder import process_folder
with process_folder(Path(sys.argv[1]), sys.argv[2]) as folder:
    (folder / "file").touch()
    time.sleep(1000)
"""


def test_folder_is_gone_afterwards(tmp_path: Path) -> None:
    with process_folder(tmp_path / "scratch", "job_a.1") as folder:
        (folder / "file").touch()
        assert (folder.stat().st_mode & 0o777) == 0o700
    assert list((tmp_path / "scratch").iterdir()) == []


def test_name_that_is_taken(tmp_path: Path) -> None:
    with process_folder(tmp_path, "job_a.1"), pytest.raises(FileExistsError), process_folder(tmp_path, "job_a.1"):
        pytest.fail("two attempts in one folder")


def test_only_what_dead_processes_left_is_swept(tmp_path: Path) -> None:
    holders = [subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path), name]) for name in ("live.1", "dead.1")]
    try:
        for name in ("live.1", "dead.1"):
            wait_until((tmp_path / name / "file").exists, f"the folder {name}")
        left: list[Path] = []
        sweep(tmp_path, left.append)
        assert left == []
        holders[1].kill()
        holders[1].wait()
        sweep(tmp_path, left.append)
        assert left == [tmp_path / "dead.1"]
        assert [path.name for path in tmp_path.iterdir()] == ["live.1"]
    finally:
        for holder in holders:
            holder.kill()
            holder.wait()


def test_no_sweep_takes_a_folder_that_is_just_made(tmp_path: Path) -> None:
    """Two workers of one machine: one sweeps again and again while the other begins attempts."""
    ended = threading.Event()
    left: list[Path] = []
    sweeps = 0

    def sweep_on() -> None:
        nonlocal sweeps
        while not ended.is_set():
            sweep(tmp_path, left.append)
            sweeps += 1

    sweeper = threading.Thread(target=sweep_on)
    sweeper.start()
    try:
        for i in range(300):
            with process_folder(tmp_path, f"job.{i}") as folder:
                (folder / "file").write_text("kept", encoding="utf-8")
                assert (folder / "file").read_text(encoding="utf-8") == "kept"
    finally:
        ended.set()
        sweeper.join()
    assert left == []
    assert sweeps > 10


def test_no_scratch_folder_yet(tmp_path: Path) -> None:
    sweep(tmp_path / "nowhere", lambda name: pytest.fail(name))
