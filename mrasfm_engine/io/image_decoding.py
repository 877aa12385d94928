"""Decodes JPEG and PNG data; an image of which pixels are missing is refused, not filled up.

OpenCV hands out what libjpeg made of a file that ends early: grey below the cut, and no word of it. `simplejpeg` runs
the same libjpeg-turbo with the same settings, so that sound images get the same pixels, and raises what libjpeg warns
of. OpenCV's PNG decoder refuses such files itself.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_header import ImageHeader
from mrasfm_engine.scene.drive import LeftOut
from mrasfm_engine.types import Bytes

Colours = Literal["RGB", "GRAY"]

# libjpeg met the end of the data where pixels were still to come.
_PREMATURE_END = re.compile(r"premature end|found marker 0xd9 instead of RST", re.IGNORECASE)
# All other complaints about the compressed pixels: some were decoded from other bytes than their own.
_CORRUPT = "Corrupt JPEG data: "
# All pixels were there, and padding of some cameras after them; before another marker it is data that got lost.
_PADDING_BEFORE_THE_END = re.compile(r"extraneous bytes before marker 0xd9")
_MISSING_GRAY = 128  # what libjpeg fills missing blocks with, to the end of the last row
_LAST_PX = 16  # of that row, a block of subsampled colours

_PNG_SIGNATURE_BYTES = 8
_INFLATED_BYTES = 1 << 20  # at a time


class IncompleteImageError(InputError):
    """An image of which some pixels can be decoded and others not.

    Parameters
    ----------
    reason
        Whether the data end early or are corrupt on the way; the code is `truncated-image` or `corrupt-image`.
    """

    def __init__(self, what: str, reason: LeftOut) -> None:
        super().__init__(what, remedy="Copy it again from its source.", code=f"{reason}-image")
        self.reason = reason


def decode_jpeg(data: Bytes, colours: Colours, header: ImageHeader, path: Path) -> Bytes:
    """Pixels (height, width, 3) or, gray, (height, width), as they are stored; `path` is for messages.

    Raises
    ------
    IncompleteImageError
        Where pixels are missing or corrupt.
    InputError
        Where the image cannot be decoded at all.
    """
    pixels: Bytes | None
    try:
        pixels = _simply_decoded(data, colours, strict=True)
    except ValueError as warning:
        pixels = _decoded_in_spite_of(str(warning), data, colours, path)
    return _of_size(pixels, header, path)


def decode_jpeg_small(data: Bytes, colours: Colours, width_px: int) -> Bytes | None:
    """Pixels as of `decode_jpeg`, reduced by a power of two to `width_px` or somewhat more.

    None where libjpeg has any complaint: `decode_jpeg` judges it.
    """
    try:
        pixels = simplejpeg.decode_jpeg(
            data, colours, fastdct=False, fastupsample=False, min_width=width_px, min_factor=1, strict=True
        )
    except ValueError:
        return None
    return _without_channel(pixels, colours)


def decode_png(data: Bytes, flags: int, header: ImageHeader, path: Path) -> Bytes | NDArray[np.uint16]:
    """Pixels as OpenCV's flags say; `path` is for messages.

    Raises
    ------
    IncompleteImageError
        Where pixels are missing or corrupt.
    InputError
        Where the image has another size than its header says.
    """
    pixels = _opencv_decoded(data, flags)
    if pixels is None and _ends_early(data.tobytes()):
        raise _truncated(path)
    if pixels is None:
        what = f"image {path} is damaged and cannot be decoded"
        raise IncompleteImageError(what, LeftOut.CORRUPT)
    return _of_size(pixels, header, path)


def _simply_decoded(data: Bytes, colours: Colours, *, strict: bool) -> Bytes:
    pixels = simplejpeg.decode_jpeg(data, colours, fastdct=False, fastupsample=False, strict=strict)
    return _without_channel(pixels, colours)


def _without_channel(pixels: Bytes, colours: Colours) -> Bytes:
    """Pixels of simplejpeg, which gives grey ones a channel."""
    return np.asarray(pixels[..., 0] if colours == "GRAY" else pixels, dtype=np.uint8)


def _decoded_in_spite_of(warning: str, data: Bytes, colours: Colours, path: Path) -> Bytes | None:
    """The pixels, if the warning does not mean that some are missing; None if there are none.

    Besides padding, only oddities of headers are harmless: a version or a subsampling that few files have.
    """
    if _PREMATURE_END.search(warning):
        raise _truncated(path)
    is_padded = _PADDING_BEFORE_THE_END.search(warning) is not None
    if warning.startswith(_CORRUPT) and not is_padded:
        what = f"image {path} has corrupt data: {warning.removeprefix(_CORRUPT)}"
        raise IncompleteImageError(what, LeftOut.CORRUPT)
    pixels: Bytes | None
    try:
        pixels = _simply_decoded(data, colours, strict=False)
    except ValueError:
        flags = cv2.IMREAD_GRAYSCALE if colours == "GRAY" else cv2.IMREAD_COLOR
        pixels = _opencv_decoded(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is not None and pixels.ndim == 3:
            pixels = np.ascontiguousarray(pixels[..., ::-1])
    # libjpeg tells one warning: that of the header, or of what looks like padding, hides that pixels are missing.
    if pixels is not None and (pixels[-1, -_LAST_PX:] == _MISSING_GRAY).all():
        raise _truncated(path)
    return pixels


def _opencv_decoded(data: Bytes, flags: int) -> Bytes | None:
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None


def _of_size(pixels: Bytes | None, header: ImageHeader, path: Path) -> Bytes:
    if pixels is None or pixels.shape[:2] != (header.height, header.width):
        raise InputError(
            f"image {path} is damaged and cannot be decoded",
            remedy="Copy it again from its source.",
            code="damaged-image",
        )
    return pixels


def _truncated(path: Path) -> IncompleteImageError:
    what = f"image {path} is truncated: its end marker is there, pixels before it are missing"
    return IncompleteImageError(what, LeftOut.TRUNCATED)


def _ends_early(png: bytes) -> bool:
    """Return whether the compressed pixels of a PNG file are sound as far as they go, but end early."""
    inflater = zlib.decompressobj()
    at = _PNG_SIGNATURE_BYTES
    try:
        while at + 12 <= len(png):
            length, name = struct.unpack_from(">I4s", png, at)
            data = png[at + 8 : at + 8 + length]
            if len(data) + 4 > len(png) - at - 8:
                return True
            if struct.unpack_from(">I", png, at + 8 + length)[0] != zlib.crc32(data, zlib.crc32(name)):
                return False
            if name == b"IEND":
                break
            if name == b"IDAT":
                _inflate(inflater, data)
            at += 12 + length
    except zlib.error:
        return False
    return not inflater.eof


def _inflate(inflater: zlib._Decompress, data: bytes) -> None:
    """Feed the data and keep nothing of what they become."""
    while data:
        inflater.decompress(data, _INFLATED_BYTES)
        data = inflater.unconsumed_tail
