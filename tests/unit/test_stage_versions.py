"""A finished stage is found again under its version, and not under the bytes of the source."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mrasfm_engine
import schemas
from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.preflight.drive_reader import read_drive
from schemas.artifacts import CHECKPOINTED, Stage

IN_ORDER = [stage for stage in Stage if stage in CHECKPOINTED]
KEY = """
import sys
from pathlib import Path
from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.preflight.drive_reader import read_drive
from schemas.artifacts import Stage
drive = read_drive(Path(sys.argv[1]))
run = stages.Run(drive, EngineConfig(threads=1), stages.store_of(drive.root), print, lambda: False)
print(stages.__file__, run.next_key(Stage.FEATURES, run.feature_settings))
"""


def key_in(packages: Path, drive: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(packages)}
    command = [sys.executable, "-c", KEY, str(drive)]
    printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, cwd=packages).stdout
    where, key = printed.split()
    assert Path(where).is_relative_to(packages)
    return key


@pytest.mark.slow
def test_a_comment_invalidates_nothing(
    tmp_path: Path, write_drive: Callable[[Any], Path], drive_document: dict[str, Any]
) -> None:
    drive, packages = write_drive(drive_document), tmp_path / "packages"
    for package in (mrasfm_engine, schemas):
        folder = Path(str(package.__file__)).parent
        shutil.copytree(folder, packages / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    before = key_in(packages, drive)
    for module in ("stages/_features.py", "features/extraction.py", "features/sift.py", "scene/drive.py"):
        with (packages / "mrasfm_engine" / module).open("a", encoding="utf-8") as file:
            file.write("# A comment.\n")
    assert key_in(packages, drive) == before


@pytest.mark.parametrize("stage", sorted(CHECKPOINTED))
def test_a_raised_version_invalidates_its_stage_and_what_follows(
    stage: Stage, write_drive: Callable[[Any], Path], drive_document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = read_drive(write_drive(drive_document))

    def keys() -> list[str]:
        run = stages.Run(drive, EngineConfig(threads=1), stages.store_of(drive.root), print, lambda: False)
        result = []
        for following in IN_ORDER:
            run.key = run.next_key(following, "the same settings")
            result.append(run.key)
        return result

    before = keys()
    monkeypatch.setitem(stages.VERSIONS, stage, stages.VERSIONS[stage] + 1)
    first = IN_ORDER.index(stage)
    after = keys()
    assert after[:first] == before[:first]
    assert not set(after[first:]) & set(before)


def test_every_checkpointed_stage_has_a_version() -> None:
    assert set(stages.VERSIONS) == CHECKPOINTED
