"""Meaning of the ids of a semantic mask, and classes of keypoints and points as small integers."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.types import Bools, Bytes, Ints
from schemas import LabelMap, SemanticClass

# Keypoints on these show something that moves, is infinitely far away, or comes along with the camera.
WITHOUT_KEYPOINTS = (SemanticClass.DYNAMIC, SemanticClass.SKY, SemanticClass.OWN_CAR)

UNKNOWN = 0  # no mask, or too near to the border of a class to be sure
# Written into files: a number is never given to another class.
CLASS_CODES = {
    SemanticClass.STATIC: 1,
    SemanticClass.ROAD: 2,
    SemanticClass.DYNAMIC: 3,
    SemanticClass.SKY: 4,
    SemanticClass.OWN_CAR: 5,
}
CLASS_NAMES = {UNKNOWN: "unknown"} | {code: str(meaning) for meaning, code in CLASS_CODES.items()}
ROAD = CLASS_CODES[SemanticClass.ROAD]


def class_codes(mask: Bytes, label_map: LabelMap) -> Bytes:
    """The classes of a mask's pixels (h, w) as `CLASS_CODES` numbers them."""
    table = np.full(256, UNKNOWN, dtype=np.uint8)
    for label, meaning in label_map.ids.items():
        table[label] = CLASS_CODES[meaning]
    result: Bytes = table[mask]
    return result


def usable_pixels(codes: Bytes) -> Bools:
    """Mask (h, w) of pixels with classes on which keypoints are detected."""
    table = np.ones(256, dtype=np.bool_)
    table[[CLASS_CODES[meaning] for meaning in WITHOUT_KEYPOINTS]] = False
    result: Bools = table[codes]
    return result


def classes_at(codes: Bytes, xy_px: NDArray[np.floating], margin_px: float | NDArray[np.floating] = 0.0) -> Bytes:
    """The classes (n,) at keypoints (n, 2) whose top left pixel's centre is at (0.5, 0.5).

    Those are unknown that have another class within `margin_px`, one or (n,), in row or column: masks err at borders,
    and what is around a keypoint has a say in its place.
    """
    height, width = codes.shape
    column = np.clip(xy_px[:, 0].astype(np.int64), 0, width - 1)
    row = np.clip(xy_px[:, 1].astype(np.int64), 0, height - 1)
    # Beyond the image's edge nothing contradicts, so that the border is replicated, not filled.
    near, edge = np.ones((3, 3), np.uint8), cv2.BORDER_REPLICATE
    is_border = cv2.erode(codes, near, borderType=edge) != cv2.dilate(codes, near, borderType=edge)
    if not is_border.any():
        return np.asarray(codes[row, column])
    to_border_px = cv2.distanceTransform((~is_border).astype(np.uint8), cv2.DIST_C, 3)
    return np.where(to_border_px[row, column] + 1.0 > margin_px, codes[row, column], np.uint8(UNKNOWN))


def may_match(a: Bytes, b: Bytes) -> Bools:
    """Mask (n,) of keypoint pairs whose classes are compatible; an unknown class is compatible with all."""
    result: Bools = (a == b) | (a == UNKNOWN) | (b == UNKNOWN)
    return result


def count_classes(classes: Sequence[Bytes]) -> dict[str, int]:
    """Number of keypoints of each class by name; classes without keypoints are left out."""
    counts = np.bincount(np.concatenate([np.zeros(0, np.uint8), *classes]), minlength=len(CLASS_NAMES))
    return {CLASS_NAMES[code]: int(n) for code, n in enumerate(counts) if n}


def majority_class(classes: Bytes, owner: Ints, count: int) -> Bytes:
    """The class (count,) of most observations of every owner; unknown ones have no vote, ties go to the smaller code.

    Parameters
    ----------
    classes, owner
        The class of every observation (n,), and the point or track (n,) in [0, count) that it is of.
    """
    codes = max(CLASS_NAMES) + 1
    votes = np.bincount(owner * codes + classes, minlength=count * codes).reshape(count, codes)
    votes[:, UNKNOWN] = 0
    result: Bytes = np.where(votes.any(1), votes.argmax(1), UNKNOWN).astype(np.uint8)
    return result
