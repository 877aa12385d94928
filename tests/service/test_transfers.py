"""Many objects brought at one time."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from service.storage.artifacts import ObjectMissingError
from service.storage.transfers import FETCHES, fetch_each


def test_all_are_brought_several_at_one_time(tmp_path: Path) -> None:
    together = threading.Barrier(FETCHES)

    def fetch(key: str, target: Path) -> None:
        together.wait(timeout=30)  # one after the other, nobody would come
        target.write_text(key, encoding="utf-8")

    wanted = [(f"key-{n}", tmp_path / f"folder-{n % 3}" / "deep" / f"{n}.png") for n in range(3 * FETCHES)]
    done = list[tuple[int, int]]()
    callers = set[int]()

    def progress(*counts: int) -> None:
        done.append((counts[0], counts[1]))
        callers.add(threading.get_ident())

    fetch_each(fetch, wanted, progress=progress)
    assert all(target.read_text(encoding="utf-8") == key for key, target in wanted)
    assert done == [(n, len(wanted)) for n in range(1, len(wanted) + 1)]
    assert callers == {threading.get_ident()}


def test_nothing_is_wanted() -> None:
    fetch_each(lambda key, target: pytest.fail("nothing was wanted"), [])


def test_the_first_that_fails_ends_it(tmp_path: Path) -> None:
    """None is under way when it raises: who called removes the folder."""
    begun, ended = list[str](), list[str]()

    def fetch(key: str, target: Path) -> None:
        begun.append(key)
        if key == "5":
            raise TimeoutError(key)
        time.sleep(0.05)
        ended.append(key)

    with pytest.raises(TimeoutError):
        fetch_each(fetch, [(str(n), tmp_path / str(n)) for n in range(200)])
    count = len(begun)
    assert sorted(begun) == sorted([*ended, "5"])
    assert count < 100
    time.sleep(0.1)
    assert len(begun) == count


def test_what_the_store_does_not_have_is_told(tmp_path: Path) -> None:
    def fetch(key: str, target: Path) -> None:
        if key in ("2", "7"):
            raise ObjectMissingError(key)
        target.write_text(key, encoding="utf-8")

    wanted = [(str(n), tmp_path / str(n)) for n in range(10)]
    missing = list[int]()
    fetch_each(fetch, wanted, on_missing=missing.append)
    assert sorted(missing) == [2, 7]
    assert sorted(path.name for path in tmp_path.iterdir()) == [str(n) for n in range(10) if n not in (2, 7)]
    with pytest.raises(ObjectMissingError):
        fetch_each(fetch, [(key, target.with_suffix(".again")) for key, target in wanted])
