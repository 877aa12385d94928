"""Images that take no part and are named: cut to a third with an end marker after them, or those before once more.

The rest of the drive is used.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.visualization import birds_eye
from tests.helpers.damaged_images import cut
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Document, Variant, read_report

Run = Callable[..., CommandResult]
CAMERAS = ["front", "left"]


def truncate(variant: Variant, files: list[str]) -> None:
    for file in files:
        variant.write(file, cut((variant.root / file).read_bytes()))


def repeat(variant: Variant, unit: int, *cameras: str) -> list[str]:
    """The files of a unit, or of some of its cameras, which become those of the unit before."""
    before, now = (variant.document["frames"][k]["images"] for k in (unit - 1, unit))
    for camera in cameras or now:
        variant.write(now[camera]["file"], (variant.root / before[camera]["file"]).read_bytes())
    return [now[camera]["file"] for camera in cameras or now]


def images_of(variant: Variant) -> list[str]:
    return [image["file"] for frame in variant.document["frames"] for image in frame["images"].values()]


def findings_of(report: Document) -> list[Document]:
    return [finding for finding in report["findings"] if finding["code"] == "truncated-images"]


def test_some_truncated(variant: Variant, mrasfm: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in the first units, by which the calibration's direction is checked, and a whole unit."""
    variant.keep(cameras=CAMERAS, units=6).save()
    units = [frame["images"] for frame in variant.document["frames"]]
    damaged = [units[1]["left"]["file"], units[2]["front"]["file"], units[4]["front"]["file"]]
    truncate(variant, damaged)
    shown: list[str] = []
    read_view = birds_eye.read_view

    def noted(scene: Scene, index: int) -> object:
        shown.append(scene.drive.images[index].file)
        return read_view(scene, index)

    monkeypatch.setattr(birds_eye, "read_view", noted)
    result = mrasfm("reconstruct", variant.root, "--out", variant.scene)
    assert result.code == 0, result.err
    assert "units registered: 6 of 6" in result.out
    assert f"warning: 3 of 12 images are truncated and left out: {', '.join(damaged)}" in result.out
    report = read_report(variant.scene)
    (finding,) = findings_of(report)
    assert finding["severity"] == "warning"
    assert "reconstruct again" in finding["remedy"]
    features = report["by_stage"]["features"]
    assert features["images_left_out"] == [{"file": file, "reason": "truncated"} for file in damaged]
    assert not set(damaged) & set(features["images_with_under_100_keypoints"])
    assert not set(damaged) & set(report["by_stage"]["mapping"]["images_dark_or_without_texture"])
    assert report["summary"]["registered_images"] == 9
    poses = json.loads((variant.scene / "poses.json").read_text(encoding="utf-8"))
    assert sorted(image["file"] for image in poses["images"] if not image["registered"]) == sorted(damaged)
    model = pycolmap.Reconstruction(variant.scene / "model")
    assert not set(damaged) & {image.name for image in model.images.values()}
    assert shown
    assert not set(damaged) & set(shown)
    again = mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert again.code == 0
    repeated = read_report(variant.scene)
    assert repeated["by_stage"]["features"]["reused"]
    assert findings_of(repeated) == [finding]


def test_all_truncated(variant: Variant, mrasfm: Run) -> None:
    variant.keep(cameras=CAMERAS, units=4).save()
    truncate(variant, images_of(variant))
    result = mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == 2
    assert f"8 of 8 images looked at are truncated: {images_of(variant)[0]}" in result.err
    assert "Copy the drive's images again" in result.err
    assert not variant.scene.exists()


def test_a_unit_that_is_recorded_twice(variant: Variant, mrasfm: Run) -> None:
    variant.keep(cameras=CAMERAS, units=6).save()
    repeated = repeat(variant, 3)
    result = mrasfm("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == 0, result.err
    assert "units registered: 5 of 6" in result.out
    assert "frame 3: its images are left out" in result.out
    report = read_report(variant.scene)
    said = [finding["what"] for finding in report["findings"] if finding["code"] == "repeated-images"]
    assert said == [
        f"1 of 6 images of camera {camera} are copies of the one before them, up to 1 in a row: {file}"
        for camera, file in zip(CAMERAS, repeated, strict=True)
    ]
    assert report["by_stage"]["features"]["images_left_out"] == [
        {"file": file, "reason": "repeated"} for file in repeated
    ]


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [truncate, lambda variant, files: repeat(variant, 2, "left")])
def test_nothing_of_what_is_left_out_is_in_the_scene(
    variant: Variant, mrasfm: Run, tmp_path: Path, spoil: Callable[[Variant, list[str]], object]
) -> None:
    """An image that is left out counts as one that was never recorded."""
    variant.keep(cameras=CAMERAS, units=5)
    file = variant.document["frames"][2]["images"]["left"]["file"]
    without = json.loads(json.dumps(variant.document))
    del without["frames"][2]["images"]["left"]
    variant.save()
    shutil.copytree(variant.root, tmp_path / "without")
    (tmp_path / "without" / "drive.json").write_text(json.dumps(without), encoding="utf-8")
    spoil(variant, [file])
    poses = []
    for root in (variant.root, tmp_path / "without"):
        scene = tmp_path / f"scene-{root.name}"
        assert mrasfm("reconstruct", root, "--out", scene, *WITHOUT_PICTURES).code == 0
        document = json.loads((scene / "poses.json").read_text(encoding="utf-8"))
        poses.append(np.array([unit["world_from_rig"]["translation_m"] for unit in document["units"]]))
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-6)
