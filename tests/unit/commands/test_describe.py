"""Formats are described by the installed package, and messages point to nothing else."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from mrasfm_engine.cli import main
from mrasfm_engine.config import EngineConfig
from schemas.export import schema_text
from service.settings import Settings

REPOSITORY = Path(__file__).resolve().parents[3]
PACKAGES = ("schemas", "service", "worker", "mrasfm_engine")


def described(capsys: pytest.CaptureFixture[str], topic: str) -> str:
    assert main(["describe", topic]) == 0
    return capsys.readouterr().out


def test_described_settings_are_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    text = described(capsys, "settings")
    assert EngineConfig.model_validate(tomllib.loads(text)) == EngineConfig()
    for name, section in (*EngineConfig.model_fields.items(), *_fields_of_sections()):
        if not isinstance(section.default, BaseModel):
            assert re.search(rf"^# {re.escape(str(section.description))}\n(# )?{name} =", text, re.MULTILINE), name


def _fields_of_sections() -> Iterator[tuple[str, FieldInfo]]:
    for field in EngineConfig.model_fields.values():
        if isinstance(field.default, BaseModel):
            yield from type(field.default).model_fields.items()


def test_described_manifest_and_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert described(capsys, "manifest") == files("schemas").joinpath("README.md").read_text(encoding="utf-8")
    text = described(capsys, "schema")
    assert text == schema_text()
    assert json.loads(text)["title"] == "DriveManifest"


def test_described_variables_are_the_service_s(capsys: pytest.CaptureFixture[str]) -> None:
    lines = described(capsys, "service").splitlines()
    names = [line.split("=")[0].removeprefix("#MRASFM_").lower() for line in lines[1::2]]
    assert names == list(Settings.model_fields)
    assert all(line.startswith("# ") and len(line) > 10 for line in lines[::2])
    assert "#MRASFM_LEASE_SECONDS=45.0" in lines


def test_a_wheel_holds_what_is_described(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, tmp_path)
    shutil.copytree(REPOSITORY / "schemas", tmp_path / "schemas", ignore=shutil.ignore_patterns("__pycache__"))
    build = "from setuptools.build_meta import build_wheel; build_wheel('.')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert {"schemas/README.md", "schemas/drive.schema.json"} <= set(zipfile.ZipFile(wheel).namelist())


def test_messages_name_no_file_of_the_repository() -> None:
    sources = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    assert len(sources) > 200
    named = re.compile(r"README|CHANGELOG|\bdocs/|\b\w+\.py\b|\bmake (?:docs|setup|test|demo|check|schema)\b")
    found = []
    for path in sources:
        source = path.read_text(encoding="utf-8")
        if named.search(source):
            messages = [
                (line, text) for line, text in _strings(ast.parse(source)) if " " in text and named.search(text)
            ]
            found += [f"{path.relative_to(REPOSITORY)}:{line}: {text}" for line, text in messages]
    assert found == []


def _strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Strings that are no docstrings."""
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
            yield node.lineno, node.value


def _is_message(text: str) -> bool:
    """Whether a string is no bare file name or route."""
    return " " in text or text.startswith(tuple(f"{package}/" for package in PACKAGES))
