"""The log of a supervised process."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from service.standalone.child_log import KEPT, TAIL_LINES, ChildLog


def write(descriptor: int, *lines: str) -> None:
    os.write(descriptor, "".join(line + "\n" for line in lines).encode())


def test_the_tail_is_of_this_life_and_short(tmp_path: Path) -> None:
    log = ChildLog(tmp_path / "api.log")
    first = log.open_for_child()
    write(first, "an earlier life")
    os.close(first)
    second = log.open_for_child()
    assert log.tail() == []
    write(second, "one", "two")
    assert log.tail() == ["one", "two"]
    write(second, *("x" * 5000 for _ in range(10)))
    assert len(log.tail()) == 2  # by bytes
    write(second, *(str(number) for number in range(100)))
    assert log.tail() == [str(number) for number in range(100 - TAIL_LINES, 100)]
    os.close(second)


def test_what_is_not_text_does_no_harm(tmp_path: Path) -> None:
    log = ChildLog(tmp_path / "api.log")
    descriptor = log.open_for_child()
    os.write(descriptor, b"\xff\xfe broken\n")
    os.close(descriptor)
    assert log.tail() == ["\ufffd\ufffd broken"]


def test_it_stays_bounded_while_the_child_writes(tmp_path: Path) -> None:
    log = ChildLog(tmp_path / "api.log", max_bytes=100)
    descriptor = log.open_for_child()
    for number in range(KEPT + 3):
        write(descriptor, f"{number} " + "x" * 150)
        log.rotate_if_large()
    write(descriptor, "the newest")
    os.close(descriptor)
    assert log.path.read_text(encoding="utf-8") == "the newest\n"
    assert log.tail() == ["the newest"]
    kept = [(tmp_path / f"api.log.{number}").read_text(encoding="utf-8")[0] for number in range(1, KEPT + 1)]
    assert kept == [str(KEPT + 2 - number) for number in range(KEPT)]
    assert len(list(tmp_path.iterdir())) == KEPT + 1
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.iterdir())


def test_a_log_that_was_removed_has_no_tail_and_comes_back(tmp_path: Path) -> None:
    log = ChildLog(tmp_path / "logs" / "api.log")
    os.close(log.open_for_child())
    shutil.rmtree(tmp_path / "logs")
    log.rotate_if_large()
    assert log.tail() == []
    descriptor = log.open_for_child()
    write(descriptor, "here again")
    os.close(descriptor)
    assert log.tail() == ["here again"]


def test_what_cannot_be_opened_is_not_written(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    log = ChildLog(tmp_path / "logs" / "api.log")
    descriptor = log.open_for_child()
    write(descriptor, "nobody reads this")
    os.close(descriptor)
    assert log.tail() == []


def test_on_a_full_disk_a_large_log_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_room(source: Path, target: Path) -> None:
        target.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    log = ChildLog(tmp_path / "api.log", max_bytes=100)
    descriptor = log.open_for_child()
    write(descriptor, "x" * 150)
    monkeypatch.setattr("service.standalone.child_log.shutil.copy", no_room)
    log.rotate_if_large()
    write(descriptor, "the newest")
    os.close(descriptor)
    assert log.tail() == ["the newest"]
    assert [path.name for path in tmp_path.iterdir()] == ["api.log"]
