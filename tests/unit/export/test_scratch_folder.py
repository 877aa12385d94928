"""Scratch folders of runs that live stay; those of killed runs go."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mrasfm_engine.export.publishing import LEFTOVER_AGE_S, LOCK, SCRATCH_PREFIX, scratch_folder


def make_old(folder: Path) -> None:
    os.utime(folder, (0.0, 0.0))


def test_a_scratch_folder_is_empty_and_goes_with_its_run(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as scratch:
        assert not list(scratch.iterdir())
    with pytest.raises(ZeroDivisionError), scratch_folder(tmp_path) as scratch:
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_one_in_use_stays_however_old_it_is(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as first:
        make_old(first.parent)
        with scratch_folder(tmp_path):
            assert first.is_dir()
        assert first.is_dir()


def test_those_of_killed_runs_go_at_once(tmp_path: Path) -> None:
    killed, starting, old = (tmp_path / f"{SCRATCH_PREFIX}{name}" for name in ("killed", "starting", "old"))
    for folder in (killed, starting, old):
        folder.mkdir()
    (killed / LOCK).touch()
    make_old(old)
    with scratch_folder(tmp_path):
        assert not killed.exists()
        assert starting.exists()  # it may be about to lock
        assert not old.exists()
    assert LEFTOVER_AGE_S > 60
