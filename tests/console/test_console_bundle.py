"""The committed bundle is what its sources give, and is part of the wheel."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.api.openapi_export import openapi_text
from service.api.routes.console import FOLDER
from tests.helpers.live_api import REPOSITORY

CONSOLE = REPOSITORY / "service" / "console"
REPORT = REPOSITORY / "mrasfm_engine" / "visualization" / "static"
BUILT = {"static": FOLDER, "report": REPORT}
OLDEST_NODE = 20


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources with the packages that the lock names; skips where they cannot be had."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("no node or npm in PATH: apt install nodejs npm")
    said = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if int(said.removeprefix("v").partition(".")[0]) < OLDEST_NODE:
        pytest.skip(f"node {said.strip()} is older than {OLDEST_NODE}")
    folder = tmp_path_factory.mktemp("sources") / "service" / "console"
    ignored = shutil.ignore_patterns("node_modules", "static", "build", "build.sha256")
    shutil.copytree(CONSOLE, folder, ignore=ignored)
    done = subprocess.run([npm, "ci", "--ignore-scripts"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"npm ci cannot get the packages here: {done.stderr.strip()[-300:]}")
    return folder


def test_it_is_built_of_these_sources() -> None:
    """What `build.mjs` built of what; the slow test builds it again."""
    lines = (CONSOLE / "build.sha256").read_text(encoding="utf-8").splitlines()
    named = {name: digest for digest, name in (line.split("  ", 1) for line in lines)}
    files = {str(path.relative_to(CONSOLE)): path for path in (CONSOLE / "src").rglob("*") if path.is_file()}
    files |= {name: CONSOLE / name for name in ("build.mjs", "package-lock.json", "package.json", "tsconfig.json")}
    files |= {f"{label}/{path.name}": path for label, of in BUILT.items() for path in of.iterdir()}
    contents = {name: path.read_bytes() for name, path in files.items()}
    contents["build/openapi.json"] = openapi_text().encode()
    assert named == {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}, "make console"


@pytest.mark.slow  # a minute, for packages and compilers
def test_it_is_built_again_byte_by_byte(sources: Path) -> None:
    (sources / "build").mkdir()
    (sources / "build" / "openapi.json").write_text(openapi_text())
    own, report = sources / "built" / "console", sources / "built" / "report"
    environment = {**os.environ, "npm_config_offline": "true"}

    def run(*command: str) -> None:
        done = subprocess.run(command, cwd=sources, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr

    run("npm", "run", "types")
    with ThreadPoolExecutor(2) as pool:
        for one in (
            pool.submit(run, "npm", "run", "check"),
            pool.submit(run, "node", "build.mjs", str(own), str(report)),
        ):
            one.result()
    assert (sources / "src" / "api.d.ts").read_bytes() == (CONSOLE / "src" / "api.d.ts").read_bytes()
    assert (sources / "build.sha256").read_bytes() == (CONSOLE / "build.sha256").read_bytes()
    for built, committed in ((own, FOLDER), (report, REPORT)):
        names = {path.name for path in built.iterdir()}
        assert names == {path.name for path in committed.iterdir()}
        assert len(names) >= 2
        assert [name for name in names if (built / name).read_bytes() != (committed / name).read_bytes()] == []


def test_the_bundle_names_no_other_host() -> None:
    """Addresses in it are names of standards and of the projects, which nothing asks."""
    script = (FOLDER / "console.js").read_text(encoding="utf-8")
    assert re.findall(r"https?://[^\"'` )]+", script) == []
    page = (FOLDER / "index.html").read_text(encoding="utf-8")
    assert "http" not in page


def test_licences_of_all_parts_are_there() -> None:
    text = (FOLDER / "licences.txt").read_text(encoding="utf-8")
    lock = json.loads((CONSOLE / "package-lock.json").read_text())
    wanted = json.loads((CONSOLE / "package.json").read_text())["dependencies"]
    for name, version in wanted.items():
        assert f"{name} {version}\n" in text, name
        assert lock["packages"][f"node_modules/{name}"]["version"] == version
    assert "registry" not in (CONSOLE / "package-lock.json").read_text()


def test_the_wheel_has_the_bundles() -> None:
    package_data = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    for package, folder in (("service", FOLDER), ("mrasfm_engine", REPORT)):
        covered = {p for pattern in package_data[package] for p in (REPOSITORY / package).glob(pattern)}
        assert set(folder.iterdir()) <= covered
