"""Keypoints and descriptors of all images of a drive."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.features.own_car import with_margin
from mrasfm_engine.features.segmentation import Segmenter
from mrasfm_engine.io.image_decoding import IncompleteImageError
from mrasfm_engine.io.images import mask_png, read_image_rgb, read_mask
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive, LeftOut
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.scene.semantics import class_codes, classes_at, usable_pixels
from mrasfm_engine.types import Bools, Bytes, Cancel, CountProgress
from schemas import LabelMap

DESCRIPTOR_SCALE = 512.0  # COLMAP stores unit-length descriptors times 512 in bytes
NO_FEATURES = ImageFeatures(
    xy_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 128), np.uint8), colors=np.zeros((0, 3), np.uint8)
)


class Extractor(Protocol):
    """Finds keypoints in one image."""

    def extract(self, rgb: Bytes, mask: Bools | None) -> ImageFeatures:
        """Keypoints of an image (h, w, 3); where `mask` (h, w) is False nothing is extracted."""
        ...


def colors_at(rgb: Bytes, xy_px: NDArray[Any]) -> Bytes:
    """Colours (n, 3) of an image (h, w, 3) at keypoints (n, 2)."""
    column = np.clip(xy_px[:, 0].astype(int), 0, rgb.shape[1] - 1)
    row = np.clip(xy_px[:, 1].astype(int), 0, rgb.shape[0] - 1)
    return np.ascontiguousarray(rgb[row, column])


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """OpenCV works in our threads instead of its own."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@dataclass(frozen=True, kw_only=True)
class MaskedImage:
    """Verdict of masks on the pixels of an image.

    Attributes
    ----------
    usable
        (h, w) where keypoints may be; None: everywhere.
    codes
        (h, w) classes as `semantics.class_codes` has them, None where no mask says.
    made_mask
        (h, w) the mask, where the segmenter made it.
    """

    usable: Bools | None
    codes: Bytes | None = None
    made_mask: Bytes | None = None


@dataclass(frozen=True, kw_only=True)
class ImageMasks:
    """The masks of a drive's images: given, made or of the own car."""

    drive: Drive
    segmenter: Segmenter | None
    outside_own_car: Sequence[Bools | None]  # by camera; none where it was not sought

    @staticmethod
    def of_drive(drive: Drive, segmenter: Segmenter | None, own_cars: Sequence[Bools | None]) -> ImageMasks:
        """Masks with a margin around the own car, whose masks (h, w) by camera are True where pixels show it."""
        outside = [None if mask is None else ~with_margin(mask) for mask in own_cars]
        return ImageMasks(drive=drive, segmenter=segmenter, outside_own_car=outside)

    def of_image(self, index: int, rgb: Bytes) -> MaskedImage:
        """Masks of an image (h, w, 3).

        Raises
        ------
        InputError
            Where the image has another size than its camera, or its mask another than the image or cannot be read.
        """
        image, given = self.drive.images[index], self.drive.manifest.label_map
        camera = self.drive.cameras[image.camera]
        if rgb.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{image.file} has {rgb.shape[1]}x{rgb.shape[0]} pixels, its camera {camera.name} "
                f"{camera.width}x{camera.height}",
                remedy="Give the calibration of images of this size, or images of the calibration's size.",
            )
        outside = self.outside_own_car[image.camera] if self.outside_own_car else None
        made_mask = None
        if image.mask is not None:
            mask = read_mask(self.drive.path_of(image.mask), given)
            if mask.shape != rgb.shape[:2]:
                raise InputError(
                    f"mask {image.mask} has {mask.shape[1]}x{mask.shape[0]} pixels, its image has "
                    f"{rgb.shape[1]}x{rgb.shape[0]}",
                    remedy="Give masks of their images' size, without interpolating between ids.",
                    code="mask-size",
                )
        elif self.segmenter is not None:
            mask = made_mask = self.segmenter.segment(rgb)
        else:
            return MaskedImage(usable=outside)
        codes = class_codes(mask, given or LabelMap.cityscapes())
        usable = usable_pixels(codes)
        return MaskedImage(usable=usable if outside is None else usable & outside, codes=codes, made_mask=made_mask)


def extract_features(
    drive: Drive,
    extractor: Extractor,
    *,
    threads: int,
    segmenter: Segmenter | None = None,
    class_margin_px: int = 2,
    own_cars: Sequence[Bools | None] = (),
    repeated: Collection[str] = (),
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> list[ImageFeatures]:
    """Features of every image of a short drive, all in memory; see `features_by_image`.

    Images that were left out have none, of the kind that the others have.
    """
    found = features_by_image(
        drive,
        extractor,
        threads=threads,
        segmenter=segmenter,
        class_margin_px=class_margin_px,
        own_cars=own_cars,
        repeated=repeated,
        progress=progress,
        cancel=cancel,
    )
    return _with_left_out(list(found))


def features_by_image(
    drive: Drive,
    extractor: Extractor,
    *,
    threads: int,
    segmenter: Segmenter | None = None,
    class_margin_px: int = 2,
    own_cars: Sequence[Bools | None] = (),
    repeated: Collection[str] = (),
    known: Mapping[str, ImageFeatures] | None = None,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> Generator[ImageFeatures | LeftOut]:
    """Features of every image of the drive, in the order of `drive.images`; those of few images exist at one time.

    Where an image has a semantic mask, nothing is extracted on moving things, the sky and the own car, and keypoints
    have the class of what they show; those whose outline is within `class_margin_px` of another class are unknown.
    Images without a mask get theirs from `segmenter`, if there is one; it comes with their features.

    Nothing is extracted where `own_cars` is True either: masks (h, w) by camera, as the pixels show the own car.

    An image whose pixels are not all there is left out, with the reason in the place of its features: the grey that
    fills it up has texture at its border. So is one of the `repeated` files, which shows where the vehicle was before.

    Images whose features are `known`, by file, are not read: they were extracted with these very arguments.

    Raises
    ------
    InputError
        Where an image cannot be read at all or has another size than its camera.
    CancelledError
        Where `cancel` answers True.
    """

    masks = ImageMasks.of_drive(drive, segmenter, own_cars)

    def one(index: int) -> ImageFeatures | LeftOut:
        if cancel is not None and cancel():
            raise CancelledError
        file = drive.images[index].file
        if file in repeated:
            return LeftOut.REPEATED
        if known is not None and file in known:
            return known[file]
        try:
            rgb = read_image_rgb(drive.path_of(file))
        except IncompleteImageError as problem:
            return problem.reason
        masked = masks.of_image(index, rgb)
        found = extractor.extract(rgb, masked.usable)
        if masked.codes is None:
            return found
        made_mask = None if masked.made_mask is None else mask_png(masked.made_mask)
        margin_px = class_margin_px + (0.0 if found.radius_px is None else found.radius_px)
        classes = classes_at(masked.codes, found.xy_px, margin_px)
        return replace(found, classes=classes, made_mask=made_mask)

    count = len(drive.images)
    with one_opencv_thread():
        for done, found in enumerate(in_order(threads, one, range(count)), 1):
            yield found
            if progress is not None:
                progress(done, count)


def _with_left_out(found: Sequence[ImageFeatures | LeftOut]) -> list[ImageFeatures]:
    """Features of all images: those left out have none, of the kind that the others have."""
    kind = next((features for features in found if isinstance(features, ImageFeatures)), NO_FEATURES)
    none = ImageFeatures(
        xy_px=kind.xy_px[:0],
        descriptors=kind.descriptors[:0],
        colors=kind.colors[:0],
        scores=None if kind.scores is None else kind.scores[:0],
    )
    return [replace(none, left_out=features) if isinstance(features, LeftOut) else features for features in found]
