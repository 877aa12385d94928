"""A matcher that the product does not have: OpenCV's mutual nearest neighbours, without a ratio."""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints32


class CrossCheckMatcher:
    def __init__(self, config: MatchConfig) -> None:
        pass

    def prepare(self, features: ImageFeatures, *, width: int, height: int) -> Floats32:
        return features.descriptors.astype(np.float32)

    def match(self, a: Floats32, b: Floats32) -> Ints32:
        found = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a, b)
        return np.array([(m.queryIdx, m.trainIdx) for m in found], np.int32).reshape(-1, 2)


METHOD = Method[MatchConfig, CrossCheckMatcher](build=CrossCheckMatcher)
