"""Drives that the tests share: rendering and reconstructing take seconds each, so variants are links to one drive."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.cli import main
from tests.helpers.made_once import made_once

Document = dict[str, Any]
# Pictures take seconds, and most tests look at none.
WITHOUT_PICTURES = ("--config", Path(__file__).with_name("without_pictures.toml"))
SMALL = ("--width", "480", "--height", "270", "--texture-px", "256")


@dataclass
class CommandResult:
    """What a command did."""

    code: int
    out: str
    err: str


@dataclass
class Variant:
    """A copy of a drive by hard links, with a manifest of its own."""

    root: Path
    document: Document
    scene: Path = field(init=False)

    def __post_init__(self) -> None:
        self.scene = self.root.parent / f"{self.root.name}-scene"

    def save(self) -> Variant:
        """Write the manifest as it is now."""
        self.write("drive.json", json.dumps(self.document).encode())
        return self

    def write(self, file: str, data: bytes) -> None:
        """Replace a file; what it was linked to stays."""
        (self.root / file).unlink(missing_ok=True)
        (self.root / file).write_bytes(data)

    def keep(self, *, cameras: list[str] | None = None, units: int | None = None) -> Variant:
        """Leave out other cameras, and later units with their GNSS samples."""
        document = self.document
        if cameras is not None:
            document["rig"]["cameras"] = [c for c in document["rig"]["cameras"] if c["name"] in cameras]
            for frame in document["frames"]:
                frame["images"] = {name: image for name, image in frame["images"].items() if name in cameras}
        if units is not None:
            document["frames"] = document["frames"][:units]
            if "gnss" in document:
                document["gnss"]["samples"] = document["gnss"]["samples"][:units]
        listed = {image["file"] for frame in document["frames"] for image in frame["images"].values()}
        for file in self.root.glob("images/*/*"):
            if file.relative_to(self.root).as_posix() not in listed:
                file.unlink()
        return self


def synth(out: Path, *options: object) -> Path:
    """Render a drive of small images."""
    assert main(["synth", *SMALL, *map(str, options), "--out", str(out)]) == 0
    return out


def mrasfm_process(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    """`mrasfm` as a process of its own."""
    command = [sys.executable, "-c", "import sys; from mrasfm_engine.cli import main; sys.exit(main())"]
    return subprocess.Popen(
        [*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


@pytest.fixture(scope="session")
def surround_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered drive of 4 cameras (front, back, left, right) and 8 units. Tests only read it."""
    options = ("--cameras", 4, "--units", 8, "--seed", 3)
    return made_once(tmp_path_factory, "surround-drive", lambda out: synth(out, *options))


@pytest.fixture(scope="session")
def surround_scene(surround_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That drive's scene, with GNSS. Tests only read it."""

    def make(out: Path) -> None:
        assert main(["reconstruct", str(surround_drive), "--out", str(out)]) == 0

    return made_once(tmp_path_factory, "surround-scene", make)


@pytest.fixture
def variant_of(tmp_path: Path) -> Callable[[Path], Variant]:
    """A function that makes a variant of a drive."""

    def make(drive: Path) -> Variant:
        root = tmp_path / "variant"
        shutil.copytree(drive, root, copy_function=os.link)
        return Variant(root, copy.deepcopy(json.loads((root / "drive.json").read_text(encoding="utf-8"))))

    return make


@pytest.fixture
def variant(surround_drive: Path, variant_of: Callable[[Path], Variant]) -> Variant:
    """A variant of the surround drive."""
    return variant_of(surround_drive)


@pytest.fixture
def mrasfm(capfd: pytest.CaptureFixture[str]) -> Callable[..., CommandResult]:
    """A function that runs the command in this process and returns what it printed."""

    def run(*arguments: object) -> CommandResult:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        printed = capfd.readouterr()
        return CommandResult(code, printed.out, printed.err)

    return run


def read_report(scene: Path) -> Document:
    """A scene's report, with `by_stage`."""
    report: Document = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    report["by_stage"] = {stage["stage"]: stage for stage in report["stages"]}
    return report


def leftovers(folder: Path) -> list[str]:
    """Half-written files anywhere below a folder."""
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if ".partial" in path.name]
