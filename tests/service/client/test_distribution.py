"""`mrasfm-client` as it is assembled; acceptance line 33 builds its wheel and installs it."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def assembled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("assembled") / "client"
    subprocess.run([sys.executable, REPOSITORY / ".ci" / "build_client.py", out], check=True, capture_output=True)
    return out


def test_it_needs_few_modules_of_others(assembled: Path) -> None:
    allowed = {"httpx", "pydantic", "pydantic_core", "rich", "mrasfm_client"}
    for path in assembled.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names = [str(node.module)]
            others = {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"__future__"}
            assert others <= allowed, path


def test_it_replaces_an_earlier_build_and_nothing_else(assembled: Path, tmp_path: Path) -> None:
    command = [sys.executable, REPOSITORY / ".ci" / "build_client.py"]
    (tmp_path / "mine").write_text("mine")
    refused = subprocess.run([*command, tmp_path], check=False, capture_output=True, text=True)
    assert "holds no earlier build" in refused.stderr
    assert (tmp_path / "mine").read_text() == "mine"
    (assembled / "mrasfm_client" / "left.py").touch()
    subprocess.run([*command, assembled], check=True, capture_output=True)
    assert not (assembled / "mrasfm_client" / "left.py").exists()


@pytest.mark.slow
def test_it_works_beside_folders_of_the_same_names(assembled: Path, tmp_path: Path) -> None:
    """And takes nothing from the product, which is not there."""
    for name in ("service", "schemas", "worker", "mrasfm_engine"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('another one')")
    environment = {**os.environ, "PYTHONPATH": str(assembled), "MRASFM_API_KEY": "mrasfm_x"}
    code = (
        "import sys; import mrasfm_client, mrasfm_client.service.commands.client_program as program; "
        "mrasfm_client.Client('http://127.0.0.1:9', 'key').close(); "
        "print(sorted(m for m in sys.modules if m.split('.')[0] in ('service', 'schemas', 'worker', 'numpy'))); "
        "sys.exit(program.main(['list', 'drives', '--url', 'http://127.0.0.1:9', '--json']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[0] == "[]", done.stderr
    assert done.returncode == 4, done.stderr
    assert "cannot be reached" in done.stderr


def test_its_bounds_are_the_products(assembled: Path) -> None:
    own, product = ((folder / "pyproject.toml").read_text() for folder in (assembled, REPOSITORY))
    for name in ("httpx", "pydantic", "rich"):
        (bound,) = re.findall(rf'^    "({name}[<>=][^"]*)",', own, re.MULTILINE)
        assert f'"{bound}"' in product
    version = re.search(r'^version = "(.*)"', product, re.MULTILINE)
    assert version is not None
    assert f'version = "{version[1]}"' in own
