from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.features.extraction import extract_features
from mrasfm_engine.features.sift import SiftExtractor
from mrasfm_engine.scene.drive import Drive, LeftOut
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.scene.semantics import ROAD, UNKNOWN
from schemas import Camera, DriveManifest, Frame, FrameImage, Pose, Rig
from tests.helpers.damaged_images import cut

WIDTH, HEIGHT = 800, 600


def blobs(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """An image of round blobs and their centres, where the centre of the top left pixel is at (0.5, 0.5)."""
    image, centres = np.full((HEIGHT, WIDTH), 60.0), []
    for gy in range(40, HEIGHT - 40, 40):
        for gx in range(40, WIDTH - 40, 40):
            x, y = gx + rng.uniform(-5, 5), gy + rng.uniform(-5, 5)
            s = rng.uniform(1.2, 4.0)
            row, column = int(y) - 25, int(x) - 25  # what is farther off is less than a grey level
            yy, xx = np.mgrid[row : row + 50, column : column + 50] + 0.5
            image[row : row + 50, column : column + 50] += 120 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / (2 * s * s))
            centres.append((x, y))
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2), np.array(centres)


def offsets(xy_px: np.ndarray, centres: np.ndarray) -> np.ndarray:
    d = xy_px[:, None] - centres[None]
    nearest = d[np.arange(len(xy_px)), np.abs(d).sum(2).argmin(1)]
    return nearest[np.linalg.norm(nearest, axis=1) < 2.0]


@pytest.mark.parametrize("max_side_px", [1600, 600])
def test_keypoints_lie_at_the_centres_of_blobs_without_bias(max_side_px: int) -> None:
    # A quarter of a pixel, which OpenCV's default is off, turns cameras against one another by 0.02 deg.
    image, centres = blobs(np.random.default_rng(0))
    features = SiftExtractor(FeatureConfig(max_side_px=max_side_px)).extract(image, None)
    off = offsets(features.xy_px, centres)
    assert len(off) > 200
    assert (np.abs(np.median(off, axis=0)) < 0.02).all()
    assert 0.0 < float(np.abs(off).mean()) < 0.2


def test_descriptors_are_root_sift_times_512() -> None:
    image, _ = blobs(np.random.default_rng(1))
    features = SiftExtractor(FeatureConfig(max_keypoints=100)).extract(image, None)
    lengths = np.linalg.norm(features.descriptors.astype(float), axis=1)
    assert len(lengths) == 100
    assert (np.abs(lengths - 512) < 20).mean() > 0.95


def test_nothing_is_extracted_where_the_mask_says_so() -> None:
    image, _ = blobs(np.random.default_rng(2))
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, : WIDTH // 2] = False
    features = SiftExtractor(FeatureConfig()).extract(image, mask)
    assert len(features.xy_px) > 50
    assert features.xy_px[:, 0].min() > WIDTH // 2 - 1


@pytest.mark.parametrize("max_side_px", [1600, 600, 333])
def test_a_reduced_image_is_masked_by_every_pixel_of_the_mask(max_side_px: int) -> None:
    image, _ = blobs(np.random.default_rng(4))
    mask = np.random.default_rng(5).random((HEIGHT, WIDTH)) < 0.5
    extractor = SiftExtractor(FeatureConfig(max_side_px=max_side_px, max_keypoints=100_000))
    everywhere, masked = extractor.extract(image, None).xy_px, extractor.extract(image, mask).xy_px
    column, row = everywhere.astype(int).T
    expected = everywhere[mask[row, column]]
    assert 50 < len(expected) < len(everywhere) - 50
    assert sorted(masked.tolist()) == sorted(expected.tolist())
    assert extractor.count(image, mask) == len(expected)


def test_an_empty_image_has_no_keypoints() -> None:
    features = SiftExtractor(FeatureConfig()).extract(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), None)
    assert features.xy_px.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)


def make_drive(folder: Path, width: int = WIDTH) -> Drive:
    image, _ = blobs(np.random.default_rng(3))
    frames = []
    for i in range(3):  # the same pixels in other bytes
        cv2.imwrite(str(folder / f"{i}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, i + 1])
        frames.append(Frame(timestamp_us=i * 100_000, source_frame=i, images={"cam": FrameImage(file=f"{i}.png")}))
    camera = Camera(
        name="cam",
        model="SIMPLE_PINHOLE",
        width=width,
        height=HEIGHT,
        params=[700.0, width / 2, HEIGHT / 2],
        rig_from_cam=Pose(rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0]),
    )
    return Drive(folder, DriveManifest(name="blobs", rig=Rig(cameras=[camera]), frames=frames))


def test_all_images_are_extracted_in_order_with_progress(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    drive = make_drive(tmp_path)
    found = extract_features(
        drive, SiftExtractor(FeatureConfig()), threads=2, progress=lambda done, total: steps.append((done, total))
    )
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert (found[0].xy_px == found[2].xy_px).all()


def test_an_image_of_another_size_than_its_camera_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"0\.png has 800x600 pixels, its camera cam 820x600"):
        extract_features(make_drive(tmp_path, width=820), SiftExtractor(FeatureConfig()), threads=1)


def test_cancelling_stops_the_extraction(tmp_path: Path) -> None:
    with pytest.raises(CancelledError):
        extract_features(make_drive(tmp_path), SiftExtractor(FeatureConfig()), threads=1, cancel=lambda: True)


def test_the_drives_masks_keep_keypoints_off_moving_things(tmp_path: Path) -> None:
    drive = make_drive(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 2, np.uint8)  # Cityscapes: building
    mask[:, WIDTH // 2 :] = 13  # car
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    first = drive.manifest.frames[0]
    masked = first.model_copy(update={"images": {"cam": FrameImage(file="0.png", mask="mask.png")}})
    manifest = drive.manifest.model_copy(update={"frames": [masked, *drive.manifest.frames[1:]]})
    found = extract_features(Drive(tmp_path, manifest), SiftExtractor(FeatureConfig()), threads=1)
    assert 50 < len(found[0].xy_px) < len(found[1].xy_px)
    assert found[0].xy_px[:, 0].max() < WIDTH // 2 + 1
    assert found[1].xy_px[:, 0].max() > WIDTH // 2 + 100


def test_a_segmenter_masks_images_that_have_no_mask(tmp_path: Path) -> None:
    class RightHalfIsACar:
        def __init__(self) -> None:
            self.images = 0

        def segment(self, rgb: np.ndarray) -> np.ndarray:
            self.images += 1
            classes = np.full(rgb.shape[:2], 2, np.uint8)
            classes[:, WIDTH // 2 :] = 13
            return classes

    drive = make_drive(tmp_path)
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((HEIGHT, WIDTH), 2, np.uint8))
    first = drive.manifest.frames[0]
    masked = first.model_copy(update={"images": {"cam": FrameImage(file="0.png", mask="mask.png")}})
    manifest = drive.manifest.model_copy(update={"frames": [masked, *drive.manifest.frames[1:]]})
    segmenter = RightHalfIsACar()
    found = extract_features(Drive(tmp_path, manifest), SiftExtractor(FeatureConfig()), threads=1, segmenter=segmenter)
    assert segmenter.images == 2
    assert found[0].xy_px[:, 0].max() > WIDTH // 2 + 100
    assert found[1].xy_px[:, 0].max() < WIDTH // 2 + 1
    assert len(found[1].xy_px) > 50


def masked_drive(tmp_path: Path, mask: np.ndarray) -> Drive:
    """Of two images of which the first has a mask."""
    drive = make_drive(tmp_path)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    first = drive.manifest.frames[0]
    masked = first.model_copy(update={"images": {"cam": FrameImage(file="0.png", mask="mask.png")}})
    return Drive(tmp_path, drive.manifest.model_copy(update={"frames": [masked, *drive.manifest.frames[1:]]}))


def test_keypoints_have_the_class_of_the_mask_and_none_near_its_borders(tmp_path: Path) -> None:
    plain = extract_features(make_drive(tmp_path), SiftExtractor(FeatureConfig()), threads=1)[0]
    border = int(np.median(plain.xy_px[:, 1]))  # so that there are keypoints on both sides and near it
    mask = np.full((HEIGHT, WIDTH), 2, np.uint8)  # Cityscapes: building
    mask[border:] = 0  # road
    drive = masked_drive(tmp_path, mask)
    first, second, *_ = extract_features(drive, SiftExtractor(FeatureConfig()), threads=1, class_margin_px=5)
    # Which keypoints there are does not depend on classes that may all have keypoints.
    np.testing.assert_array_equal(first.xy_px, plain.xy_px)
    row, radius_px = first.xy_px[:, 1], first.radius_px
    assert radius_px is not None
    assert (first.classes[row < border - 6 - radius_px] == 1).all()
    assert (first.classes[row > border + 6 + radius_px] == ROAD).all()
    near = np.abs(row - border) < 4 + radius_px
    assert (near & (np.abs(row - border) > 6)).any()
    assert (first.classes[near] == UNKNOWN).all()
    # Masks for some images only: the others' keypoints have no class.
    assert len(second.classes) == len(second.xy_px) > 50
    assert (second.classes == UNKNOWN).all()


def test_a_mask_of_another_size_is_refused_by_name(tmp_path: Path) -> None:
    drive = masked_drive(tmp_path, np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    with pytest.raises(InputError, match=r"mask mask\.png has .* pixels, its image has") as caught:
        extract_features(drive, SiftExtractor(FeatureConfig()), threads=1)
    assert caught.value.code == "mask-size"


def test_an_image_of_which_pixels_are_missing_is_left_out(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The others stay where they are; a mask of it is of no interest."""
    drive = masked_drive(tmp_path, np.full((HEIGHT, WIDTH), 2, np.uint8))
    (tmp_path / "0.png").write_bytes(cut((tmp_path / "0.png").read_bytes()))
    found = extract_features(drive, SiftExtractor(FeatureConfig()), threads=2)
    assert [f.left_out for f in found] == [LeftOut.TRUNCATED, None, None]
    assert [len(f.xy_px) > 50 for f in found] == [False, True, True]
    assert len(found[0].xy_px) == len(found[0].descriptors) == len(found[0].colors) == 0
    capfd.readouterr()  # the decoder's own complaint


def test_an_image_that_is_the_one_before_once_more_is_left_out(tmp_path: Path) -> None:
    drive, repeated = make_drive(tmp_path), ["1.png", "2.png"]
    found = extract_features(drive, SiftExtractor(FeatureConfig()), threads=2, repeated=repeated)
    assert [f.left_out for f in found] == [None, LeftOut.REPEATED, LeftOut.REPEATED]
    assert [len(f.xy_px) > 50 for f in found] == [True, False, False]


def test_what_is_left_out_has_features_of_the_others_kind(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    class Learned:
        def extract(self, rgb: np.ndarray, mask: np.ndarray | None) -> ImageFeatures:
            points = np.ones((3, 2), np.float32)
            return ImageFeatures(
                xy_px=points,
                descriptors=np.ones((3, 64), np.float32),
                colors=np.ones((3, 3), np.uint8),
                scores=np.ones(3, np.float32),
            )

    drive = make_drive(tmp_path)
    (tmp_path / "1.png").write_bytes(cut((tmp_path / "1.png").read_bytes()))
    found = extract_features(drive, Learned(), threads=1)
    assert np.concatenate([f.descriptors for f in found]).shape == (6, 64)
    assert found[1].descriptors.dtype == np.float32
    assert found[1].scores is not None
    capfd.readouterr()


def test_a_truncated_mask_is_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    drive = masked_drive(tmp_path, np.random.default_rng(0).integers(0, 19, (HEIGHT, WIDTH), dtype=np.uint8))
    (tmp_path / "mask.png").write_bytes(cut((tmp_path / "mask.png").read_bytes()))
    with pytest.raises(InputError, match=r"mask\.png is truncated"):
        extract_features(drive, SiftExtractor(FeatureConfig()), threads=1)
    capfd.readouterr()


def test_keypoints_cover_the_image_although_the_strongest_crowd() -> None:
    texture = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(HEIGHT, WIDTH)), (0, 0), 2.0)
    texture *= 40 / texture.std()
    contrast = np.full((HEIGHT, WIDTH), 0.7)
    contrast[:240, :320] = 1.0
    faint = np.repeat(np.clip(128 + contrast * texture, 0, 255)[..., None], 3, axis=2)
    shares = {}
    for spread in (True, False):
        config = FeatureConfig(max_keypoints=600, spread=spread)
        xy = SiftExtractor(config).extract(np.round(faint).astype(np.uint8), None).xy_px
        assert len(xy) == 600
        shares[spread] = ((xy[:, 0] < 320) & (xy[:, 1] < 240)).mean()
    assert 0.1 < shares[True] < 0.75 * shares[False]


@pytest.mark.parametrize("side_px", [240, 120])
def test_the_radius_of_a_disc_is_that_in_the_image_also_where_it_is_reduced(side_px: int) -> None:
    image = np.full((240, 240), 60, np.uint8)
    cv2.circle(image, (120, 120), 18, 200, -1, cv2.LINE_AA)
    found = SiftExtractor(FeatureConfig()).with_side(side_px).extract(np.dstack([image] * 3), None)
    middle = np.linalg.norm(found.xy_px - 120.5, axis=1) < 2.0
    assert middle.any()
    assert found.radius_px is not None
    np.testing.assert_allclose(found.radius_px[middle], 18.5, rtol=0.1)
