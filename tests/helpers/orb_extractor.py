"""An extractor that the product does not have: ORB, whose bits become signs, so that cosines order as Hamming does."""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.extraction import colors_at
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Bytes


class OrbExtractor:
    def __init__(self, config: FeatureConfig) -> None:
        self._config = config

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        orb = cv2.ORB.create(nfeatures=self._config.max_keypoints, fastThreshold=5)
        usable = None if mask is None else mask.astype(np.uint8)
        keypoints, bits = orb.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), usable)
        xy = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2) + np.float32(0.5)
        return ImageFeatures(
            xy_px=xy,
            descriptors=np.unpackbits(np.asarray(bits, np.uint8), axis=1).astype(np.float32) * 2 - 1,
            colors=colors_at(rgb, xy),
            scores=np.array([k.response for k in keypoints], np.float32),
        )


METHOD = Method[FeatureConfig, OrbExtractor](build=OrbExtractor)
