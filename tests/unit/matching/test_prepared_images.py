"""Memory of matching: it follows from the window that pairs are chosen in, and not from the length of the drive."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.matching import pair_matching
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher, Prepared
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.prepared_images import PreparedImages, images_at_once
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from tests.helpers.simulated_drive import make_drive, random_descriptors

KEYPOINTS, WINDOW = 64, 4


def drive_of(units: int) -> Drive:
    return make_drive(np.eye(4)[None], np.array([[500.0, 500.0, 480.0, 270.0]]), units=units)


def window_pairs(images: int) -> np.ndarray:
    return np.array([(a, b) for a in range(images) for b in range(a + 1, min(a + 1 + WINDOW, images))], dtype=np.int64)


class CountingMatcher(NearestNeighbourMatcher):
    prepared = 0

    def prepare(self, features: ImageFeatures, *, width: int = 0, height: int = 0) -> Prepared:
        self.prepared += 1
        return super().prepare(features)


def matched(units: int, monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """Peak of the prepared images in memory, and how many images were prepared."""
    rng, made = np.random.default_rng(0), []
    features = [
        ImageFeatures(
            xy_px=rng.random((KEYPOINTS, 2), np.float32) * 500,
            descriptors=random_descriptors(KEYPOINTS, rng),
            colors=np.zeros((KEYPOINTS, 3), np.uint8),
        )
        for _ in range(units)
    ]

    def keep(*args: object, **options: object) -> PreparedImages:
        made.append(PreparedImages(*args, **options))
        return made[-1]

    monkeypatch.setattr(pair_matching, "PreparedImages", keep)
    config = MatchConfig()
    matcher = CountingMatcher(config)
    match_pairs(drive_of(units), features, window_pairs(units), matcher, config, BundleAdjustmentConfig(), threads=2)
    return made[0].prepared.peak_bytes, matcher.prepared


def test_twice_the_images_take_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    short, long = (matched(units, monkeypatch) for units in (100, 200))
    one_image = KEYPOINTS * (128 * 4 + 1)
    assert short[0] == long[0] < 30 * one_image
    assert [short[1], long[1]] == [100, 200], "every image is prepared once"


def test_images_at_once_follow_from_the_window() -> None:
    units = np.arange(1000)
    short, long = (images_at_once(window_pairs(count), units, 2) for count in (50, 1000))
    assert short == long
    revisits = np.stack([np.arange(400), np.arange(500, 900)], 1)
    assert images_at_once(np.concatenate([window_pairs(1000), revisits]), units, 2) == long + 2
    assert images_at_once(np.zeros((0, 2), np.int64), units, 2) > 0
