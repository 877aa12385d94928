from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.features.segmentation import OnnxSegmenter
from mrasfm_engine.learned.network import Network
from schemas import LabelMap, SemanticClass
from tests.helpers import learned_graphs

CAR, BUILDING = 13, 2


def half_bright(height: int = 75, width: int = 101) -> np.ndarray:
    image = np.full((height, width, 3), 40, np.uint8)
    image[:, 60:] = 220
    return image


def test_a_network_of_free_size_says_what_every_pixel_shows() -> None:
    classes = OnnxSegmenter(Network("s", learned_graphs.segmenter(), gpu=False), None).segment(half_bright())
    assert classes.dtype == np.uint8
    np.testing.assert_array_equal(classes, np.where(np.arange(101) >= 60, CAR, BUILDING)[None].repeat(75, axis=0))


@pytest.mark.parametrize("window", [(32, 64), (128, 256)])
def test_a_network_of_fixed_size_gets_a_resized_image(window: tuple[int, int]) -> None:
    classes = OnnxSegmenter(Network("s", learned_graphs.segmenter(*window), gpu=False), None).segment(half_bright())
    assert classes.shape == (75, 101)
    border = (classes == CAR).argmax(axis=1)
    assert (np.abs(border - 60) <= 2).all()
    assert set(np.unique(classes)) == {BUILDING, CAR}


def test_an_id_that_the_label_map_lacks_is_refused() -> None:
    network = Network("s", learned_graphs.segmenter(bright=77), gpu=False)
    with pytest.raises(InputError, match="model s gives the id 77"):
        OnnxSegmenter(network, None).segment(half_bright())
    known = LabelMap(ids={2: SemanticClass.SKY, 77: SemanticClass.DYNAMIC})
    assert 77 in OnnxSegmenter(network, known).segment(half_bright())
