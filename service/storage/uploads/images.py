"""Refuses files that are no images, before anything else is done with them."""

from __future__ import annotations

from pathlib import Path

from schemas.image_header import ImageHeader, ImageHeaderError, header_of
from service.errors import ImageRefused


def check_image(path: Path, name: str) -> ImageHeader:
    """Header of a received file.

    Parameters
    ----------
    path
        Where the file lies.
    name
        Its path in the drive, for messages.

    Raises
    ------
    ServiceError
        422 with the words and the code that the engine refuses the file with: `empty-file`, `not-an-image`,
        `damaged-image` or `image-too-large`.
    """
    try:
        with open(path, "rb") as stream:
            return header_of(stream, name)
    except ImageHeaderError as error:
        raise ImageRefused(error.what, remedy=error.remedy, code=error.code) from None
