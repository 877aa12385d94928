"""The size at which images are extracted: reduced where that leaves enough keypoints, else as they are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig, FeatureConfig
from mrasfm_engine.errors import CancelledError, StorageError
from mrasfm_engine.features.extraction import extract_features
from mrasfm_engine.features.extraction_size import SAMPLED_IMAGES, at_sizes, find_sides
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.scene.drive import Drive
from schemas import Camera, DriveManifest, Frame, FrameImage, Pose, Rig

SIZES = {"rich": (640, 480), "poor": (600, 400)}
UNITS = 6


def texture(size: tuple[int, int], sigma_px: float, seed: int) -> np.ndarray:
    """An image whose smallest details are of `sigma_px`."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(size[1], size[0])), (0, 0), sigma_px)
    return np.repeat(np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def write_drive(folder: Path, sigma_px: dict[str, float], mask: np.ndarray | None = None) -> Drive:
    """A drive of one camera for each name, with images of its own size and detail; `mask` is that of every image."""
    folder.mkdir(parents=True, exist_ok=True)
    if mask is not None:
        cv2.imwrite(str(folder / "mask.png"), mask)
    frames = []
    for unit in range(UNITS):
        images = {}
        for name, sigma in sigma_px.items():
            cv2.imwrite(str(folder / f"{name}{unit}.png"), texture(SIZES[name], sigma, unit))
            images[name] = FrameImage(file=f"{name}{unit}.png", mask=None if mask is None else "mask.png")
        frames.append(Frame(timestamp_us=unit * 100_000, source_frame=unit, images=images))
    cameras = [
        Camera(
            name=name,
            model="SIMPLE_PINHOLE",
            width=SIZES[name][0],
            height=SIZES[name][1],
            params=[500.0, SIZES[name][0] / 2, SIZES[name][1] / 2],
            rig_from_cam=Pose(rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0]),
        )
        for name in sigma_px
    ]
    return Drive(folder, DriveManifest(name="textures", rig=Rig(cameras=cameras), frames=frames))


def sides(drive: Drive, max_keypoints: int) -> dict[tuple[int, int], int]:
    extractor = SiftExtractor(FeatureConfig(max_keypoints=max_keypoints))
    return find_sides(drive, extractor, max_keypoints=max_keypoints, threads=2)


def test_rich_images_are_reduced_and_poor_ones_are_not(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"rich": 1.0, "poor": 12.0})
    assert sides(drive, 400) == {SIZES["rich"]: 320}
    found = extract_features(drive, SiftExtractor(FeatureConfig(max_keypoints=400, max_side_px=320)), threads=1)
    assert min(len(f.xy_px) for image, f in zip(drive.images, found, strict=True) if image.camera == 0) >= 300


def test_no_smaller_than_the_wanted_keypoints_need(tmp_path: Path) -> None:
    """With more keypoints wanted the size rises, until images are extracted as they are."""
    drive = write_drive(tmp_path, {"rich": 1.0})
    found = [sides(drive, wanted).get(SIZES["rich"], 640) for wanted in (400, 1200, 2000, 20_000)]
    assert found == sorted(found)
    assert found[0] == 320
    assert 320 < found[1] < 640
    assert found[-1] == 640


def test_one_rich_image_among_poor_ones_decides_nothing(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"poor": 12.0})
    cv2.imwrite(str(tmp_path / "poor0.png"), texture(SIZES["poor"], 1.0, 9))
    assert sides(drive, 300) == {}


def test_masked_keypoints_do_not_count(tmp_path: Path) -> None:
    free, covered = np.full((480, 640), 2, np.uint8), np.full((480, 640), 13, np.uint8)  # building, car
    covered[:16] = 2
    assert sides(write_drive(tmp_path / "free", {"rich": 1.0}, free), 700) == {SIZES["rich"]: 320}
    assert sides(write_drive(tmp_path / "covered", {"rich": 1.0}, covered), 700) == {}


@pytest.mark.slow
def test_keypoints_of_reduced_images_lie_where_those_of_full_ones_do(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"rich": 2.5})
    whole = SiftExtractor(FeatureConfig(max_keypoints=20_000))
    reduced = at_sizes(whole, {SIZES["rich"]: 320})
    image = texture(SIZES["rich"], 2.5, 0)
    a, b = (extractor.extract(image, None).xy_px for extractor in (whole, reduced))
    assert 100 < len(b) < len(a)
    away = b[:, None] - a[None]
    nearest = away[np.arange(len(b)), np.linalg.norm(away, axis=2).argmin(1)]
    close = nearest[np.linalg.norm(nearest, axis=1) < 1.5]
    assert len(close) > 0.7 * len(b)
    assert (np.abs(np.median(close, axis=0)) < 0.05).all()
    # Images of other sizes are extracted as before.
    other = texture(SIZES["poor"], 2.5, 0)
    np.testing.assert_array_equal(reduced.extract(other, None).xy_px, whole.extract(other, None).xy_px)
    assert at_sizes(whole, {}) is whole
    assert drive.images


@pytest.mark.parametrize(
    ("size", "side_px"),
    [
        ((1242, 375), 621),
        pytest.param((1920, 1208), 800, marks=pytest.mark.slow),
        pytest.param((1920, 1208), 1131, marks=pytest.mark.slow),
    ],
)
def test_reducing_moves_nothing_up_or_down(size: tuple[int, int], side_px: int) -> None:
    """Sides that do not come out whole are rounded, and content must follow the rounded side to the last row."""
    image, (width, height) = np.full((size[1], size[0], 3), 60, np.uint8), size
    yy, xx = np.mgrid[: size[1], : size[0]] + 0.5
    centres = [(x, y) for y in (40.3, height / 2, height - 40.7) for x in np.arange(60.0, width - 60.0, 97.3)]
    sigmas_px = np.linspace(4.0, 8.0, 7)
    gray = sum(
        150 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / (2 * sigmas_px[k % 7] ** 2)) for k, (x, y) in enumerate(centres)
    )
    image += gray.astype(np.uint8)[..., None]
    found = SiftExtractor(FeatureConfig(max_side_px=side_px)).extract(image, None).xy_px
    for row in (40.3, height / 2, height - 40.7):
        near = [found[np.linalg.norm(found - c, axis=1).argmin()] - c for c in centres if c[1] == row]
        near = [d for d in near if np.linalg.norm(d) < 2.0]
        assert len(near) > len(centres) / 6
        off = np.median(near, axis=0)
        assert (np.abs(off) < 0.08).all(), (row, off)


def test_what_will_be_masked_does_not_count_either(tmp_path: Path) -> None:
    """The own car, and what a segmenter takes for something that moves."""
    drive = write_drive(tmp_path, {"rich": 1.0})
    extractor, bonnet = SiftExtractor(FeatureConfig(max_keypoints=700)), np.ones((480, 640), np.bool_)
    bonnet[:16] = False
    assert find_sides(drive, extractor, max_keypoints=700, threads=1) == {SIZES["rich"]: 320}
    assert find_sides(drive, extractor, max_keypoints=700, threads=1, own_cars=[bonnet]) == {}

    class Cars:
        def segment(self, rgb: np.ndarray) -> np.ndarray:
            return np.where(np.arange(rgb.shape[0])[:, None] < 16, 2, 13).repeat(rgb.shape[1], 1).astype(np.uint8)

    assert find_sides(drive, extractor, max_keypoints=700, threads=1, segmenter=Cars()) == {}


def test_images_that_cannot_be_read_say_nothing(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"rich": 1.0})
    (tmp_path / "rich0.png").write_bytes(b"no image")
    assert sides(drive, 400) == {SIZES["rich"]: 320}
    for unit in range(UNITS):
        (tmp_path / f"rich{unit}.png").write_bytes(b"no image")
    assert sides(drive, 400) == {}


def test_a_long_drive_is_sampled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = write_drive(tmp_path, {"rich": 1.0})
    frames = [
        drive.manifest.frames[k % UNITS].model_copy(update={"timestamp_us": k * 100_000, "source_frame": k})
        for k in range(100)
    ]
    counted, count = list[int](), SiftExtractor.count

    def counting(self: SiftExtractor, rgb: np.ndarray, mask: np.ndarray | None) -> int:
        counted.append(1)
        return count(self, rgb, mask)

    monkeypatch.setattr(SiftExtractor, "count", counting)
    long = Drive(tmp_path, drive.manifest.model_copy(update={"frames": frames}))
    assert sides(long, 400) == {SIZES["rich"]: 320}
    assert len(counted) == SAMPLED_IMAGES


def test_cancelling_stops_the_search(tmp_path: Path) -> None:
    with pytest.raises(CancelledError):
        find_sides(
            write_drive(tmp_path, {"rich": 1.0}),
            SiftExtractor(FeatureConfig()),
            max_keypoints=2048,
            threads=1,
            cancel=lambda: True,
        )


def run_of(drive: Drive, out: Path, contents: dict[str, str] | None = None, **features: int) -> stages.Run:
    config = EngineConfig.model_validate({"threads": 1, "features": {"max_keypoints": 400, **features}})
    return stages.Run(drive, config, stages.store_of(out), lambda *_: None, lambda: False, contents)


def test_a_run_finds_the_size_once_for_all_its_parts(tmp_path: Path) -> None:
    drive, out = write_drive(tmp_path / "drive", {"rich": 1.0}), tmp_path / "scene"
    contents = dict.fromkeys((image.file for image in drive.images), "sha")
    run = run_of(drive, out, contents)
    stages.extraction_sizes(run)
    assert run.report["extraction_size"]["images"] == [{"width": 640, "height": 480, "reduced_to_side_px": 320}]
    for image in drive.images:
        (drive.root / image.file).unlink()  # a worker has the images of its own part
    part = run_of(drive, out, contents)
    part.is_planned = True
    stages.extraction_sizes(part)
    assert part.side_px == run.side_px == {SIZES["rich"]: 320}
    unplanned = run_of(drive, tmp_path / "other", contents)
    unplanned.is_planned = True
    with pytest.raises(StorageError, match="plan"):
        stages.extraction_sizes(unplanned)


def test_a_size_that_the_settings_name_is_taken(tmp_path: Path) -> None:
    run = run_of(write_drive(tmp_path / "drive", {"rich": 1.0}), tmp_path / "scene", max_side_px=640)
    stages.extraction_sizes(run)
    assert not run.side_px
    assert "extraction_size" not in run.report
    assert run.feature_settings != run_of(run.drive, tmp_path / "scene").feature_settings
