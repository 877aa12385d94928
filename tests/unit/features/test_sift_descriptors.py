from __future__ import annotations

import cv2
import numpy as np
import pytest

from mrasfm_engine.features.sift_descriptors import describe
from mrasfm_engine.features.sift_keypoints import Keypoints, find_keypoints
from mrasfm_engine.features.sift_scale_space import LEVELS, scale_space
from tests.helpers.textured_image import textured


def described(gray: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    return describe(keypoints, [gradients for octave in scale_space(gray) for gradients in octave.gradients])


def found(gray: np.ndarray) -> Keypoints:
    return find_keypoints(gray, least_contrast=0.02)[0]


def at(*rows: tuple[float, float, float, float, int]) -> Keypoints:
    """Keypoints by x, y, sigma, direction and level."""
    x, y, sigma_px, direction_rad, level = np.array(rows).T
    return Keypoints(np.column_stack([x, y]), sigma_px, np.ones(len(x)), level.astype(int), direction_rad)


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-9)


def test_descriptors_say_what_opencvs_do_at_every_octave() -> None:
    gray = textured()
    theirs, their_descriptors = cv2.SIFT.create(enable_precise_upscale=True).detectAndCompute(gray, None)
    # OpenCV packs the octave, with a sign, and the level into one number; its octave -1 is the first.
    octaves = np.array([(k.octave + 128) % 256 - 127 for k in theirs])
    levels = LEVELS * octaves + np.array([k.octave // 256 % 256 for k in theirs]) - 1
    rows = [(*k.pt, k.size / 2.0, np.deg2rad(k.angle), level) for k, level in zip(theirs, levels, strict=True)]
    ours = described(gray, at(*rows))
    same = cosines(ours, their_descriptors)
    for octave in range(5):
        assert (octaves == octave).any()
        assert np.percentile(same[octaves == octave], 5) > 0.98, octave
    assert np.median(same) > 0.995
    assert np.median(cosines(ours[1:], their_descriptors[:-1])) < 0.8  # what 0.98 is worth


def test_a_turned_image_has_the_same_descriptors() -> None:
    gray = textured(1)
    keypoints = found(gray)
    x, y = keypoints.xy_px.T
    turned = Keypoints(
        np.column_stack([y, gray.shape[1] - 1 - x]),
        keypoints.sigma_px,
        keypoints.contrast,
        keypoints.level,
        (keypoints.direction_rad - np.pi / 2) % (2 * np.pi),
    )
    # The pixels of a level are those that counting begins with at the corner, which is another one now.
    same = cosines(described(gray, keypoints), described(np.rot90(gray).copy(), turned))
    assert np.median(same) > 0.99
    assert np.median(cosines(described(gray, keypoints), described(gray, turned))) < 0.8


def test_contrast_changes_no_descriptor() -> None:
    gray = textured(2) // 4
    keypoints = found(textured(2))
    once, twice = described(gray, keypoints), described((20 + 2 * gray).astype(np.uint8), keypoints)
    assert cosines(once, twice) == pytest.approx(1.0, abs=1e-5)


def test_no_number_of_a_descriptor_outweighs_the_others() -> None:
    edge = np.zeros((64, 64), np.uint8)
    edge[:, 32:] = 200
    (descriptor,) = described(edge, at((31.5, 31.5, 2.0, 0.0, 2)))
    assert (descriptor >= 0).all()
    # Eight cells see the edge, the middle ones almost twice as much of it: each has more than a fifth.
    assert np.sort(descriptor)[-8:] == pytest.approx(descriptor.max(), rel=1e-5)
    assert descriptor.max() > 2.0 * np.sort(descriptor)[-9]


@pytest.mark.parametrize("shape", [(6, 6), (6, 50), (50, 6), (24, 31)])
def test_keypoints_on_the_borders_of_tiny_images(shape: tuple[int, int]) -> None:
    gray = textured()[: shape[0], : shape[1]].copy()
    keypoints = at(
        *(
            (x, y, sigma, direction, 0)
            for x in (0, shape[1] - 1)
            for y in (0, shape[0] - 1)
            for sigma in (1.0, 4.0, 250.0)
            for direction in (0.0, np.pi / 2, 1.0)
        )
    )
    descriptors = described(gray, keypoints)
    assert descriptors.shape == (len(keypoints), 128)
    assert np.isfinite(descriptors).all()


def test_a_flat_image_and_no_keypoints() -> None:
    flat = np.full((60, 80), 90, np.uint8)
    assert not described(flat, at((40.0, 30.0, 1.5, 0.0, 0))).any()
    assert described(flat, found(flat)).shape == (0, 128)
