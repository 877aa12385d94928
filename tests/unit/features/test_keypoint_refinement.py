from __future__ import annotations

import cv2
import numpy as np
import pytest

from mrasfm_engine.features.keypoint_refinement import RADIUS_PX, snap_to_extrema

HEIGHT, WIDTH = 200, 300


def blobs(rng: np.random.Generator, sign: int) -> tuple[np.ndarray, np.ndarray]:
    """Round blobs, bright or dark, and their centres."""
    yy, xx = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image, centres = np.full((HEIGHT, WIDTH), 128.0), []
    for row in range(20, HEIGHT - 20, 25):
        for column in range(20, WIDTH - 20, 25):
            x, y = column + rng.uniform(-4, 4), row + rng.uniform(-4, 4)
            image += sign * 90 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / (2 * rng.uniform(1.0, 1.8) ** 2))
            centres.append((x, y))
    return np.clip(np.round(image), 0, 255).astype(np.uint8), np.array(centres, np.float32)


@pytest.mark.parametrize("sign", [1, -1])
def test_keypoints_move_to_the_centres_without_bias(sign: int) -> None:
    rng = np.random.default_rng(0)
    image, centres = blobs(rng, sign)
    start = centres + rng.uniform(-1.5, 1.5, centres.shape).astype(np.float32)
    refined, found = snap_to_extrema(image, start)
    assert found.all()
    off = refined - centres
    assert (np.abs(off.mean(axis=0)) < 0.02).all()
    assert 0.0 < np.abs(off).mean() < 0.08


def test_an_empty_wall_holds_no_keypoint() -> None:
    image = np.random.default_rng(5).integers(60, 62, (100, 100), dtype=np.uint8)
    _, found = snap_to_extrema(cv2.blur(image, (9, 9)), np.array([[20.5, 50.5], [80.2, 20.1]], np.float32))
    assert found.tolist() == [False, False]


def test_of_two_keypoints_at_one_place_the_first_stays() -> None:
    image, centres = blobs(np.random.default_rng(1), 1)
    both = np.concatenate([centres[:3] + 1, centres[:3] - 1]).astype(np.float32)
    refined, found = snap_to_extrema(image, both)
    assert found.tolist() == [True] * 3 + [False] * 3
    np.testing.assert_array_equal(refined[:3], refined[3:])


def test_keypoints_far_from_all_detail_or_at_the_margin_are_not_found() -> None:
    image, centres = blobs(np.random.default_rng(2), 1)
    far = centres[:1] + np.float32(RADIUS_PX + 5)
    margin = np.array([[0.2, 0.2], [WIDTH - 0.1, HEIGHT - 0.1]], np.float32)
    _, found = snap_to_extrema(image, np.concatenate([far, margin]))
    assert not found.any()
    refined, found = snap_to_extrema(image, np.zeros((0, 2), np.float32))
    assert (refined.shape, found.shape) == ((0, 2), (0,))


def test_the_image_turned_over_gives_the_same_places_turned_over() -> None:
    noise = np.random.default_rng(3).normal(128, 60, (HEIGHT, WIDTH))
    image = np.clip(cv2.GaussianBlur(noise, (0, 0), 1.5), 0, 255).astype(np.uint8)
    yy, xx = np.mgrid[5 : HEIGHT - 5 : 9, 5 : WIDTH - 5 : 9]
    xy = np.stack([xx.ravel() + 0.5, yy.ravel() + 0.5], axis=1).astype(np.float32)
    refined, found = snap_to_extrema(image, xy)
    turned, found_turned = snap_to_extrema(image[::-1, ::-1].copy(), np.array([WIDTH, HEIGHT], np.float32) - xy)
    both = found & found_turned
    assert both.sum() > 200
    np.testing.assert_allclose(refined[both], [WIDTH, HEIGHT] - turned[both], atol=1e-3)
