"""Headers and last bytes of JPEG and PNG files, without decoding.

Memory and time are bounded whatever the bytes are: files come from outside.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from io import SEEK_END, BytesIO
from typing import BinaryIO

from schemas.drive import MAX_IMAGE_SIDE_PX

MAX_IMAGE_PIXELS = 200_000_000  # the largest cameras have 150 million; decoded, this is 600 MB

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_TAIL_BYTES = 4096  # cameras append padding and small records of their own after the end marker
_SEARCH_BYTES = 1 << 20  # read at a time where the end marker is not in the tail
_MAX_PARTS = 10_000  # chunks, segments or fill bytes of a header: real ones have some hundreds at most
_MAX_EXIF_BYTES = 1 << 20
_EXIF_ORIENTATION = 0x0112
# Start-of-frame markers; C4, C8 and CC lie in their range but mean something else.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a segment


class ImageKind(StrEnum):
    """Format of a file's pixels."""

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
    """Properties of an image that are known without decoding it."""

    format: str  # "JPEG" or "PNG"
    width: int
    height: int
    kind: ImageKind
    bits: int  # per channel
    orientation: int  # EXIF's, 1 is upright
    complete: bool  # whether the end marker is there


class ImageHeaderError(ValueError):
    """A file that is no JPEG or PNG image of a plausible size.

    Parameters
    ----------
    what
        One sentence that names the image and what is wrong with it.
    remedy
        One sentence that says what to do.
    code
        `empty-file`, `not-an-image`, `damaged-image` or `image-too-large`.
    """

    def __init__(self, what: str, *, remedy: str, code: str) -> None:
        super().__init__(what)
        self.what = what
        self.remedy = remedy
        self.code = code


def header_of(source: bytes | BinaryIO, name: str) -> ImageHeader:
    """Header of a JPEG or PNG file.

    Parameters
    ----------
    source
        The file's content, or a seekable stream at its beginning.
    name
        What messages call the image.

    Raises
    ------
    ImageHeaderError
        If the file is empty, in another format, damaged or absurdly large in pixels.
    """
    stream = BytesIO(source) if isinstance(source, bytes) else source
    start = stream.read(len(_PNG_SIGNATURE))
    if not start:
        raise ImageHeaderError(
            f"image {name} is empty (0 bytes)", remedy="Copy it again from its source.", code="empty-file"
        )
    try:
        if start == _PNG_SIGNATURE:
            header = _png(stream)
        elif start.startswith(_JPEG_SIGNATURE):
            header = _jpeg(stream)
        else:
            raise ImageHeaderError(
                f"image {name} is neither a JPEG nor a PNG file", remedy="Convert it to PNG.", code="not-an-image"
            )
    except ImageHeaderError:
        raise
    except (ValueError, struct.error, KeyError):
        raise ImageHeaderError(
            f"image {name} has a damaged header", remedy="Copy it again from its source.", code="damaged-image"
        ) from None
    _check_size(header, name)
    return header


def _check_size(header: ImageHeader, name: str) -> None:
    width, height = header.width, header.height
    if max(width, height) > MAX_IMAGE_SIDE_PX or min(width, height) < 1:
        bound = f"{MAX_IMAGE_SIDE_PX} a side"
    elif width * height > MAX_IMAGE_PIXELS:
        bound = f"{MAX_IMAGE_PIXELS} in all"
    else:
        return
    raise ImageHeaderError(
        f"image {name} declares {width}x{height} pixels, the bound is {bound}",
        remedy="Give images of a camera, at most that large.",
        code="image-too-large",
    )


def _exactly(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise ValueError("the file ends inside its header")
    return data


def _ends_with(stream: BinaryIO, marker: bytes) -> bool:
    """Return whether the end marker comes after the stream's position: at the end usually, else anywhere."""
    data_start = stream.tell()
    size = stream.seek(0, SEEK_END)
    stream.seek(max(data_start, size - _TAIL_BYTES))
    if marker in stream.read(_TAIL_BYTES):
        return True
    stream.seek(data_start)
    seam = b""  # the marker may lie across two reads
    while data := stream.read(_SEARCH_BYTES):
        if marker in seam + data:
            return True
        seam = data[1 - len(marker) :]
    return False


def _png(stream: BinaryIO) -> ImageHeader:
    length, name = struct.unpack(">I4s", _exactly(stream, 8))
    if name != b"IHDR" or length != 13:
        raise ValueError("a PNG file begins with IHDR")
    width, height, bits, color = struct.unpack(">IIBB3x", _exactly(stream, 13))
    _exactly(stream, 4)
    orientation = _png_orientation(stream)
    return ImageHeader(
        format="PNG",
        width=width,
        height=height,
        kind=_PNG_KINDS[color],
        bits=bits,
        orientation=orientation,
        complete=_ends_with(stream, _PNG_END),
    )


def _png_orientation(stream: BinaryIO) -> int:
    """EXIF's orientation; leaves the stream behind the head of the first chunk of pixels."""
    exif = None
    for _ in range(_MAX_PARTS):
        length, name = struct.unpack(">I4s", _exactly(stream, 8))
        if name == b"IDAT":
            return 1 if exif is None else _exif_orientation(exif)
        if name == b"eXIf" and exif is None and length <= _MAX_EXIF_BYTES:
            exif = _exactly(stream, length)
            _exactly(stream, 4)
        else:
            stream.seek(length + 4, 1)
    raise ValueError("a PNG file has pixels")


def _jpeg(stream: BinaryIO) -> ImageHeader:
    exif, frame = None, None
    for marker, length in _jpeg_segments(stream):
        if marker == 0xE1 and exif is None:
            data = _exactly(stream, length)
            exif = data[6:] if data.startswith(b"Exif\0\0") else None
        elif marker in _JPEG_FRAMES:
            bits, height, width, channels = struct.unpack(">BHHB", _exactly(stream, 6))
            frame = (width, height, bits, _JPEG_KINDS[channels])
        elif marker == 0xDA:  # the scan: from here on FF D9 can only be the end
            break
    if frame is None:
        raise ValueError("a JPEG file has a frame before its scan")
    width, height, bits, kind = frame
    return ImageHeader(
        format="JPEG",
        width=width,
        height=height,
        kind=kind,
        bits=bits,
        orientation=1 if exif is None else _exif_orientation(exif),
        complete=_ends_with(stream, _JPEG_END),
    )


def _jpeg_segments(stream: BinaryIO) -> Iterator[tuple[int, int]]:
    """Markers and the length of their segments, with the stream at the segment's content."""
    stream.seek(2)
    for _ in range(_MAX_PARTS):
        marker = _jpeg_marker(stream)
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
    raise ValueError("a JPEG file has a scan")


def _jpeg_marker(stream: BinaryIO) -> int:
    if _exactly(stream, 1) != b"\xff":
        raise ValueError("a JPEG segment begins with FF")
    for _ in range(_MAX_PARTS):
        marker = _exactly(stream, 1)[0]
        if marker != 0xFF:  # else a fill byte
            return marker
    raise ValueError("a JPEG marker follows its fill bytes")


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
