"""Files compressed with gzip, bzip2 or xz, opened as streams of bounded memory."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zlib
from typing import Any, BinaryIO, cast

from service.storage.uploads.archive_errors import damaged

# What data raise that are damaged or truncated.
ERRORS = (EOFError, OSError, zlib.error, lzma.LZMAError)
MAX_XZ_MEMORY_BYTES = 100_000_000  # xz -9 needs 65 MB; a header can ask for 4 GB

_CHUNK_BYTES = 1 << 16
_BUFFER_BYTES = 1 << 18
_MAX_EMPTY_BYTES = 1 << 20
_MAGIC = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\x00": "xz"}


def compression_of(start: bytes) -> str | None:
    """gzip, bzip2 or xz by a file's first bytes, None for anything else."""
    return next((name for magic, name in _MAGIC.items() if start.startswith(magic)), None)


class Packed:
    """A file as the decompressor reads it; both sides of it are counted, `unpacked_bytes` by the reader."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.packed_bytes = 0
        self.unpacked_bytes = 0

    def read(self, size_bytes: int) -> bytes:
        """The next bytes."""
        if (
            self.packed_bytes > 2 * self.unpacked_bytes + _MAX_EMPTY_BYTES
        ):  # joined pieces are fine, millions of empty ones not
            raise damaged("its compressed data consist of too many pieces that hold nothing")
        data = self._stream.read(size_bytes)
        self.packed_bytes += len(data)
        return data


def unpacked(packed: Packed, compression: str | None) -> BinaryIO:
    """The content, to be read forwards."""
    if compression is None:
        return cast(BinaryIO, packed)
    pieces = gzip.GzipFile(fileobj=cast(Any, packed), mode="rb") if compression == "gzip" else None
    return cast(BinaryIO, io.BufferedReader(cast(Any, pieces or _Pieces(packed, compression)), _BUFFER_BYTES))


class _Pieces(io.RawIOBase):
    """One or more pieces of bzip2 or xz data, padded with zeros.

    The library's BZ2File and LZMAFile pass over other bytes that follow, and the latter takes the memory asked for.
    """

    def __init__(self, packed: Packed, compression: str) -> None:
        self._packed = packed
        self._compression = compression
        self._decompressor = self._new_decompressor()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = chunk = b""
        while not chunk:
            if self._decompressor.eof:
                data = self._next_piece()
                if not data:
                    return 0
                self._decompressor = self._new_decompressor()
            elif self._decompressor.needs_input:
                data = self._packed.read(_CHUNK_BYTES)
                if not data:
                    raise EOFError
            chunk, data = self._decompressor.decompress(data, len(buffer)), b""
        buffer[: len(chunk)] = chunk
        return len(chunk)

    def _new_decompressor(self) -> bz2.BZ2Decompressor | lzma.LZMADecompressor:
        if self._compression == "bzip2":
            return bz2.BZ2Decompressor()
        return lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=MAX_XZ_MEMORY_BYTES)

    def _next_piece(self) -> bytes:
        """The first bytes behind the piece that has ended; empty at the end of the file."""
        data = self._decompressor.unused_data.lstrip(b"\0")
        while not data and (more := self._packed.read(_CHUNK_BYTES)):
            data = more.lstrip(b"\0")
        return data
