"""The workflows of the forge do what can be done here, and nothing else: `.ci/run` and targets of the Makefile."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
WORKFLOWS = {path.name: path.read_text(encoding="utf-8") for path in (REPOSITORY / ".github" / "workflows").iterdir()}


def test_they_call_what_a_developer_calls() -> None:
    text = WORKFLOWS["ci.yml"]
    assert "- run: .ci/run\n" in text
    assert os.access(REPOSITORY / ".ci" / "run", os.X_OK)
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, re.MULTILINE))
    assert set(re.findall(r"run: make (\w+)", text)) <= targets
    assert set(re.findall(r"mrasfm(?:-client)? (synth|reconstruct|export) ", text)) == {
        "synth",
        "reconstruct",
        "export",
    }


def test_they_test_the_oldest_python() -> None:
    product = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    oldest = product["requires-python"].removeprefix(">=")
    assert f'python: ["{oldest}"' in WORKFLOWS["ci.yml"]


def test_they_may_only_read() -> None:
    for name, text in WORKFLOWS.items():
        assert "permissions:\n  contents: read\n" in text, name
        assert "secrets." not in text, name


def test_the_wheel_has_all_that_the_command_reads() -> None:
    data = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    patterns = data["package-data"]["mrasfm_engine"]
    found = {p.relative_to(REPOSITORY / "mrasfm_engine").as_posix() for p in (REPOSITORY / "mrasfm_engine").rglob("*")
             if p.is_file() and p.suffix not in (".py", ".pyc", ".nbi", ".nbc")}  # fmt: skip
    assert found == {path.relative_to(REPOSITORY / "mrasfm_engine").as_posix() for pattern in patterns
                     for path in (REPOSITORY / "mrasfm_engine").glob(pattern)}  # fmt: skip
