"""The extractor around a trained network: tiles, masks, refinement and the order of keypoints.

All coordinates become COLMAP's, where the centre of the top left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.features.coverage import covering_order
from mrasfm_engine.features.extraction import colors_at
from mrasfm_engine.features.extraction_size import largest_side_px, shrunk
from mrasfm_engine.features.keypoint_refinement import snap_to_extrema
from mrasfm_engine.features.tiles import Tile, cut, duplicates, lay_tiles
from mrasfm_engine.learned.network import STRIDE_PX, Network
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Bytes, Floats32, Ints

MOST_ASKED = 65536  # keypoints of one tile


@dataclass(frozen=True)
class Detections:
    """Keypoints that a network finds in one image or tile."""

    xy_px: Floats32  # (n, 2), top left pixel's centre at (0.5, 0.5)
    descriptors: Floats32  # (n, D)
    scores: Floats32  # (n,)

    def __getitem__(self, chosen: Bools | Ints) -> Detections:
        return Detections(self.xy_px[chosen], self.descriptors[chosen], self.scores[chosen])


class Detector(Protocol):
    """One network: how its tensors become detections."""

    network: Network
    image: str  # its input for the image
    is_refined: bool  # whether its keypoints are moved to the detail that they mean
    takes_number: bool  # whether `wanted` has a meaning

    def detect(self, pixels: Bytes, wanted: int, min_score: float | None) -> Detections:
        """Detections in an image (h, w, 3) of a size that the network takes.

        `wanted` and `min_score` are hints, which some networks ignore.
        """
        ...


class NetworkExtractor:
    """An `Extractor` around a network, which is given the whole image or, if its size is fixed, tiles of it."""

    def __init__(self, detector: Detector, config: FeatureConfig) -> None:
        self._detector = detector
        self._config = config
        self._fixed_size = detector.network.fixed_size(detector.image)

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """See `Extractor`."""
        pixels = shrunk(rgb, largest_side_px(self._config))
        size = pixels.shape[0], pixels.shape[1]
        window = self._fixed_size or (_up(size[0]), _up(size[1]))
        stretch = np.array([rgb.shape[1] / size[1], rgb.shape[0] / size[0]])

        def usable(xy: Floats32) -> Bools:
            if mask is None:
                return np.ones(len(xy), dtype=np.bool_)
            at = (xy * stretch).astype(int)
            inside: Bools = mask[np.clip(at[:, 1], 0, mask.shape[0] - 1), np.clip(at[:, 0], 0, mask.shape[1] - 1)]
            return inside

        tiles = lay_tiles(size, window)
        parts = [self._detect(cut(pixels, tile, window), tile, usable) for tile in tiles]
        number = np.repeat(np.arange(len(parts)), [len(part.xy_px) for part in parts])
        found = Detections(
            *(np.concatenate([getattr(p, f) for p in parts]) for f in ("xy_px", "descriptors", "scores"))
        )
        found = found[~duplicates(found.xy_px, found.scores, number)]
        found = found[np.argsort(-found.scores, kind="stable")]
        if self._detector.is_refined and self._config.refine:
            xy, there = snap_to_extrema(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), found.xy_px)
            found = Detections(xy, found.descriptors, found.scores)[there & usable(xy)]
        if self._config.spread:
            found = found[covering_order(found.xy_px)]
        found = found[np.arange(len(found.xy_px)) < self._config.max_keypoints]
        xy = found.xy_px * stretch
        return ImageFeatures(
            xy_px=xy.astype(np.float32),
            descriptors=np.ascontiguousarray(found.descriptors, dtype=np.float32),
            colors=colors_at(rgb, xy),
            scores=np.ascontiguousarray(found.scores, dtype=np.float32),
        )

    def _detect(self, pixels: Bytes, tile: Tile, usable: Callable[[Floats32], Bools]) -> Detections:
        """Detections of a tile that lie in its core, are not masked and not too weak; in pixels of the scaled image."""
        wanted = self._config.max_keypoints
        while True:
            found = self._detector.detect(pixels, wanted, self._config.min_score)
            self._check(found)
            xy = found.xy_px + np.array([tile.column, tile.row], np.float32)
            keep = tile.owns(xy)
            keep[keep] = usable(xy[keep])
            if self._config.min_score is not None:
                keep &= found.scores >= self._config.min_score
            cut_off = self._detector.takes_number and len(xy) >= wanted
            # Masked areas and mirrored margins must not use up the number.
            if keep.sum() >= self._config.max_keypoints or not cut_off or wanted >= MOST_ASKED:
                return Detections(xy, found.descriptors, found.scores)[keep]
            wanted *= 4

    def _check(self, found: Detections) -> None:
        count = len(found.xy_px)
        arrays = (found.xy_px, found.descriptors, found.scores)
        shapes = [list(array.shape) for array in arrays]
        fits = found.descriptors.ndim == 2 and [shapes[0], shapes[1][:1], shapes[2]] == [[count, 2], [count], [count]]
        name = self._detector.network.name
        if not fits:
            raise InputError(
                f"model {name} gives keypoints {shapes[0]}, descriptors {shapes[1]} and scores {shapes[2]}",
                remedy="Export it with one descriptor and one score a keypoint.",
                code="bad-model",
            )
        for what, values in zip(("keypoints", "descriptors", "scores"), arrays, strict=True):
            if not np.isfinite(values).all():
                raise InputError(
                    f"model {name} gives {what} that are not finite numbers",
                    remedy="Export it in 32 bit floats: in 16 bits, values over 65504 are infinite. Damaged weights do "
                    "this as well.",
                    code="bad-model",
                )


def _up(size: int) -> int:
    return -(-size // STRIDE_PX) * STRIDE_PX


def planes(pixels: Bytes) -> Floats32:
    """Convert an image (h, w, 3) to a tensor (1, 3, h, w) of 0 to 1."""
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], dtype=np.float32) / np.float32(255)
