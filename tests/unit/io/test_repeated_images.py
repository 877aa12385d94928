"""Images that are those before them once more."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.io.repeated_images import repeated_images
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive


@pytest.fixture
def drive(drive_document: dict[str, Any], write_drive: Callable[[dict[str, Any]], Path]) -> Drive:
    """Units 2 and 3 of the left camera, and unit 4 of the right one, are what their camera saw in the unit before."""
    root = write_drive(drive_document)
    for name, unit in (("left", 2), ("left", 3), ("right", 4)):
        (root / f"images/{name}/{unit:06d}.png").write_bytes((root / f"images/{name}/{unit - 1:06d}.png").read_bytes())
    return read_drive(root)


def repeated_of(drive: Drive) -> list[str]:
    is_repeated = repeated_images(drive)
    return [image.file for image, copy in zip(drive.images, is_repeated, strict=True) if copy]


COPIES = ["images/left/000002.png", "images/left/000003.png", "images/right/000004.png"]


def test_they_are_those_of_their_own_camera_before(drive: Drive) -> None:
    assert repeated_of(drive) == COPIES


@pytest.mark.parametrize("first", range(1, 5))
def test_a_part_of_a_drive_knows_what_came_before_it(drive: Drive, first: int) -> None:
    units = np.arange(len(drive.timestamps_us))
    part = drive.restricted_to(units >= first - 1).restricted_to(units[first - 1 :] >= first)
    assert repeated_of(part) == [file for file in COPIES if int(file[-10:-4]) >= first]


def test_an_image_that_is_not_there_is_no_copy(drive: Drive) -> None:
    (drive.root / "images/left/000002.png").unlink()
    assert repeated_of(drive) == ["images/right/000004.png"]
