"""Headers of JPEG and PNG files: format, size and completeness, without decoding."""

from __future__ import annotations

import os
import stat
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mrasfm_engine.errors import InputError
from schemas import image_header
from schemas.image_header import ImageHeader, ImageHeaderError, ImageKind

__all__ = ["ImageHeader", "ImageKind", "header_of", "open_regular", "read_header"]


def read_header(path: Path) -> ImageHeader:
    """Header of a JPEG or PNG file.

    Raises
    ------
    InputError
        If the file is missing, not a regular file, empty, in another format, damaged or absurdly large in pixels. Its
        code is one of `missing-file`, `not-a-file`, `empty-file`, `not-an-image`, `damaged-image`, `image-too-large`.
    """
    try:
        with open_regular(path) as stream:
            return _header(stream, path)
    except OSError as error:
        raise _unreadable(path, error) from error


def header_of(data: bytes, path: Path) -> ImageHeader:
    """As `read_header`, for the file's content; `path` is for messages."""
    return _header(BytesIO(data), path)


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; a pipe or device is refused before it could block.

    Raises
    ------
    InputError
        If the file is missing or not a regular file.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            f"image {path} does not exist",
            remedy="Restore the file, or take it out of drive.json.",
            code="missing-file",
        ) from None
    except OSError as error:
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(mode):
        raise InputError(f"image {path} is not a regular file", remedy="Put the image there.", code="not-a-file")
    return open(path, "rb")


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"image {path} cannot be read: {error.strerror}", remedy="Check its permissions.", code="unreadable-file"
    )


def _header(stream: BinaryIO, path: Path) -> ImageHeader:
    try:
        return image_header.header_of(stream, str(path))
    except ImageHeaderError as error:
        raise InputError(error.what, remedy=error.remedy, code=error.code) from None
