"""Blur and standing still, on hand-made drives of any length and on real ones."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.cli import main
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.io.images import read_image_gray
from mrasfm_engine.preflight import image_content
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.preflight.image_content import MAX_IMAGES, check_content, inspect_drive
from schemas.findings import Finding
from tests.helpers.damaged_images import cut

WIDTH, HEIGHT = 320, 200
FRAMES = 12
NAMES = ("left", "right")

Paint = Callable[[str, int, np.ndarray], np.ndarray]  # camera, frame, what it would show


@pytest.fixture(scope="module")
def landscape() -> np.ndarray:
    """Texture of all scales, wide enough to drive along."""
    rng = np.random.default_rng(4)
    size = (HEIGHT, WIDTH + 60 * FRAMES)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, size).astype(np.float32), (0, 0), s) * s * 30 for s in (0.8, 2, 6, 20)]
    return np.clip(sum(layers) + 128, 0, 255).astype(np.float32)


@pytest.fixture
def make_drive(tmp_path: Path, drive_document: dict[str, Any], landscape: np.ndarray) -> Callable[..., Path]:
    """A function that writes a drive whose cameras pass by the landscape, `speed_px` a frame."""

    def make(
        *,
        speed_px: Callable[[int], float] = lambda frame: 20.0,
        paint: Paint = lambda camera, frame, image: image,
        gnss: Callable[[int], float] | None = None,
        noise: float = 1.0,
    ) -> Path:
        rng = np.random.default_rng(5)
        document = copy.deepcopy(drive_document)
        for camera in document["rig"]["cameras"]:
            camera |= {"width": WIDTH, "height": HEIGHT, "params": [250.0, 250.0, WIDTH / 2, HEIGHT / 2]}
        frame, sample = document["frames"][0], document["gnss"]["samples"][0]
        document["frames"] = []
        samples = []
        x_px = 0.0
        root = tmp_path / "drive"
        for i in range(FRAMES):
            x_px += speed_px(i)
            time_us = frame["timestamp_us"] + 100_000 * i
            files = {name: f"images/{name}/{i:06d}.png" for name in NAMES}
            for k, (name, file) in enumerate(files.items()):
                seen = landscape[:, round(x_px) + 5 * k : round(x_px) + 5 * k + WIDTH]
                image = paint(name, i, seen) + rng.normal(0, noise, seen.shape)
                (root / file).parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(root / file), np.clip(image, 0, 255).astype(np.uint8))
            images = {name: {"file": file} for name, file in files.items()}
            document["frames"].append({"timestamp_us": time_us, "source_frame": i, "images": images})
            north_m = 0.0 if gnss is None else gnss(i)
            samples.append({**sample, "timestamp_us": time_us, "latitude_deg": 49.0 + north_m / 111_000})
        document["gnss"]["samples"] = samples
        if gnss is None:
            del document["gnss"]
        (root / "drive.json").write_text(json.dumps(document), encoding="utf-8")
        return root

    return make


def findings_of(root: Path) -> list[Finding]:
    return check_content(read_drive(root))


def codes_of(root: Path) -> list[tuple[str, str]]:
    return [(str(finding.severity), finding.code) for finding in findings_of(root)]


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma)


def test_moving_and_sharp(make_drive: Callable[..., Path]) -> None:
    assert findings_of(make_drive()) == []


def test_slow_is_not_standing(make_drive: Callable[..., Path]) -> None:
    """One pixel a frame at a width of 320."""
    assert findings_of(make_drive(speed_px=lambda frame: 1.0)) == []


def test_many_frames_a_second_are_not_standing(make_drive: Callable[..., Path]) -> None:
    """At 100 Hz and walking pace neighbours are the same, which says nothing."""
    root = make_drive(speed_px=lambda frame: 1.0 if frame % 6 == 0 else 0.0)
    document = json.loads((root / "drive.json").read_text(encoding="utf-8"))
    start_us = document["frames"][0]["timestamp_us"]
    for i, frame in enumerate(document["frames"]):
        frame["timestamp_us"] = start_us + 15_000 * i
    (root / "drive.json").write_text(json.dumps(document), encoding="utf-8")
    assert findings_of(root) == []


def test_two_frames(make_drive: Callable[..., Path]) -> None:
    root = make_drive()
    document = json.loads((root / "drive.json").read_text(encoding="utf-8"))
    document["frames"] = document["frames"][:2]
    (root / "drive.json").write_text(json.dumps(document), encoding="utf-8")
    assert findings_of(root) == []


def test_sky_and_bonnet_do_not_hide_movement(make_drive: Callable[..., Path]) -> None:
    def paint(camera: str, frame: int, image: np.ndarray) -> np.ndarray:
        image = image.copy()
        image[: HEIGHT // 2] = 200
        image[-HEIGHT // 5 :] = 40
        return image

    assert findings_of(make_drive(paint=paint)) == []


def test_smooth_scenes_are_not_blurred(make_drive: Callable[..., Path]) -> None:
    """One camera sees a wall of little detail all the time, and both pass a plain one for two frames."""

    def paint(camera: str, frame: int, image: np.ndarray) -> np.ndarray:
        strength = 0.25 if frame in (6, 7) else 0.5 if camera == "right" else 1.0
        return 128 + strength * (image - 128)

    assert findings_of(make_drive(paint=paint)) == []


def test_images_that_show_nothing(make_drive: Callable[..., Path]) -> None:
    """Night and fog: nothing can be told, and nothing is."""
    root = make_drive(paint=lambda camera, frame, image: np.full_like(image, 30), speed_px=lambda frame: 0)
    assert findings_of(root) == []


@pytest.mark.parametrize(
    ("factor", "severity"),
    [(1, "error"), (4, "error"), (16, "error"), (64, "warning"), (257, None), (16 * 16, None)],
    ids=["8 bits", "10 bits", "12 bits", "14 bits", "16 bits", "12 bits times 16"],
)
@pytest.mark.parametrize("has_alpha", [False, True])
def test_images_that_leave_bits_unused(
    make_drive: Callable[..., Path], factor: int, severity: str | None, has_alpha: bool
) -> None:
    """Images of a sensor's 12 bits in files of 16 would have 16 gray levels: nothing is found in them."""
    root = make_drive()
    for path in (root / "images/left").iterdir():
        values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16) * factor
        if has_alpha:
            values = np.dstack([values, values, values, np.full_like(values, 65535)])
        assert cv2.imwrite(str(path), values)
    found = [finding for finding in findings_of(root) if finding.code == "unused-bits"]
    assert [finding.severity for finding in found] == ([] if severity is None else [severity])
    if found:
        assert "camera left" in found[0].what
        assert f"times {256 // factor}," in found[0].remedy


@pytest.mark.parametrize("sigma", [2.0, 6.0])
def test_some_blurred_images(make_drive: Callable[..., Path], sigma: float) -> None:
    def paint(camera: str, frame: int, image: np.ndarray) -> np.ndarray:
        return blurred(image, sigma) if (camera, frame) in (("left", 3), ("right", 8)) else image

    (finding,) = findings_of(make_drive(paint=paint))
    assert (str(finding.severity), finding.code) == ("warning", "blurred-images")
    assert "2 of 24 images" in finding.what
    assert "images/left/000003.png" in finding.what
    assert "images/right/000008.png" in finding.what


def test_one_blurred_camera(make_drive: Callable[..., Path]) -> None:
    root = make_drive(paint=lambda camera, frame, image: blurred(image, 4.0) if camera == "right" else image)
    (finding,) = findings_of(root)
    assert (str(finding.severity), finding.code) == ("warning", "blurred-camera")
    assert "camera right" in finding.what


def test_standing_for_a_while(make_drive: Callable[..., Path]) -> None:
    """As at a traffic light; the exposure changes, and noise never repeats."""
    root = make_drive(
        speed_px=lambda frame: 0.0 if 4 <= frame < 9 else 20.0,
        paint=lambda camera, frame, image: image + 3 * (frame % 3),
        noise=2.0,
    )
    (finding,) = findings_of(root)
    assert (str(finding.severity), finding.code) == ("warning", "standing-still")
    assert "45%" in finding.what
    assert "frames.3 to frames.4" in finding.what


def test_standing_for_a_moment(make_drive: Callable[..., Path]) -> None:
    assert findings_of(make_drive(speed_px=lambda frame: 0.0 if frame == 5 else 20.0)) == []


def test_one_camera_that_repeats_itself_is_no_standing(make_drive: Callable[..., Path], landscape: np.ndarray) -> None:
    root = make_drive(paint=lambda camera, frame, image: landscape[:, :WIDTH] if camera == "right" else image)
    assert findings_of(root) == []


def test_frames_that_are_recorded_twice_are_no_standing(make_drive: Callable[..., Path]) -> None:
    assert findings_of(make_drive(speed_px=lambda frame: 20.0 * (frame % 2), noise=0.0)) == []


@pytest.mark.parametrize("gnss", [None, lambda frame: 0.2 * (frame % 2)])
def test_standing_all_the_time(make_drive: Callable[..., Path], gnss: Callable[[int], float] | None) -> None:
    root = make_drive(speed_px=lambda frame: 0.0, gnss=gnss)
    assert codes_of(root) == [("error", "standing-still")]
    assert main(["preflight", str(root)]) == 2
    assert main(["reconstruct", str(root), "--out", str(root.parent / "scene")]) == 2


def test_positions_move_and_images_do_not(make_drive: Callable[..., Path]) -> None:
    root = make_drive(speed_px=lambda frame: 0.0, gnss=lambda frame: 1.0 * frame)
    assert codes_of(root) == [("warning", "standing-still")]
    assert [f.code for f in check_content(read_drive(root), use_gnss=False)] == ["standing-still"]


def test_damaged_image(make_drive: Callable[..., Path]) -> None:
    root = make_drive()
    file = root / "images" / "left" / "000002.png"
    data = bytearray(file.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    file.write_bytes(data)
    (finding,) = inspect_drive(read_drive(root))
    assert (str(finding.severity), finding.code) == ("warning", "corrupt-images")
    assert "images/left/000002.png" in finding.what
    assert str(root) not in finding.what


def test_long_drive_is_sampled(make_drive: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The same dozen frames over and over: what is read does not grow with the drive, and reaches both ends."""
    root = make_drive()
    document = json.loads((root / "drive.json").read_text(encoding="utf-8"))
    start_us = document["frames"][0]["timestamp_us"]
    frames = []
    for i in range(2000):
        files = {name: f"images/{name}/{i:06d}.png" for name in NAMES}
        for file in files.values():
            if i >= FRAMES:
                os.link(root / Path(file).with_stem(f"{i % FRAMES:06d}"), root / file)
        images = {name: {"file": file} for name, file in files.items()}
        frames.append({"timestamp_us": start_us + 100_000 * i, "source_frame": i, "images": images})
    (root / "drive.json").write_text(json.dumps({**document, "frames": frames}), encoding="utf-8")
    read: list[str] = []

    def noted(path: Path) -> np.ndarray:
        read.append(path.stem)
        return read_image_gray(path)

    monkeypatch.setattr(image_content, "read_image_gray", noted)
    assert check_content(read_drive(root)) == []
    assert MAX_IMAGES // 2 <= len(read) <= MAX_IMAGES
    assert {"000000", "001999"} <= set(read)


def test_cancel(make_drive: Callable[..., Path]) -> None:
    with pytest.raises(CancelledError):
        check_content(read_drive(make_drive()), cancel=lambda: True)


@pytest.mark.real
@pytest.mark.parametrize("name", ["kitti06", "kitti02", "ddad"])
def test_real_drives_have_nothing_of_it(shared_data: Path, tmp_path: Path, name: str) -> None:
    assert main(["import", str(shared_data / name), "--out", str(tmp_path / name)]) == 0
    assert check_content(read_drive(tmp_path / name)) == []


def cut_some(root: Path, chosen: Callable[[Path], bool]) -> list[str]:
    """Cut the chosen images to a third; which these are."""
    files = [file for file in sorted((root / "images").rglob("*.png")) if chosen(file)]
    for file in files:
        file.write_bytes(cut(file.read_bytes()))
    return [file.relative_to(root).as_posix() for file in files]


def test_truncated_images_are_named(make_drive: Callable[..., Path], capfd: pytest.CaptureFixture[str]) -> None:
    root = make_drive()
    files = cut_some(root, lambda file: file.parent.name == "left" and int(file.stem) in (3, 7))
    (finding,) = inspect_drive(read_drive(root), use_gnss=False)
    assert (str(finding.severity), finding.code) == ("warning", "truncated-images")
    assert finding.what == f"2 of 24 images looked at are truncated: {files[0]}, {files[1]}"
    assert "Copy them again" in finding.remedy
    assert main(["preflight", str(root), "--no-gnss"]) == 0
    assert files[1] in capfd.readouterr().out


def test_all_images_truncated_is_an_error(make_drive: Callable[..., Path], capfd: pytest.CaptureFixture[str]) -> None:
    root = make_drive()
    assert len(cut_some(root, lambda file: True)) == 2 * FRAMES
    assert codes_of(root) == [("error", "truncated-images")]
    assert main(["preflight", str(root), "--no-gnss"]) == 2
    assert "error: 24 of 24 images looked at are truncated: images/left/000000.png" in capfd.readouterr().out


def test_the_sample_has_all_cameras_of_a_large_rig(
    make_drive: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eighteen cameras: too many to compare all for movement, and one of them truncated all along."""
    root = make_drive()
    document = json.loads((root / "drive.json").read_text(encoding="utf-8"))
    names = [f"camera{k:02d}" for k in range(18)]
    document["rig"]["cameras"] = [{**document["rig"]["cameras"][0], "name": name} for name in names]
    whole = root / "images/left/000000.png"
    for i, frame in enumerate(document["frames"]):
        frame["images"] = {}
        for name in names:
            file = f"images/{name}/{i:06d}.png"
            (root / file).parent.mkdir(exist_ok=True)
            os.link(root / f"images/left/{i:06d}.png", root / file)
            frame["images"][name] = {"file": file}
    for i in range(FRAMES):
        (root / f"images/camera13/{i:06d}.png").unlink()
        (root / f"images/camera13/{i:06d}.png").write_bytes(cut(whole.read_bytes()))
    (root / "drive.json").write_text(json.dumps(document), encoding="utf-8")
    read: list[Path] = []

    def noted(path: Path) -> np.ndarray:
        read.append(path)
        return read_image_gray(path)

    monkeypatch.setattr(image_content, "read_image_gray", noted)
    (finding,) = check_content(read_drive(root))
    assert "are truncated: images/camera13/" in finding.what
    assert {path.parent.name for path in read} == set(names)
    assert len(read) == len(set(read)) == MAX_IMAGES
