"""Exposure of images from the colours of shared points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrasfm_engine.visualization.exposure import exposure_gains
from tests.helpers.export_example import make_scene


def test_exposures_are_found_but_for_a_common_factor() -> None:
    scene, rng = make_scene(), np.random.default_rng(0)
    exposure = rng.uniform(0.6, 1.4, len(scene.drive.images))
    albedo = rng.uniform(40, 150, (len(scene.points_m), 3))
    features = [replace(f, colors=np.zeros((len(f.xy_px), 3), np.uint8)) for f in scene.features]
    for p, i, k in zip(scene.observation_point, scene.observation_image, scene.observation_keypoint, strict=True):
        features[i].colors[k] = np.clip(exposure[i] * albedo[p], 0, 255).astype(np.uint8)
    scene.features = features
    gains = exposure_gains(scene)
    seen = np.unique(scene.observation_image)
    product = gains[seen] * exposure[seen, None]
    # Shrunk a little towards 1, as 50 points are no certainty.
    assert 0.001 < np.std(np.log(product)) < 0.35 * np.std(np.log(exposure[seen]))
    unseen = np.setdiff1d(np.arange(len(gains)), seen)
    np.testing.assert_array_equal(gains[unseen], 1.0)


def test_without_observations_nothing_is_changed() -> None:
    scene = make_scene()
    scene.observation_point = scene.observation_image = scene.observation_keypoint = np.zeros(0, np.int64)
    np.testing.assert_array_equal(exposure_gains(scene), 1.0)
