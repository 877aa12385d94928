"""Standing units in a run: left out before the extraction, found again, and numbered as in the drive."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import StorageError
from mrasfm_engine.matching.pair_matching import NO_PRIOR
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.stages._standing import keep_nothing_left_out
from schemas.artifacts import Stage
from tests.unit.matching.test_standing import stop_px, view, write


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    return write(tmp_path / "drive", 11, lambda unit, camera: view(camera, stop_px(unit)))


def run_of(drive: Drive, scene: Path, contents: dict[str, str] | None = None, **mapping: float) -> stages.Run:
    config = EngineConfig.model_validate({"threads": 1, "mapping": mapping})
    return stages.Run(drive, config, stages.store_of(scene), lambda *_: None, lambda: False, contents)


def test_the_run_goes_on_with_the_other_units(drive: Drive, tmp_path: Path) -> None:
    whole, run = (run_of(drive, tmp_path / "scene") for _ in range(2))
    stages.leave_out_standing(run, NO_PRIOR)
    assert run.whole_drive is drive
    assert [frame.source_frame for frame in run.drive.manifest.frames] == [0, 1, 2, 7, 8, 9, 10]
    assert run.next_key(Stage.FEATURES, "settings") != whole.next_key(Stage.FEATURES, "settings")


def test_a_drive_without_a_stop_and_a_setting_of_zero_change_nothing(drive: Drive, tmp_path: Path) -> None:
    moving = Drive(
        drive.root, drive.manifest.model_copy(update={"frames": [drive.manifest.frames[k] for k in (0, 1, 2, 8, 9)]})
    )
    for run in (run_of(drive, tmp_path / "zero", keyframe_motion_px=0.0), run_of(moving, tmp_path / "scene")):
        before = run.drive
        assert stages.leave_out_standing(run, NO_PRIOR) is NO_PRIOR
        assert run.drive is before
        assert not run.key
        assert not (tmp_path / "scene").exists()
        assert not (tmp_path / "zero").exists()


def test_a_planned_run_looks_at_no_image(drive: Drive, tmp_path: Path) -> None:
    """Not even where the search left out nothing: a worker with some of the images would find something else."""
    moving = Drive(
        drive.root, drive.manifest.model_copy(update={"frames": [drive.manifest.frames[k] for k in (0, 1, 2, 8, 9)]})
    )
    contents = dict.fromkeys((image.file for image in moving.images), "0" * 64)
    plan = run_of(moving, tmp_path / "scene", contents)
    stages.leave_out_standing(plan, NO_PRIOR)
    assert not (tmp_path / "scene").exists()
    keep_nothing_left_out(plan)
    shutil.rmtree(moving.root)
    for scene in ("scene", "elsewhere"):
        run = run_of(moving, tmp_path / scene, contents)
        run.is_planned = True
        if scene == "scene":
            assert stages.leave_out_standing(run, NO_PRIOR) is NO_PRIOR
        else:
            with pytest.raises(StorageError, match="plan"):
                stages.leave_out_standing(run, NO_PRIOR)


def test_a_second_run_reads_no_image(drive: Drive, tmp_path: Path) -> None:
    contents = {image.file: "0" * 64 for image in drive.images}
    first, again, changed = (
        run_of(drive, tmp_path / "scene", known)
        for known in (contents, contents, {**contents, drive.images[4].file: "1" * 64})
    )
    stages.leave_out_standing(first, NO_PRIOR)
    shutil.rmtree(drive.root)
    stages.leave_out_standing(again, NO_PRIOR)
    assert again.key == first.key
    assert [f.source_frame for f in again.drive.manifest.frames] == [
        f.source_frame for f in first.drive.manifest.frames
    ]
    stages.leave_out_standing(changed, NO_PRIOR)
    assert changed.whole_drive is None, "of other images nothing is known, and here there are none"


def test_reports_name_units_of_the_whole_drive() -> None:
    unit_of = np.array([0, 1, 7, 9])
    given: dict[str, Any] = {
        "initial_units": [1, 3],
        "units_not_registered": [{"unit": 2, "reason": "few points"}],
        "registered_units": 3,
        "nested": {"images_occluded": [{"unit": 0, "share": 0.5}]},
        "none": None,
    }
    assert stages.in_units(given, unit_of) == {
        "initial_units": [1, 9],
        "units_not_registered": [{"unit": 7, "reason": "few points"}],
        "registered_units": 3,
        "nested": {"images_occluded": [{"unit": 0, "share": 0.5}]},
        "none": None,
    }
    assert stages.in_units({"initial_units": None}, unit_of) == {"initial_units": None}
