"""The extraction's findings about images that it left out, and the error where it left all out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.submaps import Span
from tests.helpers.damaged_images import cut

WriteDrive = Callable[[dict[str, Any]], Path]


@pytest.fixture
def drive(drive_document: dict[str, Any], write_drive: WriteDrive) -> Path:
    return write_drive(drive_document)


def run_of(drive: Path) -> stages.Run:
    store = stages.store_of(drive.parent / "scene")
    return stages.Run(read_drive(drive), EngineConfig(), store, lambda stage, done, total: None, lambda: False)


def truncate(drive: Path, pattern: str) -> list[str]:
    files = sorted((drive / "images").glob(pattern))
    for file in files:
        file.write_bytes(cut(file.read_bytes()))
    return [file.relative_to(drive).as_posix() for file in files]


def test_all_left_out_is_an_error_that_is_not_kept(drive: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Also where the sample that was looked at before had others; and it comes again where the stage is reused."""
    files = truncate(drive, "*/*.png")
    for _ in range(2):
        with pytest.raises(
            InputError, match=f"all {len(files)} images of the drive are truncated: {files[0]}"
        ) as caught:
            stages.features(run_of(drive))
        assert caught.value.code == "no-complete-image"
        assert "Copy the drive's images again" in caught.value.remedy
    capfd.readouterr()  # the decoder's own complaints


def test_the_calibrations_check_does_without_images(drive: Path, capfd: pytest.CaptureFixture[str]) -> None:
    truncate(drive, "*/00000[0-4].png")
    stages.probe(run_of(drive))
    capfd.readouterr()


def test_repeated_images_are_those_of_the_whole_drive(drive: Path) -> None:
    """Also where the unit that is repeated is left out, and for a sub-map that begins after it."""
    images = drive / "images/left"
    (images / "000002.png").write_bytes((images / "000001.png").read_bytes())
    run = run_of(drive)
    units = np.arange(len(run.drive.timestamps_us))
    run.whole_drive, run.drive = run.drive, run.drive.restricted_to(units != 1)
    assert run.repeated == {"images/left/000002.png"}
    part = stages.SubmapRun(run, Span(number=2, first=1, last=len(units) - 2))
    assert part.run.repeated is run.repeated


def test_findings_of_all_images_take_the_place_of_the_samples(drive: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (file,) = truncate(drive, "left/000002.png")
    # The images of this drive have no texture, but nothing else is asked of it here.
    run = run_of(drive)
    other = {"severity": "warning", "code": "other", "what": "something else", "remedy": "None."}
    sampled = {**other, "code": "truncated-images", "what": f"1 of 8 images looked at are truncated: {file}"}
    run.report["findings"] = [other, sampled]
    found = stages.features(run)
    assert [f.left_out is not None for f in found].count(True) == 1
    first, second = run.report["findings"]
    assert first == other
    assert second["what"] == f"1 of {len(found)} images are truncated and left out: {file}"
    capfd.readouterr()
