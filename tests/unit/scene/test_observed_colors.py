from __future__ import annotations

import numpy as np

from mrasfm_engine.scene.scene import ImageFeatures, observed_colors


def features(colors: np.ndarray) -> ImageFeatures:
    count = len(colors)
    return ImageFeatures(
        xy_px=np.zeros((count, 2), np.float32), descriptors=np.zeros((count, 128), np.uint8), colors=colors
    )


def test_colours_are_those_of_the_keypoints_in_their_images() -> None:
    rng = np.random.default_rng(0)
    of_images = [features(rng.integers(0, 256, (count, 3), dtype=np.uint8)) for count in (5, 0, 7, 3)]
    image = rng.choice([0, 2, 3], 40)
    keypoint = np.array([rng.integers(len(of_images[i].colors)) for i in image])
    found = observed_colors(of_images, image, keypoint)
    assert np.array_equal(found, [of_images[i].colors[k] for i, k in zip(image, keypoint, strict=True)])


def test_no_observation_has_no_colour() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert observed_colors([features(np.zeros((2, 3), np.uint8))], none, none).shape == (0, 3)
