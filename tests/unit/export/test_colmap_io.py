"""COLMAP's reading and writing of models gives the same in a process of its own."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pycolmap
import pytest

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export import colmap, colmap_io, comparisons
from mrasfm_engine.export.text_model import write_text_model
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import make_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture
def folder(scene: Scene, tmp_path: Path) -> Path:
    colmap.write_model(scene, tmp_path)
    (tmp_path / "text").mkdir()
    return tmp_path


@pytest.fixture
def nothing_is_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap_io, "SMALL_BYTES", 0)


def faults(scene: Scene, found: colmap_io.ModelRead) -> list[str]:
    return [row.difference for row in comparisons.model(scene, found) if not row.agrees]


def test_a_large_model_is_read_and_written_as_a_small_one_is(
    scene: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = write_text_model(folder, folder / "text")
    assert (faults(scene, small.binary), small.fault) == ([], "")
    texts = {name: (folder / "text" / name).read_bytes() for name in small.digests}
    monkeypatch.setattr(colmap_io, "SMALL_BYTES", 0)
    monkeypatch.setattr(pycolmap, "Reconstruction", None)  # this process must not need it
    for name in texts:
        (folder / "text" / name).unlink()
    large = write_text_model(folder, folder / "text")
    assert (faults(scene, large.binary), large.fault) == ([], "")
    assert large.digests == small.digests
    assert {name: (folder / "text" / name).read_bytes() for name in texts} == texts
    found = colmap_io.read_binary(folder)
    assert faults(scene, found) == []
    assert len(found.points) == len(scene.points_m) > 0


@pytest.mark.usefixtures("nothing_is_small")
def test_a_model_that_colmap_refuses_is_refused_in_its_words(folder: Path) -> None:
    path = folder / "images.bin"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises((ValueError, RuntimeError), match=r"\S"):
        colmap_io.read_binary(folder)


@pytest.mark.usefixtures("nothing_is_small")
def test_a_process_that_is_killed_is_an_error_that_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap_io, "_read_binary", killed)
    with pytest.raises(MrasfmError, match="killed by SIGKILL, maybe because memory ran out"):
        colmap_io.read_binary(folder)


def killed(folder: Path) -> colmap_io.ModelRead:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


@pytest.mark.parametrize("name", colmap_io.BINARY_FILES)
def test_a_file_without_content_is_no_model(folder: Path, name: str) -> None:
    (folder / name).write_bytes(b"")
    with pytest.raises(ValueError, match=f"{name} is empty"):
        colmap_io.read_binary(folder)
