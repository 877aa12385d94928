"""`pictures/`: what a user looks at, as PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.types import Bytes


def png_of(picture: Bytes) -> bytes:
    """A picture (h, w, 3) as a PNG file, which was decoded again and shows the same.

    The bounds of camera images are no bounds of our own pictures.

    Raises
    ------
    MrasfmError
        Where no PNG can be made of it.
    """
    try:
        data = cv2.imencode(".png", picture[..., ::-1])[1]
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise _no_png(picture, str(error).strip()) from error
    if decoded is None or not np.array_equal(decoded, picture[..., ::-1]):
        raise _no_png(picture, "it shows something else")
    return bytes(data)


def _no_png(picture: Bytes, why: str) -> MrasfmError:
    size = " x ".join(str(n) for n in picture.shape[1::-1])
    return MrasfmError(
        f"a picture of {size} pixels cannot be made a PNG: {why}",
        remedy="This is a defect of mrasfm, please report it.",
        code="bad-picture",
    )


def write_pictures(pictures: Mapping[str, bytes], folder: Path) -> None:
    """Write PNG files by name into a new folder; without any there is no folder."""
    for name, data in pictures.items():
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)


def size_bytes(pictures: Mapping[str, bytes]) -> int:
    """Size of the files."""
    return sum(len(data) for data in pictures.values())
