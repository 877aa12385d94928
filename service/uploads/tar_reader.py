"""Strict reading of tar archives from outside (POSIX.1-2017 pax and ustar, GNU's long names), in one pass.

Python's tarfile reads headers of any length into memory, takes damaged headers for the end and seeks where it is told;
here the archive is a stream whose every byte is accounted for.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from service.errors import ServiceError
from service.uploads.archive_errors import Refusal, damaged, shown
from service.uploads.archive_limits import ArchiveLimits, Budget
from service.uploads.archive_names import safe_name
from service.uploads.decompress import UnpackedStream

_BLOCK_BYTES = 512
_CHUNK_BYTES = 1 << 20
_ZERO_BLOCK = bytes(_BLOCK_BYTES)
_MAX_EXTENSION_BYTES = 1 << 20  # of names, times and extended attributes of one entry
_MAX_EXTENSIONS = 16  # of one entry; tools write up to four
# What an entry may take beside its content: headers, long names, padding; and the padding of the archive's end.
_OVERHEAD_PER_ENTRY_BYTES = 8 * _BLOCK_BYTES
_OVERHEAD_BYTES = 1 << 20

_FILES = frozenset({b"0", b"\0", b"7"})  # 7: contiguous, a file like others
_FOLDER = b"5"
_LONG_NAME, _LONG_LINK = b"L", b"K"
_PAX, _PAX_SOLARIS, _PAX_GLOBAL = b"x", b"X", b"g"
_REFUSED = {
    b"1": "a hard link",
    b"2": "a symbolic link",
    b"3": "a device",
    b"4": "a device",
    b"6": "a pipe",
    b"S": "a sparse file",
    b"M": "the rest of a file of another archive",
    b"D": "a list of files of an incremental backup",
}
_SPARSE_KEY = "GNU.sparse."
_OCTAL = re.compile(rb" *([0-7]*)[ \0]*")
_PAX_LENGTH = re.compile(rb"([1-9][0-9]{0,6}) ")
_PAX_SIZE = re.compile(r"[0-9]{1,19}")


class TarEntry:
    """One file of the archive; its content is to be read before the next entry is asked for, or it is skipped."""

    def __init__(self, stream: UnpackedStream, name: str, size_bytes: int) -> None:
        self.name = name
        self.size_bytes = size_bytes
        self._stream = stream
        self._left_bytes = size_bytes

    def read(self) -> Iterator[bytes]:
        """The content in chunks of bounded size.

        Raises
        ------
        ServiceError
            422, if the archive ends before the content does or is damaged.
        """
        while self._left_bytes:
            chunk = self._stream.read(min(self._left_bytes, _CHUNK_BYTES))
            if not chunk:
                raise damaged(f"it ends inside entry {shown(self.name)}, so it is truncated")
            self._left_bytes -= len(chunk)
            yield chunk

    def skip(self) -> None:
        """Go to the next entry's header."""
        for _ in self.read():
            pass
        padding_bytes = -self.size_bytes % _BLOCK_BYTES
        if len(self._stream.read(padding_bytes)) < padding_bytes:
            raise damaged(f"it ends inside entry {shown(self.name)}, so it is truncated")


@dataclass(frozen=True, slots=True)
class _Header:
    raw_name: bytes
    kind: bytes
    size_bytes: int


@dataclass(slots=True)
class _Extension:
    """What the headers before an entry's own say about it."""

    name: bytes | None = None
    size_bytes: int | None = None
    headers: int = 0


def is_tar(block: bytes) -> bool:
    """Whether a file begins with a tar header, or is an empty tar archive."""
    return len(block) == _BLOCK_BYTES and (block == _ZERO_BLOCK or _checksum_fits(block))


def read_tar(stream: BinaryIO, compression: str | None, limits: ArchiveLimits) -> Iterator[TarEntry]:
    """All files of the archive in their order; folders are left out.

    Parameters
    ----------
    stream
        At its beginning.
    compression
        As `compression_of` says.

    Raises
    ------
    ServiceError
        415 `not-an-archive` if there is no tar archive inside, 422 that names the entry if it is damaged, over a limit
        or holds what is refused.
    """
    max_bytes = limits.max_bytes + limits.max_entries * _OVERHEAD_PER_ENTRY_BYTES + _OVERHEAD_BYTES
    unpacked = UnpackedStream(stream, compression, limits=limits, max_bytes=max_bytes)
    budget = Budget(limits)
    extension = _Extension()
    block = unpacked.read(_BLOCK_BYTES)
    if not is_tar(block):
        raise Refusal.NOT_AN_ARCHIVE(
            f"the {compression or 'sent'} data hold no tar archive", "Send a zip or a tar archive of the drive's files."
        )
    while block != _ZERO_BLOCK:
        header = _header(block)
        if header.kind in (_LONG_NAME, _LONG_LINK, _PAX, _PAX_SOLARIS, _PAX_GLOBAL):
            _extend(extension, header, unpacked)
        else:
            entry = _entry(header, extension, unpacked, budget=budget)
            if entry is not None:
                yield entry
                entry.skip()
            extension = _Extension()
        block = unpacked.read(_BLOCK_BYTES)
        if len(block) < _BLOCK_BYTES:
            raise damaged("it ends without its end mark, so it is truncated")
    if extension.name is not None or extension.size_bytes is not None:
        raise damaged("it ends before an entry whose name or size it gives")
    while rest := unpacked.read(_CHUNK_BYTES):
        if rest.strip(b"\0"):
            raise damaged("other bytes follow its end mark")


def _entry(header: _Header, extension: _Extension, stream: UnpackedStream, *, budget: Budget) -> TarEntry | None:
    """The checked entry; None for a folder."""
    raw_name = header.raw_name if extension.name is None else extension.name
    size_bytes = header.size_bytes if extension.size_bytes is None else extension.size_bytes
    if header.kind in _REFUSED:
        raise _refused(raw_name, f"is {_REFUSED[header.kind]}")
    is_folder = header.kind == _FOLDER or (header.kind == b"\0" and raw_name.endswith(b"/"))
    if not is_folder and header.kind not in _FILES:
        raise _refused(raw_name, f"is of the unknown type {shown(header.kind)}")
    name = safe_name(raw_name, is_folder=is_folder)
    if is_folder and size_bytes:
        raise damaged(f"folder {shown(name)} has content")
    budget.entry(name, size_bytes)
    stream.begin_section(f"entry {shown(name)} of the archive")
    return None if is_folder else TarEntry(stream, name, size_bytes)


def _refused(raw_name: bytes, problem: str) -> ServiceError:
    return Refusal.UNSAFE(f"entry {shown(raw_name)} of the archive {problem}", "Put the file itself into the archive.")


def _header(block: bytes) -> _Header:
    if not _checksum_fits(block):
        raise damaged("a header has the wrong checksum")
    name = block[:100].partition(b"\0")[0]
    kind = block[156:157]
    size_bytes = _number(block[124:136], name)
    prefix = block[345:500].partition(b"\0")[0]
    if prefix and block[257:263] == b"ustar\0":  # GNU's own format keeps other things in these bytes
        name = prefix + b"/" + name
    return _Header(name, kind, size_bytes)


def _checksum_fits(block: bytes) -> bool:
    declared = _OCTAL.fullmatch(block[148:156])
    if declared is None or not declared[1]:
        return False
    summed = block[:148] + b" " * 8 + block[156:]
    unsigned = sum(summed)
    signed = unsigned - 256 * sum(byte > 127 for byte in summed)  # as some old systems counted
    return int(declared[1], 8) in (unsigned, signed)


def _number(data: bytes, name: bytes) -> int:
    """A header's number: octal, or in GNU's way binary with the first bit set."""
    if data[0] & 0x80:
        if data[0] & 0x40:
            raise damaged(f"entry {shown(name)} declares a negative size")
        return int.from_bytes(bytes([data[0] & 0x3F]) + data[1:], "big")
    octal = _OCTAL.fullmatch(data)
    if octal is None:
        raise damaged(f"entry {shown(name)} declares the size {shown(data)}, which is not a number")
    return int(octal[1] or b"0", 8)


def _extend(extension: _Extension, header: _Header, stream: UnpackedStream) -> None:
    extension.headers += 1
    if extension.headers > _MAX_EXTENSIONS:
        raise damaged(f"over {_MAX_EXTENSIONS} headers without an entry follow each other")
    if header.size_bytes > _MAX_EXTENSION_BYTES:
        raise Refusal.TOO_LARGE(
            f"the archive holds a header of {header.size_bytes} bytes, the bound is {_MAX_EXTENSION_BYTES}",
            "Make the archive without extended attributes.",
        )
    padded_bytes = header.size_bytes + -header.size_bytes % _BLOCK_BYTES
    data = stream.read(padded_bytes)
    if len(data) < padded_bytes:
        raise damaged("it ends inside a header, so it is truncated")
    data = data[: header.size_bytes]
    if header.kind == _PAX_GLOBAL:
        _check_global(data)
        return
    if header.kind == _LONG_NAME:
        extension.name = data.partition(b"\0")[0]
    elif header.kind != _LONG_LINK:  # links are refused by their own header
        _apply_pax(extension, data)


def _check_global(data: bytes) -> None:
    """Comments, as git's, are fine; what holds for all entries at once cannot be a name or a size."""
    for key, _ in _pax_records(data):
        if key in ("path", "size", "linkpath") or key.startswith(_SPARSE_KEY):
            raise Refusal.UNSUPPORTED(
                f"the archive gives all its entries the same {key!r}", "Make the archive again with another tool."
            )


def _apply_pax(extension: _Extension, data: bytes) -> None:
    for key, value in _pax_records(data):
        if key == "path":
            if b"\0" in value:
                raise _refused(value, "has control or invisible characters in its name")
            extension.name = value
        elif key == "size":
            text = value.decode("ascii", "replace")
            if not _PAX_SIZE.fullmatch(text):
                raise damaged(f"an entry declares the size {shown(value)}, which is not a number of bytes")
            extension.size_bytes = int(text)
        elif key.startswith(_SPARSE_KEY):
            raise _refused(extension.name or b"", "is a sparse file")


def _pax_records(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Keys and values of records of the form 'LENGTH KEY=VALUE' and a line feed."""
    at = 0
    while at < len(data):
        length = _PAX_LENGTH.match(data, at)
        end = at + int(length[1]) if length else 0
        if length is None or not length.end() < end <= len(data) or data[end - 1 : end] != b"\n":
            raise damaged("a pax header is malformed")
        key, equals, value = data[length.end() : end - 1].partition(b"=")
        if not equals:
            raise damaged("a pax header is malformed")
        yield key.decode("utf-8", "backslashreplace"), value
        at = end
