"""What the header and the last bytes of a JPEG or PNG file say about it, without decoding it."""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO

from mrasfm_engine.errors import InputError
from schemas.drive import MAX_IMAGE_SIDE_PX

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_TAIL_BYTES = 4096  # cameras append padding and small records of their own after the end marker
_EXIF_ORIENTATION = 0x0112
# Start-of-frame markers; C4, C8 and CC lie in their range but mean something else.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a segment


class ImageKind(StrEnum):
    """How a file's pixels are stored."""

    GRAY = "gray"
    GRAY_ALPHA = "gray and alpha"
    RGB = "rgb"
    RGBA = "rgba"
    PALETTE = "palette"
    CMYK = "cmyk"


_PNG_KINDS = {
    0: ImageKind.GRAY,
    2: ImageKind.RGB,
    3: ImageKind.PALETTE,
    4: ImageKind.GRAY_ALPHA,
    6: ImageKind.RGBA,
}
_JPEG_KINDS = {1: ImageKind.GRAY, 3: ImageKind.RGB, 4: ImageKind.CMYK}


@dataclass(frozen=True, kw_only=True)
class ImageHeader:
    """What is known of an image without decoding it."""

    format: str  # "JPEG" or "PNG"
    width: int
    height: int
    kind: ImageKind
    bits: int  # per channel
    orientation: int  # EXIF's, 1 is upright
    complete: bool  # whether the end marker is there


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
    start = stream.read(len(_PNG_SIGNATURE))
    if not start:
        raise InputError(f"image {path} is empty (0 bytes)", remedy="Copy it again from its source.", code="empty-file")
    try:
        if start == _PNG_SIGNATURE:
            header = _png(stream)
        elif start.startswith(_JPEG_SIGNATURE):
            header = _jpeg(stream)
        else:
            raise InputError(
                f"image {path} is neither a JPEG nor a PNG file", remedy="Convert it to PNG.", code="not-an-image"
            )
    except (ValueError, struct.error, KeyError):
        raise InputError(
            f"image {path} has a damaged header", remedy="Copy it again from its source.", code="damaged-image"
        ) from None
    if max(header.width, header.height) > MAX_IMAGE_SIDE_PX or min(header.width, header.height) < 1:
        raise InputError(
            f"image {path} declares {header.width}x{header.height} pixels, the bound is {MAX_IMAGE_SIDE_PX} a side",
            remedy="Give images of a camera, at most that large.",
            code="image-too-large",
        )
    return header


def _exactly(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise ValueError("the file ends inside its header")
    return data


def _ends_with(stream: BinaryIO, marker: bytes) -> bool:
    """Whether the end marker comes after the stream's position: at the end usually, else anywhere."""
    data_start = stream.tell()
    size = stream.seek(0, SEEK_END)
    stream.seek(max(data_start, size - _TAIL_BYTES))
    if marker in stream.read():
        return True
    stream.seek(data_start)
    return marker in stream.read()


def _png(stream: BinaryIO) -> ImageHeader:
    length, name = struct.unpack(">I4s", _exactly(stream, 8))
    if name != b"IHDR" or length != 13:
        raise ValueError("a PNG file begins with IHDR")
    width, height, bits, color = struct.unpack(">IIBB3x", _exactly(stream, 13))
    _exactly(stream, 4)
    orientation = 1
    while True:
        length, name = struct.unpack(">I4s", _exactly(stream, 8))
        if name == b"IDAT":
            break
        if name == b"eXIf" and length <= 1 << 20:
            orientation = _exif_orientation(_exactly(stream, length))
            _exactly(stream, 4)
        else:
            stream.seek(length + 4, 1)
    complete = _ends_with(stream, _PNG_END)
    return ImageHeader(
        format="PNG",
        width=width,
        height=height,
        kind=_PNG_KINDS[color],
        bits=bits,
        orientation=orientation,
        complete=complete,
    )


def _jpeg(stream: BinaryIO) -> ImageHeader:
    orientation, frame = 1, None
    for marker, length in _jpeg_segments(stream):
        if marker == 0xE1:
            data = _exactly(stream, length)
            if data.startswith(b"Exif\0\0"):
                orientation = _exif_orientation(data[6:])
        elif marker in _JPEG_FRAMES:
            bits, height, width, channels = struct.unpack(">BHHB", _exactly(stream, 6))
            frame = (width, height, bits, _JPEG_KINDS[channels])
        elif marker == 0xDA:  # the scan: from here on FF D9 can only be the end
            break
    if frame is None:
        raise ValueError("a JPEG file has a frame before its scan")
    complete = _ends_with(stream, _JPEG_END)
    width, height, bits, kind = frame
    return ImageHeader(
        format="JPEG", width=width, height=height, kind=kind, bits=bits, orientation=orientation, complete=complete
    )


def _jpeg_segments(stream: BinaryIO) -> Iterator[tuple[int, int]]:
    """Markers and the length of their segments, with the stream at the segment's content."""
    stream.seek(2)
    while True:
        if _exactly(stream, 1) != b"\xff":
            raise ValueError("a JPEG segment begins with FF")
        marker = 0xFF
        while marker == 0xFF:  # fill bytes
            marker = _exactly(stream, 1)[0]
        if marker in _JPEG_BARE:
            continue
        if marker == 0xD9:
            raise ValueError("the image ends before its scan")
        length = int(struct.unpack(">H", _exactly(stream, 2))[0]) - 2
        if length < 0:
            raise ValueError("a JPEG segment has a length of at least 2")
        content = stream.tell()
        yield marker, length
        stream.seek(content + length)


def _exif_orientation(tiff: bytes) -> int:
    """Orientation in EXIF's TIFF structure; 1, upright, where it says nothing readable."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 8:
        return 1
    offset = int(struct.unpack(order + "I", tiff[4:8])[0])
    if offset + 2 > len(tiff):
        return 1
    count = int(struct.unpack(order + "H", tiff[offset : offset + 2])[0])
    for i in range(count):
        entry = tiff[offset + 2 + 12 * i : offset + 14 + 12 * i]
        if len(entry) < 12:
            return 1
        tag, kind = struct.unpack(order + "HH", entry[:4])
        if tag == _EXIF_ORIENTATION and kind == 3:
            value = int(struct.unpack(order + "H", entry[8:10])[0])
            return value if 1 <= value <= 8 else 1
    return 1
