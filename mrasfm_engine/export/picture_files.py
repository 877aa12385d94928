"""`pictures/`: what a user looks at, as PNG, and what is too large for memory as files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.types import Bytes


@dataclass(frozen=True)
class LargeFile:
    """A file on the disk of the result, which is moved there."""

    path: Path
    sha256: str  # of what was to be written


PictureFiles = Mapping[str, bytes | LargeFile]  # by name


def png_of(picture: Bytes) -> bytes:
    """A picture (h, w, 3), or (h, w, 4) with opacity, as a PNG file, which was decoded again and shows the same.

    The bounds of camera images are no bounds of our own pictures.

    Raises
    ------
    MrasfmError
        Where no PNG can be made of it.
    """
    try:
        stored = picture[..., [2, 1, 0, 3][: picture.shape[-1]]]
        data = cv2.imencode(".png", stored)[1]
        decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _no_png(picture, str(error).strip()) from error
    if decoded is None or not np.array_equal(decoded, stored):
        raise _no_png(picture, "it shows something else")
    return bytes(data)


def _no_png(picture: Bytes, why: str) -> MrasfmError:
    size = " x ".join(str(n) for n in picture.shape[1::-1])
    return MrasfmError(
        f"a picture of {size} pixels cannot be made a PNG: {why}",
        remedy="This is a defect of mrasfm, please report it.",
        code="bad-picture",
    )


def write_pictures(pictures: PictureFiles, folder: Path) -> None:
    """Write files by name into a new folder, or move them there; without any there is no folder."""
    for name, data in pictures.items():
        folder.mkdir(exist_ok=True)
        if isinstance(data, LargeFile):
            data.path.replace(folder / name)
        else:
            (folder / name).write_bytes(data)


def size_bytes(pictures: PictureFiles) -> int:
    """Size of the files, without those that are on the disk already."""
    return sum(len(data) for data in pictures.values() if isinstance(data, bytes))
