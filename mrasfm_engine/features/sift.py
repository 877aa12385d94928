"""SIFT: needs no model."""

from __future__ import annotations

import math

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.features.coverage import covering_order
from mrasfm_engine.features.extraction import DESCRIPTOR_SCALE, NO_FEATURES, colors_at
from mrasfm_engine.features.extraction_size import largest_side_px, shrunk
from mrasfm_engine.features.sift_descriptors import describe
from mrasfm_engine.features.sift_keypoints import Keypoints, find_keypoints
from mrasfm_engine.features.sift_scale_space import Gradients
from mrasfm_engine.learned.catalogue import Method
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Bytes, Floats

SMALLEST_DESCRIPTOR_SUM = 1e-3
# Of a disc over the smoothing at which it is an extremum (Lindeberg, Feature detection with automatic scale selection,
# IJCV 1998).
BLOB_RADIUS = math.sqrt(2.0)
CANDIDATES = 2  # times the number wanted, of which those are chosen that cover the image


class SiftExtractor:
    """SIFT keypoints with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012)."""

    def __init__(self, config: FeatureConfig) -> None:
        self._config = config

    def with_side(self, max_side_px: int) -> SiftExtractor:
        """See `SizedExtractor`."""
        return SiftExtractor(self._config.model_copy(update={"max_side_px": max_side_px}))

    def count(self, rgb: Bytes, mask: Bools | None) -> int:
        """See `SizedExtractor`."""
        gray = self._gray(rgb)
        return min(len(self._found(gray, mask)[0]), self._config.max_keypoints)

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """See `Extractor`."""
        gray = self._gray(rgb)
        keypoints, gradients = self._found(gray, mask)
        if not len(keypoints):
            return NO_FEATURES
        wanted = self._config.max_keypoints * (CANDIDATES if self._config.spread else 1)
        keypoints = keypoints.chosen(np.argsort(-keypoints.contrast, kind="stable")[:wanted])
        if self._config.spread:
            keypoints = keypoints.chosen(covering_order(keypoints.xy_px.astype(np.float32)))
        keypoints = keypoints.chosen(slice(self._config.max_keypoints))
        xy = _xy_in_image(keypoints, gray, rgb.shape)
        descriptors = describe(keypoints, gradients)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), SMALLEST_DESCRIPTOR_SUM))
        return ImageFeatures(
            xy_px=xy.astype(np.float32),
            descriptors=np.clip(np.round(root * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8),
            colors=colors_at(rgb, xy),
            radius_px=(BLOB_RADIUS * rgb.shape[1] / gray.shape[1] * keypoints.sigma_px).astype(np.float32),
        )

    def _gray(self, rgb: Bytes) -> Bytes:
        """The image at the size of the extraction."""
        return shrunk(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), largest_side_px(self._config))

    def _found(self, gray: Bytes, mask: Bools | None) -> tuple[Keypoints, list[Gradients]]:
        keypoints, gradients = find_keypoints(gray, least_contrast=self._config.contrast_threshold)
        if mask is not None:
            # not a reduced mask, whose pixels would say what others of the image show
            column, row = _xy_in_image(keypoints, gray, mask.shape).astype(int).T
            keypoints = keypoints.chosen(mask[row, column])
        return keypoints, gradients


def _xy_in_image(keypoints: Keypoints, gray: Bytes, shape: tuple[int, ...]) -> Floats:
    """Places (n, 2) of keypoints of a reduced image in the one of `shape` (h, w, ...) that it was made of."""
    # The detector puts the centre of the top left pixel at (0, 0), the manifest and COLMAP at (0.5, 0.5).
    return np.asarray((keypoints.xy_px + 0.5) / np.divide(gray.shape[::-1], shape[1::-1]), np.float64)


METHOD = Method[FeatureConfig, SiftExtractor](build=SiftExtractor)
