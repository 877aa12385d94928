"""Coordinates, tiles, masks and numbers, on small graphs whose keypoints are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.aliked import AlikedDetector
from mrasfm_engine.features.network_extractor import Detector, NetworkExtractor
from mrasfm_engine.features.superpoint import SuperPointDetector
from mrasfm_engine.features.xfeat import XFeatDetector
from mrasfm_engine.learned.network import Network
from tests.helpers import learned_graphs

HEIGHT, WIDTH = 150, 333
SPACING = 16


def dots(rng: np.random.Generator, height: int = HEIGHT, width: int = WIDTH) -> tuple[np.ndarray, np.ndarray]:
    """Bright pixels of many brightnesses and their centres, where the top left pixel's is (0.5, 0.5)."""
    image, centres = np.full((height, width, 3), 30, np.uint8), []
    for row in range(6, height - 6, SPACING):
        for column in range(6, width - 6, SPACING):
            y, x = row + rng.integers(-3, 4), column + rng.integers(-3, 4)
            image[y, x] = rng.integers(150, 250)
            centres.append((x + 0.5, y + 0.5))
    return image, np.array(centres)


def sorted_rows(xy: np.ndarray) -> np.ndarray:
    return xy[np.lexsort(np.round(xy, 1).T)]


MakeDetector = Callable[[], Detector]


def xfeat_tiles() -> Detector:
    return XFeatDetector(Network("xfeat", learned_graphs.xfeat(64, 96), gpu=False))


def superpoint_tiles() -> Detector:
    return SuperPointDetector(Network("superpoint", learned_graphs.superpoint(96, 128), gpu=False))


def superpoint_whole() -> Detector:
    return SuperPointDetector(Network("superpoint", learned_graphs.superpoint(), gpu=False))


def aliked_whole() -> Detector:
    return AlikedDetector(Network("aliked", learned_graphs.aliked(), gpu=False))


ALL = [xfeat_tiles, superpoint_tiles, superpoint_whole, aliked_whole]


def extractor(make: MakeDetector, *, spread: bool = False, **settings: float) -> NetworkExtractor:
    return NetworkExtractor(make(), FeatureConfig(refine=False, spread=spread, **settings))


@pytest.mark.parametrize("make", ALL)
def test_every_dot_is_found_once_and_exactly_where_it_is(make: MakeDetector) -> None:
    image, centres = dots(np.random.default_rng(0))
    found = extractor(make).extract(image, None)
    assert found.xy_px.dtype == found.descriptors.dtype == np.float32
    np.testing.assert_allclose(sorted_rows(found.xy_px), sorted_rows(centres), atol=2e-4)
    assert found.scores is not None
    assert (np.diff(found.scores) <= 0).all()
    column, row = (found.xy_px - 0.5).round().astype(int).T
    np.testing.assert_array_equal(found.colors, image[row, column])
    np.testing.assert_allclose(found.scores, image[row, column].mean(1) / 255, atol=1e-6)


@pytest.mark.parametrize("make", ALL)
def test_larger_images_are_reduced_and_coordinates_stay_those_of_the_full_image(make: MakeDetector) -> None:
    rng = np.random.default_rng(1)
    small, centres = dots(rng, HEIGHT // 2, WIDTH // 2)
    # Every pixel becomes 2 x 2: what is at (x, y) is at (2 x, 2 y) where pixel centres are at 0.5.
    image = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
    found = extractor(make, max_side_px=small.shape[1]).extract(image, None)
    np.testing.assert_allclose(sorted_rows(found.xy_px), sorted_rows(2 * centres), atol=4e-4)


@pytest.mark.parametrize("make", ALL)
def test_masked_areas_do_not_use_up_the_number(make: MakeDetector) -> None:
    image, centres = dots(np.random.default_rng(2))
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[:, 200:] = True
    # The masked dots are the brighter ones: by strength alone they would be all that is taken.
    image[:, :200][image[:, :200] > 100] = 255
    usable = (centres[:, 0] > 200).sum()
    assert 20 < usable < len(centres) / 2
    found = extractor(make, max_keypoints=int(usable)).extract(image, mask)
    assert len(found.xy_px) == usable
    assert found.xy_px[:, 0].min() > 200


@pytest.mark.parametrize("make", ALL)
def test_the_strongest_are_kept(make: MakeDetector) -> None:
    image, centres = dots(np.random.default_rng(3))
    everything, few = (extractor(make, max_keypoints=n).extract(image, None) for n in (2048, 30))
    assert len(everything.xy_px) == len(centres)
    assert everything.scores is not None
    assert few.scores is not None
    np.testing.assert_array_equal(few.scores, everything.scores[:30])


def test_what_is_kept_covers_the_image() -> None:
    image, centres = dots(np.random.default_rng(5))
    # The brighter ones are all on the right: by strength alone they would be all that is taken.
    image[:, :250][image[:, :250] > 100] = 140
    strongest, spread = (extractor(xfeat_tiles, max_keypoints=40, spread=s).extract(image, None) for s in (False, True))
    assert strongest.xy_px[:, 0].min() > 250
    # Three quarters of the dots are on the left.
    assert 0.5 < (spread.xy_px[:, 0] < 250).mean() < 0.8
    everything = extractor(xfeat_tiles, spread=True).extract(image, None)
    np.testing.assert_allclose(sorted_rows(everything.xy_px), sorted_rows(centres), atol=2e-4)
    assert everything.scores is not None
    column, row = (everything.xy_px - 0.5).round().astype(int).T
    np.testing.assert_allclose(everything.scores, image[row, column].mean(1) / 255, atol=1e-6)


@pytest.mark.parametrize("make", ALL)
def test_weak_keypoints_can_be_left_out(make: MakeDetector) -> None:
    image, _ = dots(np.random.default_rng(4))
    found = extractor(make, min_score=0.8).extract(image, None)
    assert found.scores is not None
    assert 10 < len(found.scores) < 150
    assert found.scores.min() >= 0.8


@pytest.mark.parametrize("make", ALL)
def test_an_empty_image_has_no_keypoints(make: MakeDetector) -> None:
    found = extractor(make).extract(np.full((HEIGHT, WIDTH, 3), 30, np.uint8), None)
    assert found.xy_px.shape == (0, 2)
    assert found.descriptors.shape[0] == 0
    assert found.descriptors.shape[1] in (64, 128, 256)
    assert found.colors.shape == (0, 3)


def with_values(*, keypoint: float = 5.0, descriptor: float = 0.1, score: float = 0.9) -> bytes:
    """SuperPoint that gives 5 keypoints in a row, of which one is as said."""
    graph = learned_graphs.Graph()
    nothing = graph("Mul", graph("ReduceMean", "image", axes=[0, 1, 2, 3], keepdims=0), graph.constant(0.0))

    def output(shape: tuple[int, ...], usual: float, last: float) -> tuple[str, int, learned_graphs.Shape]:
        values = np.full(shape, usual)
        values[0, -1] = last
        return graph("Add", graph.constant(values), nothing), learned_graphs.F32, shape

    return graph.model(
        {"image": (learned_graphs.F32, (1, 1, "H", "W"))},
        {
            "keypoints": output((1, 5, 2), 5.0, keypoint),
            "scores": output((1, 5), 0.9, score),
            "descriptors": output((1, 5, 256), 0.1, descriptor),
        },
    )


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["keypoint", "descriptor", "score"])
def test_outputs_that_are_no_numbers_are_refused_by_name(what: str, value: float) -> None:
    network = Network("own", with_values(**{what: value}), gpu=False)
    with pytest.raises(InputError, match=f"model own gives {what}s that are not finite numbers"):
        extractor(lambda: SuperPointDetector(network)).extract(np.zeros((40, 60, 3), np.uint8), None)


@pytest.mark.filterwarnings("error")
def test_keypoints_far_outside_the_image_are_left_out() -> None:
    network = Network("own", with_values(keypoint=1e30), gpu=False)
    mask = np.ones((40, 60), np.bool_)
    found = extractor(lambda: SuperPointDetector(network)).extract(np.zeros((40, 60, 3), np.uint8), mask)
    assert len(found.xy_px) == 4


def test_the_shrinkage_inside_of_xfeat_is_taken_back() -> None:
    """A window whose sides are no multiples of 32: the network itself scales its pixels up to the window."""
    detector = XFeatDetector(Network("xfeat", learned_graphs.xfeat(64, 96), gpu=False))

    class Shrinking:
        signature, name = detector.network.signature, "xfeat"

        def run(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            assert inputs["images"].shape == (1, 3, 640, 360)
            return {
                "keypoints": np.array([[0, 0], [100 * 360 / 352, 50], [351 * 360 / 352, 639]], np.float32),
                "descriptors": np.zeros((3, 64), np.float32),
                "scores": np.ones(3, np.float32),
            }

    detector.network = Shrinking()
    found = detector.detect(np.zeros((640, 360, 3), np.uint8), 10, None)
    expected = [[0.5 * 360 / 352, 0.5], [100.5 * 360 / 352, 50.5], [360 - 0.5 * 360 / 352, 639.5]]
    np.testing.assert_allclose(found.xy_px, expected, atol=1e-4)
