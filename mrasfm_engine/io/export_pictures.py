"""`pictures/`: what a user looks at, as PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.io.export_check import checking, refuse
from mrasfm_engine.io.images import read_image_rgb

Picture = NDArray[np.uint8]  # (h, w, 3) red, green, blue


def write_pictures(pictures: Mapping[str, Picture], folder: Path) -> None:
    """Write pictures by file name into a new folder and read them back; without any there is no folder.

    Raises
    ------
    OSError
        Where the disk is full or cannot be written.
    MrasfmError
        Where a file does not read back.
    """
    for name, picture in pictures.items():
        folder.mkdir(exist_ok=True)
        _, data = cv2.imencode(".png", picture[..., ::-1])
        (folder / name).write_bytes(data.tobytes())
        with checking(folder / name):
            if not np.array_equal(read_image_rgb(folder / name), picture):
                refuse(folder / name, "it shows something else")


def size_bytes(pictures: Mapping[str, Picture]) -> int:
    """At most what the files take, for all that can be foreseen: photographs compress to less."""
    return sum(picture.size for picture in pictures.values())
