"""Semantic masks for images that come without one, by a model of the user's."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.catalogue import KnownModel
from mrasfm_engine.learned.network import STRIDE_PX, Network
from mrasfm_engine.learned.signatures import UINT8, ModelKind, Signature, Tensor, float_tensor
from mrasfm_engine.types import Bytes
from schemas import LabelMap

# Any network for semantic segmentation: image RGB 0..1, ids of the drive's label map a pixel.
SIGNATURE = Signature(
    inputs=(float_tensor("image", 1, 3, "H", "W"),),
    outputs=(Tensor("classes", (UINT8,), (1, "H", "W")),),
)
MODELS = (
    KnownModel(
        name="segmenter",
        kind=ModelKind.SEGMENTER,
        method="segmenter",
        descriptors=None,
        signature=SIGNATURE,
        licence="that of the file",
        commercial_use=None,
        source="an export of your own",
    ),
)


class Segmenter(Protocol):
    """Says what every pixel shows."""

    def segment(self, rgb: Bytes) -> Bytes:
        """Ids of the drive's label map (h, w) for an image (h, w, 3)."""
        ...


class OnnxSegmenter:
    """A network; where its size is fixed the image is resized to it, and the nearest class taken back.

    Parameters
    ----------
    label_map
        The ids that may come out; Cityscapes' train ids if None.
    """

    def __init__(self, network: Network, label_map: LabelMap | None) -> None:
        self._network = network
        self._known = np.zeros(256, dtype=np.bool_)
        self._known[list((label_map or LabelMap.cityscapes()).ids)] = True
        self._size = network.fixed_size("image")

    def segment(self, rgb: Bytes) -> Bytes:
        """See `Segmenter`.

        Raises
        ------
        InputError
            Where the model gives an id that the label map does not have, or not one id a pixel.
        """
        rows, columns = rgb.shape[:2]
        if self._size is not None:
            method = cv2.INTER_AREA if self._size[0] < rows else cv2.INTER_LINEAR
            pixels = np.asarray(cv2.resize(rgb, self._size[::-1], interpolation=method), dtype=np.uint8)
        else:
            below, right = -rows % STRIDE_PX, -columns % STRIDE_PX
            pixels = np.asarray(cv2.copyMakeBorder(rgb, 0, below, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)
        image = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], dtype=np.float32) / np.float32(255)
        found = self._network.run({"image": image})["classes"]
        if found.shape != (1, *pixels.shape[:2]):
            raise InputError(
                f"model {self._network.name} gives classes of {list(found.shape)} for an image of {list(image.shape)}",
                remedy="Export it with one class a pixel, resized to the image.",
                code="bad-model",
            )
        classes: Bytes = found[0]
        unknown = np.flatnonzero((np.bincount(classes.ravel(), minlength=256) > 0) & ~self._known)
        if len(unknown):
            raise InputError(
                f"model {self._network.name} gives the id {unknown[0]}, which the label map does not have",
                remedy="Give the drive's label_map the model's ids (without one they are Cityscapes' train ids).",
                code="unknown-label",
            )
        if self._size is None:
            return np.ascontiguousarray(classes[:rows, :columns])
        return np.asarray(cv2.resize(classes, (columns, rows), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
