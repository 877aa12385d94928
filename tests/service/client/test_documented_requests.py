"""The example with curl of `docs/service/api.md` does what it says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.api.jobs import ReconstructionSettings
from tests.documentation.request_settings import request_settings
from tests.helpers.live_api import REPOSITORY, SCENE_FILES, Client
from tests.helpers.tiny_drive import tiny_drive
from tests.service.client.conftest import EXPORT_FILES, MAP_FILES, written

PAGE = REPOSITORY / "docs" / "service" / "api.md"


@pytest.fixture
def commands() -> str:
    section = PAGE.read_text(encoding="utf-8").partition("## An example with curl")[2].partition("\n## ")[0]
    return "\n".join(re.findall(r"^```\n(.*?)^```$", section, re.DOTALL | re.MULTILINE))


def run(commands: str, client: Client, folder: Path) -> subprocess.CompletedProcess[str]:
    if missing := [name for name in ("bash", "curl", "jq", "tar") if shutil.which(name) is None]:
        pytest.skip(f"the example needs {', '.join(missing)}")
    script = commands.replace("http://127.0.0.1:8000", client.api.url).replace("sleep 5", "sleep 0.1")
    assert client.api.url in script
    environment = {**os.environ, "MRASFM_API_KEY": client.key}
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=30,
    )


def test_the_example_gets_a_scene_an_export_and_a_map(
    commands: str, client: Client, worker: Callable[[set[str]], None], tmp_path: Path
) -> None:
    for name in ("my-drive", "another-drive"):
        written(tiny_drive(name, seed=f"{tmp_path}{name}"), tmp_path / name)
    done = run(commands, client, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.relative_to(tmp_path / "my-scene").as_posix() for path in _files(tmp_path / "my-scene")} == set(
        SCENE_FILES
    ) | {"points.ply"}
    for folder, files in (("my-export", EXPORT_FILES), ("my-map", MAP_FILES)):
        assert {f.relative_to(tmp_path / folder).as_posix(): f.read_bytes() for f in _files(tmp_path / folder)} == files
    jobs = {job["kind"]: job for job in client.get("/v1/jobs").json()["items"]}
    assert {job["state"] for job in jobs.values()} == {"SUCCEEDED"}
    assert jobs["AGGREGATION"]["settings"]["max_keypoints"] == 4096
    assert len(client.get("/v1/jobs?kind=RECONSTRUCTION").json()["items"]) == 2, "with one scene for export and map"


def test_the_example_says_why_a_job_failed(
    commands: str, client: Client, worker: Callable[[set[str]], None], tmp_path: Path
) -> None:
    for name in ("my-drive", "another-drive"):
        written(tiny_drive(name, seed=f"{tmp_path}{name}"), tmp_path / name)
    worker({"my-drive"})
    done = run(commands, client, tmp_path)
    assert done.returncode != 0
    assert "it broke" in done.stderr


def test_all_settings_of_a_request_are_listed() -> None:
    assert request_settings() in PAGE.read_text(encoding="utf-8")
    assert request_settings().count("\n") == 2 + len(ReconstructionSettings.model_fields)


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]
