"""Features of a drive's images in the file of their stage: written while images are extracted, read image by image.

Descriptors of a long drive do not fit into memory. Images are stored in windows, each with one array of a kind, so that
neither the images of the drive nor thousands of small arrays are ever put together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.features.extraction import NO_FEATURES
from mrasfm_engine.io.stage_store import StageWriter, StoredStage
from mrasfm_engine.scene.drive import LeftOut
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bytes, Floats32, Ints

KINDS = ("xy_px", "descriptors", "colors", "classes", "scores")
# Written at once: some hundred bytes of headers are nothing against it, and it is what a few images in work take.
WINDOW_BYTES = 1 << 23


class FeatureWriter:
    """Writes features image by image."""

    def __init__(self, stage: StageWriter) -> None:
        self._stage = stage
        self._counts: list[int] = []
        self._mask_bytes: list[int] = []
        self._window: list[int] = []  # by image
        self._waiting: list[ImageFeatures] = []
        self._windows = self._waiting_bytes = 0

    @property
    def counts(self) -> Ints:
        """Keypoints of the images so far."""
        return np.array(self._counts, dtype=np.int64)

    @property
    def made_masks(self) -> int:
        """Number of images so far whose mask a network made."""
        return sum(size > 0 for size in self._mask_bytes)

    def add(self, found: ImageFeatures | LeftOut) -> None:
        """Write the next image; raises as `StageWriter.add` does."""
        self._window.append(self._windows)
        if isinstance(found, LeftOut):
            self._counts.append(0)
            self._mask_bytes.append(0)
            return
        self._counts.append(len(found.xy_px))
        self._mask_bytes.append(0 if found.made_mask is None else len(found.made_mask))
        self._waiting.append(found)
        self._waiting_bytes += sum(array.nbytes for kind in KINDS if (array := getattr(found, kind)) is not None)
        self._waiting_bytes += self._mask_bytes[-1]
        if self._waiting_bytes >= WINDOW_BYTES:
            self._write_window()

    def finish(self) -> None:
        """Write what is left; the stage itself is not finished by it."""
        self._write_window()
        self._stage.add("counts", self.counts)
        self._stage.add("mask_bytes", np.array(self._mask_bytes, dtype=np.int64))
        self._stage.add("window", np.array(self._window, dtype=np.int64))

    def _write_window(self) -> None:
        waiting, self._waiting, self._waiting_bytes = self._waiting, [], 0
        if waiting:
            for kind in KINDS:
                parts = [getattr(found, kind) for found in waiting]
                if parts[0] is not None:
                    self._stage.add(_part(kind, self._windows), np.concatenate(parts))
            masks = [found.made_mask for found in waiting if found.made_mask is not None]
            if masks:
                self._stage.add(_part("masks", self._windows), np.concatenate(masks))
        self._windows += 1


def _part(kind: str, window: int) -> str:
    return f"{kind}.{window}"


class FeaturesOnDisk(Sequence[ImageFeatures], ABC):
    """Features of images that are read from a file at every use.

    Attributes
    ----------
    counts
        Keypoints of each image (n,).
    mask_bytes
        Size of the mask that a network made for it (n,), 0 where there is none.
    """

    counts: Ints
    mask_bytes: Ints

    @abstractmethod
    def _image(self, index: int) -> ImageFeatures: ...

    def __len__(self) -> int:
        return len(self.counts)

    @overload
    def __getitem__(self, image: int) -> ImageFeatures: ...
    @overload
    def __getitem__(self, image: slice) -> list[ImageFeatures]: ...
    def __getitem__(self, image: int | slice) -> ImageFeatures | list[ImageFeatures]:
        if isinstance(image, slice):
            return [self[i] for i in range(*image.indices(len(self)))]
        return self._image(range(len(self))[image])

    def __iter__(self) -> Iterator[ImageFeatures]:
        return (self[i] for i in range(len(self)))


class StoredFeatures(FeaturesOnDisk):
    """Features of all images, read from the file at every use."""

    def __init__(self, stage: StoredStage, left_out: Sequence[LeftOut | None]) -> None:
        self._stage = stage
        self._left_out = left_out
        self.counts = stage.read("counts")
        self.mask_bytes = stage.read("mask_bytes")
        self._window = stage.read("window")
        self._row, self._mask_row = (_within_window(n, self._window) for n in (self.counts, self.mask_bytes))
        some = next((w for w in np.unique(self._window).tolist() if _part("xy_px", w) in stage), None)
        self._none: dict[str, NDArray[Any] | None] = {kind: getattr(NO_FEATURES, kind) for kind in KINDS}
        if some is not None:
            self._none = {
                kind: stage.rows(part, 0, 0) if (part := _part(kind, some)) in stage else None for kind in KINDS
            }

    def with_empty_images_of(self, other: StoredFeatures) -> None:
        """Give images without keypoints the kinds of arrays that another file's images have."""
        self._none = other._none

    def _image(self, index: int) -> ImageFeatures:
        return _StoredImage(self, index, self._left_out[index])

    def rows(self, kind: str, image: int, count: int | None = None) -> NDArray[Any] | None:
        """One kind of an image's arrays, or its first `count` rows."""
        if self._none[kind] is None or not self.counts[image]:
            return self._none[kind]
        first, most = int(self._row[image]), int(self.counts[image])
        stop = first + (most if count is None else min(count, most))
        return self._stage.rows(_part(kind, int(self._window[image])), first, stop)

    def mask(self, image: int) -> Bytes | None:
        """Bytes of the PNG that a network made for an image."""
        first, count = int(self._mask_row[image]), int(self.mask_bytes[image])
        return self._stage.rows(_part("masks", int(self._window[image])), first, first + count) if count else None


class JoinedFeatures(FeaturesOnDisk):
    """Features of a drive in the files of its sub-maps; an image that several of them have is read from the first.

    Parameters
    ----------
    parts
        Features of each sub-map and the drive's images (n,) that they are of; all images of the drive together.
    """

    def __init__(self, parts: Sequence[tuple[StoredFeatures, Ints]]) -> None:
        self._parts = [features for features, _ in parts]
        images = max(int(images.max()) for _, images in parts) + 1
        self._part, self._row, self.counts, self.mask_bytes = np.empty((4, images), dtype=np.int64)
        for number, (features, own) in reversed(list(enumerate(parts))):
            self._part[own], self._row[own] = number, np.arange(len(own))
            self.counts[own], self.mask_bytes[own] = features.counts, features.mask_bytes
        seen = next((part for part in self._parts if part.counts.any()), self._parts[0])
        for part in self._parts:
            if not part.counts.any():
                part.with_empty_images_of(seen)

    def is_from(self, image: int, part: StoredFeatures) -> bool:
        """True where an image is read from a part's file."""
        return self._parts[int(self._part[image])] is part

    def _image(self, index: int) -> ImageFeatures:
        return self._parts[int(self._part[index])][int(self._row[index])]


def _within_window(counts: Ints, window: Ints) -> Ints:
    """First row of each image in its window's arrays."""
    first = np.cumsum(counts) - counts
    result: Ints = first - first[np.searchsorted(window, window)]
    return result


class _StoredImage(ImageFeatures):
    """Features of one image that are read when they are asked for, and not kept."""

    def __init__(self, features: StoredFeatures, image: int, left_out: LeftOut | None) -> None:
        for name, value in (("_features", features), ("_image", image), ("left_out", left_out)):
            object.__setattr__(self, name, value)

    _features: StoredFeatures
    _image: int

    def _read(self, kind: str) -> Any:
        return self._features.rows(kind, self._image)

    @property
    def xy_px(self) -> Floats32:
        """See `ImageFeatures`, as the others."""
        return self._read("xy_px")  # type: ignore[no-any-return]

    @property
    def descriptors(self) -> Bytes | Floats32:
        """See `ImageFeatures`."""
        return self._read("descriptors")  # type: ignore[no-any-return]

    @property
    def colors(self) -> Bytes:
        """See `ImageFeatures`."""
        return self._read("colors")  # type: ignore[no-any-return]

    @property
    def classes(self) -> Bytes:
        """See `ImageFeatures`."""
        return self._read("classes")  # type: ignore[no-any-return]

    @property
    def scores(self) -> Floats32 | None:
        """See `ImageFeatures`."""
        return self._read("scores")  # type: ignore[no-any-return]

    @property
    def made_mask(self) -> Bytes | None:
        """See `ImageFeatures`."""
        return self._features.mask(self._image)
