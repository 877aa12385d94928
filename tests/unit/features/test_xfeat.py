"""XFeat and LighterGlue with their real weights on a real drive: coordinates, ranges and units, found by experiment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.learned.model_folder import ModelFolder
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.network_matcher import NetworkMatcher
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.registry import Components, load_components
from mrasfm_engine.scene.scene import ImageFeatures

pytestmark = pytest.mark.real

FOCAL_PX, CENTRE_PX = 707.09, np.array([602.4, 183.6])  # KITTI 06, pixel centres at 0.5


@pytest.fixture(scope="module")
def models(shared_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    weights = shared_folder / "weights" / "xfeat"
    if not weights.is_dir():
        pytest.skip(f"weights are missing: {weights}")
    folder = ModelFolder(tmp_path_factory.mktemp("models"))
    names = [folder.add(weights / f).name for f in ("xfeat_2048_640x360.onnx", "lighterglue_L3.onnx")]
    assert names == ["xfeat", "xfeat-lighterglue"]
    assert all(model.is_published for model in folder.installed())
    return folder.path


def components(models: Path, **features: object) -> Components:
    config = {"models": {"folder": models}, "matching": {"matcher": "lighterglue"}}
    return load_components(
        EngineConfig.model_validate({"features": {"extractor": "xfeat", **features}, **config}), None
    )


@pytest.fixture(scope="module")
def image(shared_data: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(shared_data / "kitti06" / "image_0" / "000020.png")), dtype=np.uint8)


@pytest.fixture(scope="module")
def found(models: Path, image: np.ndarray) -> ImageFeatures:
    return components(models).extractor.extract(image, None)


def offsets(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """From places of a to the nearest of b, where there is one: (n, 2)."""
    distance, nearest = cKDTree(b).query(a)
    near = distance < 1.5
    result: np.ndarray = (b[nearest] - a)[near]
    return result


def test_many_keypoints_all_over_the_image_none_twice(found: ImageFeatures, image: np.ndarray) -> None:
    height, width = image.shape[:2]
    assert len(found.xy_px) == 2048
    # All four tiles, and the part of their rows that the image fills.
    counts, _ = np.histogram(found.xy_px[:, 0], bins=8, range=(0, width))
    assert counts.min() > 50
    assert 0 <= found.xy_px[:, 1].min() < 60
    assert height - 60 < found.xy_px[:, 1].max() <= height
    assert len(cKDTree(found.xy_px).query_pairs(0.5)) == 0
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-3)


def test_what_is_matched_covers_the_image(models: Path, image: np.ndarray, found: ImageFeatures) -> None:
    strongest = components(models, spread=False).extractor.extract(image, None)
    cells = [len(np.unique(f.xy_px[:1024] // 32, axis=0)) for f in (strongest, found)]
    assert cells[1] > 1.25 * cells[0]
    # The road before the vehicle, where an image has its nearest points.
    near = [(f.xy_px[:1024, 1] > 0.75 * image.shape[0]).sum() for f in (strongest, found)]
    assert near[1] > 1.25 * near[0]


@pytest.mark.parametrize("refine", [True, False])
def test_a_shifted_image_has_shifted_keypoints_without_bias(models: Path, image: np.ndarray, refine: bool) -> None:
    extractor = components(models, refine=refine).extractor
    whole = extractor.extract(image, None).xy_px
    each = []
    for shift in ((3, 5), (18, 13)):
        part = extractor.extract(np.ascontiguousarray(image[shift[1] :, shift[0] :]), None)
        each.append(offsets(whole, part.xy_px + np.array(shift)))
    off = np.concatenate(each)
    assert len(off) > 1000
    assert (np.abs(off.mean(axis=0)) < (0.005 if refine else 0.15)).all()
    # Unrefined, the network's cells move keypoints: that is what the refinement is for.
    spread = np.abs(off).mean()
    assert spread < 0.01 if refine else 0.1 < spread < 0.6


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_image_has_mirrored_keypoints(
    models: Path, image: np.ndarray, found: ImageFeatures, axis: int
) -> None:
    """Half a pixel too much to the right would be half a pixel too much to the left here: a whole pixel apart."""
    size = image.shape[1 - axis]
    mirrored = components(models).extractor.extract(np.ascontiguousarray(np.flip(image, 1 - axis)), None).xy_px
    mirrored[:, axis] = size - mirrored[:, axis]
    off = offsets(found.xy_px, mirrored)
    assert len(off) > 500
    assert (np.abs(off.mean(axis=0)) < 0.01).all()


def test_an_image_at_half_size_has_keypoints_at_the_same_places(
    models: Path, image: np.ndarray, found: ImageFeatures
) -> None:
    """Wrong pixel centres would be off by half a pixel of the smaller image, one of the larger."""
    half = components(models, max_side_px=image.shape[1] // 2).extractor.extract(image, None).xy_px
    off = offsets(found.xy_px, half)
    assert len(off) > 80
    assert (np.abs(off.mean(axis=0)) < 0.2).all()


def test_masked_areas_hold_no_keypoints_and_the_rest_all_that_are_wanted(models: Path, image: np.ndarray) -> None:
    mask = np.ones(image.shape[:2], np.bool_)
    mask[:, 300:] = False
    masked = components(models, max_keypoints=256).extractor.extract(image, mask)
    assert len(masked.xy_px) == 256
    assert masked.xy_px[:, 0].max() <= 300


def test_brightness_may_be_0_to_1_or_0_to_255(models: Path, image: np.ndarray) -> None:
    """The network normalises by itself: the range that we give is no guess that could be wrong."""
    network = components(models).models["extractor"].network
    part = np.zeros((1, 3, 640, 360), np.float32)
    part[0, :, :370] = image[:, :360].transpose(2, 0, 1)
    small, large = (network.run({"images": part / scale})["keypoints"] for scale in (255.0, 1.0))
    both = {tuple(p) for p in small.round().tolist()} & {tuple(p) for p in large.round().tolist()}
    assert 0.97 * len(small) < len(both) <= len(small)


@pytest.mark.slow
def test_lighterglue_gets_the_units_it_was_trained_with(models: Path, shared_data: Path, found: ImageFeatures) -> None:
    """Six frames on, keypoints in pixels match worse, and nearest neighbours find fewer."""
    loaded = components(models)
    later = np.asarray(cv2.imread(str(shared_data / "kitti06" / "image_0" / "000026.png")), dtype=np.uint8)
    pair = [found, loaded.extractor.extract(later, None)]
    rays = [np.concatenate([(f.xy_px - CENTRE_PX) / FOCAL_PX, np.ones((len(f.xy_px), 1))], axis=1) for f in pair]
    rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]

    def verified(matches: np.ndarray) -> int:
        return int(essential_inliers(rays[0][matches[:, 0]], rays[1][matches[:, 1]], max_error=2.0 / FOCAL_PX).sum())

    matcher = loaded.matcher
    assert isinstance(matcher, NetworkMatcher)
    size = {"width": later.shape[1], "height": later.shape[0]}
    trained = [matcher.prepare(f, **size) for f in pair]
    in_pixels = [replace(p, xy=f.xy_px[None, : p.count]) for p, f in zip(trained, pair, strict=True)]
    right, wrong = (verified(matcher.match(*p)) for p in (trained, in_pixels))
    nearest = NearestNeighbourMatcher(EngineConfig().matching)
    strongest = [
        ImageFeatures(xy_px=f.xy_px[:1024], descriptors=f.descriptors[:1024], colors=f.colors[:1024]) for f in pair
    ]
    plain = verified(nearest.match(*(nearest.prepare(f) for f in strongest)))
    assert 60 < right <= 1024
    assert wrong < 0.9 * right
    assert plain < 0.8 * right


@pytest.mark.parametrize("brightness", [0, 128, 255])
def test_an_image_that_shows_nothing_has_no_keypoints_though_the_exported_network_fails_on_it(
    models: Path, brightness: int
) -> None:
    extract = components(models).extractor.extract
    assert len(extract(np.full((370, 1226, 3), brightness, np.uint8), None).xy_px) == 0
    half = np.zeros((370, 1226, 3), np.uint8)
    half[100:160, 1100:1180] = np.random.default_rng(0).integers(0, 255, (60, 80, 1))
    there = extract(half, None).xy_px
    assert len(there) > 20  # in one tile, while others show nothing
    assert ((there > [1090, 90]) & (there < [1190, 170])).all()
