"""Images that are those before them once more."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.io.repeated_images import comparison_of_contents, repeated_images, runs_of_same_images
from mrasfm_engine.io.stage_store import content_sha256_of
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive


@pytest.fixture
def drive(drive_document: dict[str, Any], write_drive: Callable[[dict[str, Any]], Path]) -> Drive:
    """Units 2 and 3 of the left camera, and unit 4 of the right one, are what their camera saw in the unit before."""
    root = write_drive(drive_document)
    for name, unit in (("left", 2), ("left", 3), ("right", 4)):
        (root / f"images/{name}/{unit:06d}.png").write_bytes((root / f"images/{name}/{unit - 1:06d}.png").read_bytes())
    return read_drive(root)


COPIES = ["images/left/000002.png", "images/left/000003.png", "images/right/000004.png"]


def copies_of(drive: Drive, content_sha256: Mapping[str, str] | None) -> list[list[str]]:
    runs = runs_of_same_images(drive.images, comparison_of_contents(drive, content_sha256))
    return [[image.file for image in run[1:]] for run in runs]


def test_they_are_those_of_their_own_camera_before(drive: Drive) -> None:
    known = content_sha256_of(drive, threads=1)
    assert repeated_images(drive, known) == set(COPIES)
    assert copies_of(drive, known) == copies_of(drive, None) == [COPIES[:2], COPIES[2:]]


def test_a_file_that_is_not_there_is_no_copy(drive: Drive) -> None:
    (drive.root / "images/left/000002.png").unlink()
    assert copies_of(drive, None) == [COPIES[2:]]


def test_files_of_known_contents_are_not_read(drive: Drive) -> None:
    """Of a drive that is larger than the disk each would have to come."""
    known = content_sha256_of(drive, threads=1)
    shutil.rmtree(drive.root)
    assert copies_of(drive, known) == [COPIES[:2], COPIES[2:]]
