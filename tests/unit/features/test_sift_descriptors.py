from __future__ import annotations

import cv2
import numpy as np
import pytest

from mrasfm_engine.features.sift_descriptors import sift_descriptors


def textured(seed: int = 0, size: tuple[int, int] = (400, 300)) -> np.ndarray:
    """An image (h, w) with structure at all scales."""
    rng = np.random.default_rng(seed)
    image = np.zeros(size[::-1])
    for sigma in (1.5, 3.0, 6.0, 12.0, 24.0):
        noise = cv2.GaussianBlur(rng.normal(size=size[::-1]), (0, 0), sigma)
        image += noise / noise.std()
    return np.clip(128 + 40 * image, 0, 255).astype(np.uint8)


def detected(gray: np.ndarray) -> list[cv2.KeyPoint]:
    return list(cv2.SIFT.create(nfeatures=4000, enable_precise_upscale=True).detect(gray, None))


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-9)


def test_descriptors_say_what_opencvs_do_at_every_octave() -> None:
    gray = textured()
    keypoints = detected(gray)
    _, theirs = cv2.SIFT.create(enable_precise_upscale=True).compute(gray, keypoints)
    octaves = np.array([(k.octave + 128) % 256 - 128 for k in keypoints])
    same = cosines(sift_descriptors(gray, keypoints), theirs)
    assert set(range(-1, 4)) <= set(octaves)
    for octave in range(-1, 4):
        assert np.percentile(same[octaves == octave], 5) > 0.98, octave
    assert np.median(same) > 0.995
    others = cosines(sift_descriptors(gray, keypoints)[1:], theirs[:-1])
    assert np.median(others) < 0.8  # what 0.98 is worth


def test_a_turned_image_has_the_same_descriptors() -> None:
    gray = textured(1)
    keypoints = detected(gray)
    width = gray.shape[1]
    turned = [
        cv2.KeyPoint(k.pt[1], width - 1 - k.pt[0], k.size, (k.angle - 90.0) % 360.0, k.response, k.octave)
        for k in keypoints
    ]
    # From the second octave on, which pixels remain depends on the corner that counting begins at.
    first = np.array([(k.octave + 128) % 256 - 128 < 0 for k in keypoints])
    same = cosines(sift_descriptors(gray, keypoints), sift_descriptors(np.rot90(gray).copy(), turned))
    assert first.sum() > 100
    assert (same[first] > 0.9999).all()
    assert np.median(same[~first]) > 0.99


def test_contrast_changes_no_descriptor() -> None:
    gray = textured(2) // 2
    keypoints = detected(gray)
    brighter = (20 + 2 * (gray // 2)).astype(np.uint8)
    once, twice = sift_descriptors(gray // 2, keypoints), sift_descriptors(brighter, keypoints)
    assert cosines(once, twice) == pytest.approx(1.0, abs=1e-5)


def test_no_number_of_a_descriptor_outweighs_the_others() -> None:
    edge = np.zeros((64, 64), np.uint8)
    edge[:, 32:] = 200
    (descriptor,) = sift_descriptors(edge, [cv2.KeyPoint(31.5, 31.5, 4.0, 0.0, 1.0, 255 | 1 << 8)])
    assert (descriptor >= 0).all()
    # Eight cells see the edge, the middle ones almost twice as much of it: each has more than a fifth.
    assert np.sort(descriptor)[-8:] == pytest.approx(descriptor.max(), rel=1e-5)
    assert descriptor.max() > 2.0 * np.sort(descriptor)[-9]


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (5, 5), (24, 31)])
def test_tiny_images_and_keypoints_on_their_borders(shape: tuple[int, int]) -> None:
    gray = textured()[: shape[0], : shape[1]].copy()
    keypoints = [
        cv2.KeyPoint(float(x), float(y), size, 33.0, 1.0, packed)
        for x in (0, shape[1] - 1)
        for y in (0, shape[0] - 1)
        for size, packed in ((2.0, 255 | 1 << 8), (8.0, 1 | 3 << 8), (500.0, 4 | 2 << 8))
    ]
    descriptors = sift_descriptors(gray, keypoints)
    assert descriptors.shape == (len(keypoints), 128)
    assert np.isfinite(descriptors).all()


def test_a_flat_image_and_no_keypoints() -> None:
    flat = np.full((60, 80), 90, np.uint8)
    assert not sift_descriptors(flat, [cv2.KeyPoint(40.0, 30.0, 3.0, 0.0, 1.0, 255 | 1 << 8)]).any()
    assert sift_descriptors(flat, []).shape == (0, 128)
