"""Image files that were cut short or changed, as copies that broke off and recorders that crashed leave them."""

from __future__ import annotations

import struct
import zlib

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"


def cut(data: bytes, kept: float = 1 / 3) -> bytes:
    """The first part of a JPEG or PNG file with the end marker after it."""
    end = _PNG_END if data.startswith(_PNG_SIGNATURE) else _JPEG_END
    return data[: int(kept * len(data))] + end


def patched_frame(jpeg: bytes, *, sampling: int) -> bytes:
    """A baseline JPEG that says that its first channel has other sampling factors."""
    at = jpeg.index(b"\xff\xc0") + 11
    return jpeg[:at] + bytes([sampling]) + jpeg[at + 1 :]


def png_chunks(png: bytes) -> list[tuple[bytes, bytes]]:
    """Names and content."""
    at, found = len(_PNG_SIGNATURE), []
    while at < len(png):
        (length,) = struct.unpack_from(">I", png, at)
        found.append((png[at + 4 : at + 8], png[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png_of_chunks(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG file of chunks, with their checksums."""
    packed = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return _PNG_SIGNATURE + b"".join(packed)
