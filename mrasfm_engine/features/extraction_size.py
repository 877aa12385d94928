"""The size at which a drive's images are extracted: no larger than the keypoints that are wanted need.

A keypoint of a reduced image is less exact, by the root of the reduction or so; but the finest details of a large image
are many more than are wanted, and they are the ones that change most from one view to the next. As long as a reduced
image still has enough keypoints, the poses are the same within their own error, and extraction takes a fraction of the
time. Images that are dark or show little texture do not have enough, and are extracted as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from mrasfm_engine.config import FeatureConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.even_choice import nearest_even_choice
from mrasfm_engine.features.extraction import Extractor, ImageMasks, one_opencv_thread
from mrasfm_engine.features.segmentation import Segmenter
from mrasfm_engine.io.images import read_image_rgb
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Bytes, Cancel

LARGEST_SIDE_PX = 1600
# Sizes that are tried, the smallest first, relative to the largest: half is the smallest that was measured.
REDUCTIONS = tuple(2.0 ** (-k / 4) for k in (4, 3, 2, 1))
# Of the wanted keypoints, in three of four sampled images. On KITTI 06 similarity RMSE rose by 13 % with 60 % of them,
# and by no more than 3 % with 75 % and more; KITTI 01, 02 and PandaSet lost nothing.
ENOUGH = 0.75
SAMPLED_IMAGES = 12  # of a size
MARGIN = 0.9  # of the reduction that is expected to do


@runtime_checkable
class SizedExtractor(Extractor, Protocol):
    """An extractor that says what an image yields at a reduced size."""

    def with_side(self, max_side_px: int) -> SizedExtractor:
        """The same extractor at another `max_side_px`."""
        ...

    def count(self, rgb: Bytes, mask: Bools | None) -> int:
        """Number of keypoints that `extract` finds, without their descriptors."""
        ...


Size = tuple[int, int]  # width and height in pixels


def largest_side_px(config: FeatureConfig) -> int:
    """Longer side of the largest images that are extracted at full size."""
    return config.max_side_px or LARGEST_SIDE_PX


def shrunk(image: Bytes, side_px: int) -> Bytes:
    """An image (h, w) or (h, w, 3) whose longer side is `side_px` at most.

    Its content fills the rounded size exactly: along each axis it shrinks by new size over old size.
    """
    height, width = image.shape[:2]
    scale = side_px / max(height, width)
    if scale >= 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True)
class ExtractorBySize:
    """Extracts images at the size that was found for theirs, and others by `otherwise`."""

    otherwise: Extractor
    by_size: Mapping[Size, Extractor]

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """See `Extractor`."""
        return self.by_size.get((rgb.shape[1], rgb.shape[0]), self.otherwise).extract(rgb, mask)


def at_sizes(extractor: Extractor, side_px: Mapping[Size, int]) -> Extractor:
    """The extractor that reduces images of each size to a longer side, as `find_sides` found it."""
    if not side_px or not isinstance(extractor, SizedExtractor):
        return extractor
    return ExtractorBySize(extractor, {size: extractor.with_side(side) for size, side in side_px.items()})


def find_sides(
    drive: Drive,
    extractor: SizedExtractor,
    *,
    max_keypoints: int,
    threads: int,
    segmenter: Segmenter | None = None,
    own_cars: Sequence[Bools | None] = (),
    cancel: Cancel | None = None,
) -> dict[Size, int]:
    """Longer side in pixels that images of each size are reduced to; a size that is extracted as it is has none.

    All cameras with images of one size have the same: keypoints of a stereo pair are then alike. Images that cannot be
    read say nothing: the extraction tells what is wrong with them.

    Parameters
    ----------
    segmenter, own_cars
        As the extraction has them: keypoints that it will not have do not count.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    result: dict[Size, int] = {}
    masks = ImageMasks.of_drive(drive, segmenter, own_cars)
    for size in sorted({(camera.width, camera.height) for camera in drive.cameras}):
        sampled, promising = _sample(drive, size), 0.0
        for reduction in REDUCTIONS:
            if reduction < promising:
                continue
            side_px = round(reduction * min(max(size), LARGEST_SIDE_PX))
            counts = _counts(masks, sampled, extractor.with_side(side_px), threads=threads, cancel=cancel)
            share = float(np.quantile(counts, 0.25)) / (ENOUGH * max_keypoints) if counts else 0.0
            if share >= 1.0:
                result[size] = side_px
                break
            # Keypoints are as many as pixels, or so: sizes far from enough need not be tried.
            promising = reduction / np.sqrt(share) * MARGIN if share else np.inf
    return result


def _sample(drive: Drive, size: Size) -> list[int]:
    """Images of a size, spread over the drive and its cameras."""
    of_size = [
        i
        for i, image in enumerate(drive.images)
        if (drive.cameras[image.camera].width, drive.cameras[image.camera].height) == size
    ]
    # By camera, and by time within a camera: evenly spread numbers then take all cameras and all parts of the drive.
    of_size.sort(key=lambda i: (drive.images[i].camera, drive.images[i].unit))
    chosen = nearest_even_choice(len(of_size), SAMPLED_IMAGES).tolist()
    return [of_size[k] for k in chosen]


def _counts(
    masks: ImageMasks, images: list[int], extractor: SizedExtractor, *, threads: int, cancel: Cancel | None
) -> list[int]:
    """Keypoints of images at the extractor's size, of those that can be read."""

    def count(index: int) -> int | None:
        if cancel is not None and cancel():
            raise CancelledError
        try:
            rgb = read_image_rgb(masks.drive.path_of(masks.drive.images[index].file))
            return extractor.count(rgb, masks.of_image(index, rgb).usable)
        except InputError:
            return None

    with one_opencv_thread(), closing(in_order(threads, count, images)) as counts:
        return [found for found in counts if found is not None]
