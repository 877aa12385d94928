"""A scene is not replaced by that of another drive."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mrasfm_engine.cli import EXIT_BAD_INPUT, main
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.export.earlier_scene import require_same_drive
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.io.stage_store import content_sha256_of, fingerprints_of_images
from mrasfm_engine.pipeline import reconstruct
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import Scene
from schemas import DriveManifest
from tests.helpers.export_example import MISSING_UNIT, make_scene


def drive_of(scene: Scene, root: Path, *, content: str = "") -> Drive:
    """The scene's drive on disk, with files that differ in their content."""
    for image in scene.drive.images:
        (root / image.file).parent.mkdir(parents=True, exist_ok=True)
        (root / image.file).write_text(f"{image.file} {content}")
    return Drive(root, scene.drive.manifest)


def changed(drive: Drive, change: Callable[[dict[str, Any]], object]) -> Drive:
    document = drive.manifest.model_dump(exclude_none=True)
    change(document)
    return Drive(drive.root, DriveManifest.model_validate(document))


def require(out: Path, drive: Drive) -> None:
    require_same_drive(out, drive, lambda: content_sha256_of(drive, threads=1))


@pytest.fixture
def scene() -> Scene:
    return make_scene()


@pytest.fixture
def drive(scene: Scene, tmp_path: Path) -> Drive:
    return drive_of(scene, tmp_path / "drive")


@pytest.fixture
def out(scene: Scene, drive: Drive, tmp_path: Path) -> Path:
    """The folder of the drive's scene."""
    images = fingerprints_of_images(scene, content_sha256_of(drive, threads=1))
    write_scene(scene, tmp_path / "scene", {"drive": "example", "images_sha256": images})
    return tmp_path / "scene"


@pytest.mark.parametrize(
    "change",
    [
        lambda document: None,
        lambda document: document.update(name="corrected"),
        lambda document: document["frames"].pop(MISSING_UNIT),
        lambda document: document["frames"].pop(),
        lambda document: [frame.update(timestamp_us=frame["timestamp_us"] + 9) for frame in document["frames"]],
        lambda document: document["rig"]["cameras"][0].update(params=[801.0, 811.0, 480.0, 300.0]),
    ],
)
def test_a_corrected_manifest_is_the_same_drive(
    drive: Drive, out: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    require(out, changed(drive, change))


def test_a_corrected_image_is_of_the_same_drive(drive: Drive, out: Path) -> None:
    (drive.root / drive.images[0].file).write_text("corrected")
    require(out, drive)


def test_another_drive_is_refused(scene: Scene, out: Path, tmp_path: Path) -> None:
    """By its name or its images: drives may agree in names and times."""
    same_name = drive_of(scene, tmp_path / "same name", content="other")
    with pytest.raises(InputError, match="scene holds the scene of a drive 'example' with other images") as found:
        require(out, same_name)
    assert found.value.code == "other-scene"
    assert "--force" in found.value.remedy
    with pytest.raises(InputError, match="scene holds the scene of another drive, 'example'"):
        require(out, changed(same_name, lambda document: document.update(name="day 2")))
    elsewhere = make_scene(folder="other")
    with pytest.raises(InputError, match="with other images"):
        require(out, drive_of(elsewhere, tmp_path / "other files"))


def test_a_scene_without_fingerprints_has_a_name(scene: Scene, drive: Drive, tmp_path: Path) -> None:
    write_scene(scene, tmp_path / "scene", {"drive": "example"})
    require(tmp_path / "scene", drive)
    with pytest.raises(InputError, match="another drive"):
        require(tmp_path / "scene", changed(drive, lambda document: document.update(name="day 2")))


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "[" * 100_000, '{"drive": 3}', '{"images": 3}', '{"images": [3]}', "\0"]
)
@pytest.mark.parametrize("file", ["report.json", "poses.json"])
def test_a_damaged_scene_stops_nobody(drive: Drive, out: Path, file: str, text: str) -> None:
    (out / file).write_text(text)
    require(out, drive)
    shutil.rmtree(out)
    require(out, drive)


def test_the_command_replaces_another_scene_only_with_force(
    out: Path,
    drive_document: dict[str, Any],
    write_drive: Callable[[dict[str, Any]], Path],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    shutil.rmtree(tmp_path / "drive")
    other, before = write_drive(drive_document), sorted(out.rglob("*"))
    assert main(["reconstruct", str(other), "--out", str(out)]) == EXIT_BAD_INPUT
    assert f"{out} holds the scene of another drive, 'example'" in capsys.readouterr().err
    assert sorted(out.rglob("*")) == before
    with pytest.raises(CancelledError):  # the work begins
        reconstruct(other, out, EngineConfig(threads=1), cancel=lambda: True, force=True)
    main(["reconstruct", str(other), "--out", str(out), "--force"])
    assert "holds the scene" not in capsys.readouterr().err
