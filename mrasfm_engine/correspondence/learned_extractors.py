"""Keypoints found by trained networks, each behind the `Extractor` interface.

All coordinates become COLMAP's, where the centre of the top left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.correspondence.features import colors_at
from mrasfm_engine.correspondence.tiles import cut, duplicates, lay_tiles
from mrasfm_engine.learned.network import Network
from mrasfm_engine.scene.scene import ImageFeatures

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

STRIDE_PX = 32  # networks with free size want multiples of it


@dataclass(frozen=True)
class Detections:
    """What a network finds in one image or tile."""

    xy_px: Floats  # (n, 2), top left pixel's centre at (0.5, 0.5)
    descriptors: Floats  # (n, D)
    scores: Floats  # (n,)

    def __getitem__(self, chosen: Bools | NDArray[np.int64]) -> Detections:
        return Detections(self.xy_px[chosen], self.descriptors[chosen], self.scores[chosen])


class Detector(Protocol):
    """One network: how its tensors become detections."""

    network: Network
    image: str  # its input for the image
    descriptor_size: int  # D, where nothing is found

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """Detections in an image (h, w, 3) of a size that the network takes.

        `wanted` and `min_score` are hints: not all networks can be told.
        """
        ...


class LearnedExtractor:
    """An `Extractor` around a network, which is given the whole image or, if its size is fixed, tiles of it."""

    def __init__(self, detector: Detector, config: FeatureConfig) -> None:
        self._detector = detector
        self._config = config
        self.fixed_size = detector.network.fixed_size(detector.image)

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """See `Extractor`."""
        scale = min(1.0, self._config.max_side_px / max(rgb.shape[:2]))
        pixels = rgb
        if scale < 1.0:
            pixels = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        found = self._over_tiles(pixels, None if mask is None else float(mask.mean()))
        stretch = np.array([rgb.shape[1] / pixels.shape[1], rgb.shape[0] / pixels.shape[0]])
        found = Detections((found.xy_px * stretch).astype(np.float32), found.descriptors, found.scores)
        if mask is not None:
            column, row = (np.clip(found.xy_px[:, i].astype(int), 0, rgb.shape[1 - i] - 1) for i in (0, 1))
            found = found[mask[row, column]]
        found = found[np.argsort(-found.scores, kind="stable")[: self._config.max_keypoints]]
        return ImageFeatures(
            xy_px=np.ascontiguousarray(found.xy_px, dtype=np.float32),
            descriptors=np.ascontiguousarray(found.descriptors, dtype=np.float32),
            colors=colors_at(rgb, found.xy_px),
            scores=np.ascontiguousarray(found.scores, dtype=np.float32),
        )

    def _over_tiles(self, pixels: Bytes, unmasked: float | None) -> Detections:
        """Detections in all of an image, still with those under the mask."""
        size = pixels.shape[0], pixels.shape[1]
        window = self.fixed_size or (_up(size[0]), _up(size[1]))
        # Masked areas must not use up the number, so networks that can be told are asked for more.
        wanted = round(self._config.max_keypoints / max(1.0 if unmasked is None else unmasked, 0.05))
        parts, tiles = [], []
        for i, tile in enumerate(lay_tiles(size, window)):
            found = self._detector.detect(cut(pixels, tile, window), wanted, self._config.min_score)
            found = Detections(found.xy_px + np.array([tile.column, tile.row], np.float32), *_rest(found))
            parts.append(found[tile.owns(found.xy_px)])
            tiles.append(np.full(len(parts[-1].xy_px), i, dtype=np.int64))
        joined = Detections(
            *(np.concatenate([getattr(p, f) for p in parts]) for f in ("xy_px", "descriptors", "scores"))
        )
        if self._config.min_score is not None:
            enough = joined.scores >= self._config.min_score
            joined, tiles = joined[enough], [np.concatenate(tiles)[enough]]
        return joined[~duplicates(joined.xy_px, joined.scores, np.concatenate(tiles))]


def _rest(found: Detections) -> tuple[Floats, Floats]:
    return found.descriptors, found.scores


def _up(size: int) -> int:
    return -(-size // STRIDE_PX) * STRIDE_PX


def _planes(pixels: Bytes) -> Floats:
    """An image (h, w, 3) as (1, 3, h, w), 0 to 1."""
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], dtype=np.float32) / np.float32(255)


class XFeatDetector:
    """XFeat (Potje et al., CVPR 2024), exported with its own resampling to multiples of 32."""

    image = "images"
    descriptor_size = 64

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`; number and least score are part of the exported network."""
        found = self.network.run({"images": _planes(pixels)})
        # The network shrinks the image to multiples of 32, takes whole pixels there, counted from 0, and multiplies
        # them by the shrinkage: half a pixel of the shrunk image is missing.
        rows, columns = pixels.shape[:2]
        half = 0.5 * np.array([columns / _down(columns), rows / _down(rows)], np.float32)
        return Detections(found["keypoints"] + half, found["descriptors"], found["scores"])


def _down(size: int) -> int:
    return size // STRIDE_PX * STRIDE_PX


class AlikedDetector:
    """ALIKED (Zhao et al., TIM 2023) as COLMAP publishes it."""

    image = "image"
    descriptor_size = 128
    usual_min_score = 0.2  # COLMAP's

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`."""
        found = self.network.run(
            {
                "image": _planes(pixels),
                "max_keypoints": np.array(wanted, np.int64),
                "min_score": np.array(self.usual_min_score if min_score is None else min_score, np.float32),
            }
        )
        # -1 and 1 are the centres of the first and last pixel.
        rows, columns = pixels.shape[:2]
        half_range = 0.5 * np.array([columns - 1, rows - 1], np.float32)
        xy = (found["keypoints"][0] + np.float32(1)) * half_range + np.float32(0.5)
        return Detections(xy, found["descriptors"][0], found["scores"][0])


class SuperPointDetector:
    """SuperPoint (DeTone et al., CVPRW 2018) as exported for LightGlue."""

    image = "image"
    descriptor_size = 256

    def __init__(self, network: Network) -> None:
        self.network = network

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """See `Detector`; number and least score are part of the exported network."""
        gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found = self.network.run({"image": gray[None, None].astype(np.float32) / np.float32(255)})
        xy = found["keypoints"][0].astype(np.float32) + np.float32(0.5)
        return Detections(xy, found["descriptors"][0], found["scores"][0])
