"""A compressed file read as a stream of bounded memory, whose ratio is watched."""

from __future__ import annotations

import bz2
import lzma
import zlib
from typing import BinaryIO, Protocol

from service.errors import ServiceError
from service.uploads.archive_errors import Refusal, damaged
from service.uploads.archive_limits import SMALL_BYTES, ArchiveLimits, require_ratio

_PACKED_CHUNK_BYTES = 1 << 16
_CHUNK_BYTES = 1 << 18
# xz -9 needs 65 MB; a header can ask for 4 GB.
_MAX_XZ_MEMORY_BYTES = 100_000_000
# An archive may be joined of compressed pieces, but not of millions that hold nothing.
_FREE_PIECES = 1_000
_BYTES_PER_PIECE = 1_024

_MAGIC = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\x00": "xz"}
_MAGIC_BYTES = 6


class _Decompressor(Protocol):
    """What the three have in common."""

    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

    @property
    def needs_input(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int) -> bytes: ...


class _Gunzip:
    """zlib's decompressor with the interface of bz2's and lzma's."""

    def __init__(self) -> None:
        self._inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)

    @property
    def eof(self) -> bool:
        return self._inflater.eof

    @property
    def unused_data(self) -> bytes:
        return self._inflater.unused_data

    @property
    def needs_input(self) -> bool:
        return not self._inflater.unconsumed_tail

    def decompress(self, data: bytes, max_length: int) -> bytes:
        return self._inflater.decompress(self._inflater.unconsumed_tail + data, max_length)


def compression_of(start: bytes) -> str | None:
    """gzip, bzip2 or xz by a file's first bytes, None for anything else."""
    return next((name for magic, name in _MAGIC.items() if start.startswith(magic)), None)


class UnpackedStream:
    """The content of a file that may be compressed, read forwards.

    Parameters
    ----------
    stream
        At its beginning.
    compression
        As `compression_of` says.
    max_bytes
        What the file may unpack to.
    """

    def __init__(self, stream: BinaryIO, compression: str | None, *, limits: ArchiveLimits, max_bytes: int) -> None:
        self._stream = stream
        self._compression = compression
        self._max_ratio = limits.max_ratio
        self._max_bytes = max_bytes
        self._decompressor = self._new_decompressor() if compression else None
        self._pieces = 1
        self._buffer = b""
        self._at = 0
        self._packed_bytes = 0
        self._unpacked_bytes = 0
        self._section = ("the archive", 0, 0)

    def begin_section(self, what: str) -> None:
        """Watch the ratio of what comes now by itself too; `what` is the message's subject."""
        self._section = (what, self._packed_bytes, self._unpacked_bytes)

    def read(self, size_bytes: int) -> bytes:
        """The next bytes; fewer only at the end.

        Raises
        ------
        ServiceError
            422, if the compressed data are damaged or unpack to too much.
        """
        parts: list[bytes] = []
        left = size_bytes
        while left:
            if self._at == len(self._buffer):
                self._buffer, self._at = self._next_chunk(), 0
                if not self._buffer:
                    break
            part = self._buffer[self._at : self._at + left]
            self._at += len(part)
            left -= len(part)
            parts.append(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _next_chunk(self) -> bytes:
        chunk = self._stream.read(_CHUNK_BYTES) if self._decompressor is None else self._decompressed()
        self._unpacked_bytes += len(chunk)
        self._check_size()
        return chunk

    def _decompressed(self) -> bytes:
        assert self._decompressor is not None
        data = b""
        while True:
            if self._decompressor.eof:
                data = self._decompressor.unused_data
                if len(data) < _MAGIC_BYTES:
                    data += self._packed()
                if not self._begin_piece(data):
                    return b""
            elif self._decompressor.needs_input and not data:
                data = self._packed()
                if not data:
                    raise damaged(f"its {self._compression} data end too early, so it is truncated")
            try:
                chunk = self._decompressor.decompress(data, _CHUNK_BYTES)
            except lzma.LZMAError as error:
                raise self._xz_error(error) from None
            except (zlib.error, OSError, EOFError, ValueError):  # OSError is what bz2 raises
                raise damaged(f"its {self._compression} data cannot be unpacked") from None
            data = b""
            if chunk:
                return chunk

    def _begin_piece(self, data: bytes) -> bool:
        """Whether another compressed piece follows the one that has ended, and begins with the data."""
        if not data.strip(b"\0"):  # tapes and block devices pad with zeros
            while padding := self._packed():
                if padding.strip(b"\0"):
                    raise damaged(f"other bytes follow its {self._compression} data")
            return False
        if compression_of(data) != self._compression:
            raise damaged(f"other bytes follow its {self._compression} data")
        self._pieces += 1
        if self._pieces > _FREE_PIECES + self._unpacked_bytes // _BYTES_PER_PIECE:
            raise damaged(f"its {self._compression} data consist of too many pieces")
        self._decompressor = self._new_decompressor()
        return True

    def _new_decompressor(self) -> _Decompressor:
        if self._compression == "gzip":
            return _Gunzip()
        if self._compression == "bzip2":
            return bz2.BZ2Decompressor()
        return lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=_MAX_XZ_MEMORY_BYTES)

    def _packed(self) -> bytes:
        data = self._stream.read(_PACKED_CHUNK_BYTES)
        self._packed_bytes += len(data)
        return data

    def _xz_error(self, error: lzma.LZMAError) -> ServiceError:
        if "emory" in str(error):
            return Refusal.UNSUPPORTED(
                f"the archive needs over {_MAX_XZ_MEMORY_BYTES // 1_000_000} MB of memory to be unpacked",
                "Compress it with xz -9 at most, or with gzip.",
            )
        return damaged("its xz data cannot be unpacked")

    def _check_size(self) -> None:
        if self._unpacked_bytes > self._max_bytes:
            raise Refusal.TOO_LARGE(
                f"the archive unpacks to over {self._max_bytes} bytes", "Send the drive in several archives."
            )
        if self._decompressor is None:
            return
        what, packed_before, unpacked_before = self._section
        require_ratio(
            "the archive",
            packed_bytes=self._packed_bytes,
            unpacked_bytes=self._unpacked_bytes,
            max_ratio=self._max_ratio,
        )
        # What was read ahead of the section may belong to it.
        require_ratio(
            what,
            packed_bytes=self._packed_bytes - packed_before + _PACKED_CHUNK_BYTES,
            unpacked_bytes=self._unpacked_bytes - unpacked_before - SMALL_BYTES,
            max_ratio=self._max_ratio,
        )
