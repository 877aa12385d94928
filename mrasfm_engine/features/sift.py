"""SIFT by OpenCV: needs no model."""

from __future__ import annotations

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.coverage import covering_order
from mrasfm_engine.features.extraction import DESCRIPTOR_SCALE, NO_FEATURES, colors_at
from mrasfm_engine.features.extraction_size import largest_side_px, shrunk
from mrasfm_engine.features.sift_descriptors import sift_descriptors
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Bytes

SMALLEST_DESCRIPTOR_SUM = 1e-3
CANDIDATES = 2  # times the number wanted, of which those are chosen that cover the image


class SiftExtractor:
    """OpenCV's SIFT keypoints with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012)."""

    def __init__(self, config: FeatureConfig) -> None:
        self._config = config

    def with_side(self, max_side_px: int) -> SiftExtractor:
        """See `SizedExtractor`."""
        return SiftExtractor(self._config.model_copy(update={"max_side_px": max_side_px}))

    def count(self, rgb: Bytes, mask: Bools | None) -> int:
        """See `SizedExtractor`."""
        gray, small_mask, sift = self._prepared(rgb, mask)
        return min(len(sift.detect(gray, small_mask)), self._config.max_keypoints)

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """See `Extractor`."""
        gray, small_mask, sift = self._prepared(rgb, mask)
        keypoints = sorted(sift.detect(gray, small_mask), key=lambda k: -k.response)
        if not keypoints:
            return NO_FEATURES
        if self._config.spread:
            keypoints = [keypoints[i] for i in covering_order(cv2.KeyPoint.convert(keypoints))]
        keypoints = keypoints[: self._config.max_keypoints]
        # OpenCV puts the centre of the top left pixel at (0, 0), the manifest and COLMAP at (0.5, 0.5).
        xy = (cv2.KeyPoint.convert(keypoints) + 0.5) / np.divide(gray.shape[::-1], rgb.shape[1::-1])
        descriptors = sift_descriptors(gray, keypoints)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), SMALLEST_DESCRIPTOR_SUM))
        return ImageFeatures(
            xy_px=xy.astype(np.float32),
            descriptors=np.clip(np.round(root * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8),
            colors=colors_at(rgb, xy),
        )

    def _prepared(self, rgb: Bytes, mask: Bools | None) -> tuple[Bytes, Bytes | None, cv2.SIFT]:
        """The image and the mask at the size of the extraction, and a detector."""
        gray = shrunk(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), largest_side_px(self._config))
        small_mask, wanted = None, self._config.max_keypoints * (CANDIDATES if self._config.spread else 1)
        if mask is not None:
            small_mask = cv2.resize(mask.astype(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
            # OpenCV masks only after it has chosen the strongest: the rest of the image must not use up the number.
            wanted = round(wanted / max(float(small_mask.mean()), 0.05))
        # A detector an image: OpenCV's objects must not be shared between threads. Without precise upscaling all its
        # keypoints are 0.25 px too far right and down, which turns cameras by 0.02 deg against one another.
        sift = cv2.SIFT.create(
            nfeatures=wanted,
            contrastThreshold=self._config.contrast_threshold,
            enable_precise_upscale=True,
        )
        return gray, small_mask, sift


METHOD = Method[FeatureConfig, SiftExtractor](build=SiftExtractor)
