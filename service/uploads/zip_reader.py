"""Strict reading of zip archives from outside (PKWARE's APPNOTE 6.3.10): stored and deflated entries, zip64.

Python's zipfile reads the whole directory into memory whatever its size, believes sizes and follows overlapping
entries: it is made for archives of friends. Here everything that the archive says twice has to agree.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from service.errors import ServiceError
from service.uploads.archive_errors import Refusal, damaged, shown
from service.uploads.archive_limits import ArchiveLimits, Budget, require_ratio, too_many_entries
from service.uploads.archive_names import safe_name

SIGNATURES = (b"PK\x03\x04", b"PK\x05\x06")  # of an archive's first entry; of an archive without entries

_CHUNK_BYTES = 1 << 18
_MAX_COMMENT_BYTES = 65_535
# Of the directory, for each entry that is allowed: a name of ours, a comment and what tools note of owners and times.
_DIRECTORY_BYTES_PER_ENTRY = 2048

_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR64 = struct.Struct("<4sLQL")
_RECORD = struct.Struct("<4s6H3L5H2L")
_LOCAL = struct.Struct("<4s5H3L2H")
_MAX_16, _MAX_32 = 0xFFFF, 0xFFFFFFFF

_ENCRYPTED = 0x0001 | 0x0040 | 0x2000  # traditional, strong, with a masked directory
_PATCH = 0x0020
_SIZES_FOLLOW = 0x0008
_UTF8 = 0x0800
_COMPARED_FLAGS = _ENCRYPTED | _UTF8
_ZIP64_FIELD = 0x0001
_UNICODE_PATH_FIELD = 0x7075

_STORED, _DEFLATED = 0, 8
_METHODS = {
    1: "Shrink",
    6: "Implode",
    9: "Deflate64",
    12: "bzip2",
    14: "LZMA",
    20: "Zstandard",
    93: "Zstandard",
    95: "xz",
    96: "JPEG",
    98: "PPMd",
    99: "AES encryption",
}
_FILE_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}


@dataclass(frozen=True, slots=True)
class ZipEntry:
    """One file of the archive, as the directory describes it."""

    name: str
    raw_name: bytes
    size_bytes: int
    packed_bytes: int
    crc: int
    flags: int
    method: int
    offset: int  # of its local header
    next_offset: int  # where the next entry or the directory begins


@dataclass(frozen=True, slots=True)
class _Directory:
    entries: int
    offset: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class _Record:
    raw_name: bytes
    flags: int
    method: int
    crc: int
    packed_bytes: int
    size_bytes: int
    mode: int
    offset: int


def read_directory(stream: BinaryIO, limits: ArchiveLimits) -> list[ZipEntry]:
    """All files of the archive in the order of their bytes; folders are left out.

    Raises
    ------
    ServiceError
        422 that names the entry, if the archive is damaged, over a limit, or holds what is refused.
    """
    archive_bytes = stream.seek(0, os.SEEK_END)
    directory = _find_directory(stream, archive_bytes)
    if directory.entries > limits.max_entries:
        raise too_many_entries(str(directory.entries), limits.max_entries)
    max_bytes = limits.max_entries * _DIRECTORY_BYTES_PER_ENTRY
    if directory.size_bytes > max_bytes:
        raise Refusal.TOO_LARGE(
            f"the archive's directory has {directory.size_bytes} bytes, the bound is {max_bytes}",
            "Make the archive without comments and extended attributes.",
        )
    records = sorted(_records(stream, directory), key=lambda record: record.offset)
    ends = [*(record.offset for record in records), directory.offset][1:]
    budget = Budget(limits)
    entries = []
    for record, next_offset in zip(records, ends, strict=True):
        entry = _entry(record, next_offset, budget=budget, max_ratio=limits.max_ratio)
        if entry is not None:
            entries.append(entry)
    unpacked_bytes = sum(entry.size_bytes for entry in entries)
    require_ratio("the archive", packed_bytes=archive_bytes, unpacked_bytes=unpacked_bytes, max_ratio=limits.max_ratio)
    return entries


def read_entry(stream: BinaryIO, entry: ZipEntry) -> Iterator[bytes]:
    """An entry's content in chunks of bounded size.

    Raises
    ------
    ServiceError
        422 `damaged-archive`, if the content is not what the directory says of it.
    """
    _seek_content(stream, entry)
    size_bytes, crc = 0, 0
    for chunk in _stored(stream, entry) if entry.method == _STORED else _inflated(stream, entry):
        size_bytes += len(chunk)
        if size_bytes > entry.size_bytes:
            raise damaged(f"entry {shown(entry.name)} holds more than the {entry.size_bytes} bytes that it declares")
        crc = zlib.crc32(chunk, crc)
        yield chunk
    if size_bytes < entry.size_bytes:
        raise damaged(f"entry {shown(entry.name)} holds {size_bytes} of the {entry.size_bytes} bytes that it declares")
    if crc != entry.crc:
        raise damaged(f"entry {shown(entry.name)} has the wrong checksum")


def _find_directory(stream: BinaryIO, archive_bytes: int) -> _Directory:
    stream.seek(max(0, archive_bytes - _END.size - _MAX_COMMENT_BYTES))
    tail_offset = stream.tell()
    tail = stream.read(_END.size + _MAX_COMMENT_BYTES)
    at = tail.rfind(b"PK\x05\x06")
    while at >= 0:
        if len(tail) - at >= _END.size:
            end = _END.unpack_from(tail, at)
            if at + _END.size + end[-1] == len(tail):  # else the signature is part of a comment or of an image
                return _directory(stream, end, tail_offset + at)
        at = tail.rfind(b"PK\x05\x06", 0, at)
    raise damaged("its directory is missing at the end, so it is truncated, or other bytes follow it")


def _directory(stream: BinaryIO, end: tuple[bytes, int, int, int, int, int, int, int], end_offset: int) -> _Directory:
    _, disk, start_disk, entries_here, entries, size_bytes, offset, _ = end
    locator_offset = end_offset - _LOCATOR64.size
    stream.seek(max(0, locator_offset))
    locator = stream.read(_LOCATOR64.size)
    if locator_offset >= 0 and locator.startswith(b"PK\x06\x07"):
        declared = (disk, start_disk, entries_here, entries, size_bytes, offset)
        end_offset, numbers = _zip64_numbers(stream, locator, locator_offset)
        bounds = (_MAX_16, _MAX_16, _MAX_16, _MAX_16, _MAX_32, _MAX_32)
        if any(a not in (bound, b) for a, b, bound in zip(declared, numbers, bounds, strict=True)):
            raise damaged("its two directory ends, zip and zip64, contradict each other")
        disk, start_disk, entries_here, entries, size_bytes, offset = numbers
    if disk or start_disk or entries_here != entries:
        raise Refusal.UNSUPPORTED("the archive is one part of several", "Send one archive that is not split.")
    if offset + size_bytes != end_offset:
        raise damaged("its directory does not lie where it says")
    return _Directory(entries, offset, size_bytes)


def _zip64_numbers(stream: BinaryIO, locator: bytes, locator_offset: int) -> tuple[int, tuple[int, ...]]:
    """Where the zip64 end lies, and its numbers in the order of the common end's."""
    _, disk, end_offset, disks = _LOCATOR64.unpack(locator)
    if disk or disks > 1:
        raise Refusal.UNSUPPORTED("the archive is one part of several", "Send one archive that is not split.")
    if end_offset + _END64.size != locator_offset:
        raise damaged("its zip64 directory end does not lie where it says")
    stream.seek(end_offset)
    signature, size_bytes, _, _, *numbers = _END64.unpack(stream.read(_END64.size))
    if signature != b"PK\x06\x06" or size_bytes != _END64.size - 12:
        raise damaged("its zip64 directory end is malformed")
    return end_offset, tuple(numbers)


def _records(stream: BinaryIO, directory: _Directory) -> Iterator[_Record]:
    """The directory's files, read one by one: how many there are is counted, not believed."""
    stream.seek(directory.offset)
    left = directory.size_bytes
    for _ in range(directory.entries):
        head = stream.read(_RECORD.size)
        if left < _RECORD.size or len(head) < _RECORD.size or not head.startswith(b"PK\x01\x02"):
            raise damaged("its directory ends before all entries that it declares")
        fields = _RECORD.unpack(head)
        lengths = fields[10:13]
        left -= _RECORD.size + sum(lengths)
        if left < 0:
            raise damaged("its directory ends inside an entry")
        raw_name, extra, _ = (stream.read(length) for length in lengths)
        yield _record(fields, raw_name, extra)
    if left:
        raise damaged("its directory holds more entries than it declares")


def _record(fields: tuple[int, ...], raw_name: bytes, extra: bytes) -> _Record:
    _, _, _, flags, method, _, _, crc, packed_bytes, size_bytes, _, _, _, disk, _, attributes, offset = fields
    extras = _extra_fields(extra, raw_name)
    size_bytes, packed_bytes, offset = _zip64_values(extras, (size_bytes, packed_bytes, offset), raw_name)
    _check_unicode_path(extras, raw_name)
    if disk not in (0, _MAX_16):
        raise Refusal.UNSUPPORTED("the archive is one part of several", "Send one archive that is not split.")
    return _Record(raw_name, flags, method, crc, packed_bytes, size_bytes, attributes >> 16, offset)


def _extra_fields(extra: bytes, raw_name: bytes) -> dict[int, bytes]:
    fields: dict[int, bytes] = {}
    at = 0
    while at + 4 <= len(extra):  # up to three bytes of padding may follow
        kind, length = struct.unpack_from("<2H", extra, at)
        value = extra[at + 4 : at + 4 + length]
        if len(value) < length or (kind in (_ZIP64_FIELD, _UNICODE_PATH_FIELD) and kind in fields):
            raise damaged(f"the extra fields of entry {shown(raw_name)} are malformed")
        fields[kind] = value
        at += 4 + length
    return fields


def _zip64_values(extras: dict[int, bytes], values: tuple[int, ...], raw_name: bytes) -> tuple[int, ...]:
    """Unpacked size, packed size and offset, with those that need 64 bits from their extra field."""
    if _MAX_32 not in values or _ZIP64_FIELD not in extras:
        return values
    field, result = extras[_ZIP64_FIELD], []
    for value in values:
        if value == _MAX_32:
            if len(field) < 8:
                raise damaged(f"the zip64 field of entry {shown(raw_name)} is too short")
            value, field = int.from_bytes(field[:8], "little"), field[8:]
        result.append(value)
    return tuple(result)


def _check_unicode_path(extras: dict[int, bytes], raw_name: bytes) -> None:
    """Refuse entries that have one name for some tools and another for others."""
    field = extras.get(_UNICODE_PATH_FIELD)
    if field is None:
        return
    if field[5:] != raw_name and field[1:5] == zlib.crc32(raw_name).to_bytes(4, "little"):
        raise Refusal.UNSAFE(
            f"entry {shown(raw_name)} of the archive has a second name, {shown(field[5:])}, in Unicode",
            "Make the archive with UTF-8 names (7-Zip: -mcu=on), or rename the file.",
        )


def _entry(record: _Record, next_offset: int, *, budget: Budget, max_ratio: float) -> ZipEntry | None:
    """The checked entry; None for a folder."""
    is_folder = record.raw_name.endswith(b"/") or stat.S_IFMT(record.mode) == stat.S_IFDIR
    name = safe_name(record.raw_name, is_folder=is_folder)
    if stat.S_IFMT(record.mode) in _FILE_KINDS:
        kind = _FILE_KINDS[stat.S_IFMT(record.mode)]
        raise Refusal.UNSAFE(f"entry {shown(name)} of the archive is {kind}", "Put the file itself into the archive.")
    _check_method(record, name)
    # The local header has the same name, so that the content ends here at the earliest.
    if record.offset + _LOCAL.size + len(record.raw_name) + record.packed_bytes > next_offset:
        raise _overlap(name)
    budget.entry(name, record.size_bytes)
    require_ratio(
        f"entry {shown(name)} of the archive",
        packed_bytes=record.packed_bytes,
        unpacked_bytes=record.size_bytes,
        max_ratio=max_ratio,
    )
    if is_folder:
        return None
    return ZipEntry(
        name=name,
        raw_name=record.raw_name,
        size_bytes=record.size_bytes,
        packed_bytes=record.packed_bytes,
        crc=record.crc,
        flags=record.flags,
        method=record.method,
        offset=record.offset,
        next_offset=next_offset,
    )


def _check_method(record: _Record, name: str) -> None:
    entry = f"entry {shown(name)} of the archive"
    if record.flags & _ENCRYPTED:
        raise Refusal.UNSUPPORTED(f"{entry} is encrypted", "Make the archive without a password.")
    if record.method not in (_STORED, _DEFLATED) or record.flags & _PATCH:
        method = _METHODS.get(record.method, f"method {record.method}")
        raise Refusal.UNSUPPORTED(
            f"{entry} is compressed with {method}", "Make the archive with Deflate, or without compression."
        )
    if record.method == _STORED and record.size_bytes != record.packed_bytes:
        raise damaged(f"entry {shown(name)} is stored as {record.packed_bytes} bytes and declares {record.size_bytes}")


def _seek_content(stream: BinaryIO, entry: ZipEntry) -> None:
    """Go to the entry's first byte, if its local header says the same as the directory."""
    stream.seek(entry.offset)
    head = stream.read(_LOCAL.size)
    if len(head) < _LOCAL.size or not head.startswith(b"PK\x03\x04"):
        raise damaged(f"entry {shown(entry.name)} does not lie where the directory says")
    _, _, flags, method, _, _, crc, packed_bytes, size_bytes, name_bytes, extra_bytes = _LOCAL.unpack(head)
    same = stream.read(name_bytes) == entry.raw_name and method == entry.method
    same = same and not (flags ^ entry.flags) & _COMPARED_FLAGS
    extras = _extra_fields(stream.read(extra_bytes), entry.raw_name)
    size_bytes, packed_bytes = _zip64_values(extras, (size_bytes, packed_bytes), entry.raw_name)
    declared = ((crc, entry.crc), (packed_bytes, entry.packed_bytes), (size_bytes, entry.size_bytes))
    if not same or any(a != b and not (a == 0 and flags & _SIZES_FOLLOW) for a, b in declared):
        raise damaged(f"entry {shown(entry.name)} has a header that contradicts the directory")
    if stream.tell() + entry.packed_bytes > entry.next_offset:
        raise _overlap(entry.name)


def _stored(stream: BinaryIO, entry: ZipEntry) -> Iterator[bytes]:
    left = entry.packed_bytes
    while left:
        chunk = stream.read(min(left, _CHUNK_BYTES))
        if not chunk:
            raise damaged(f"it ends inside entry {shown(entry.name)}")
        left -= len(chunk)
        yield chunk


def _inflated(stream: BinaryIO, entry: ZipEntry) -> Iterator[bytes]:
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    for packed in _stored(stream, entry):
        yield from _inflated_part(inflater, packed, entry.name)
        if inflater.unused_data:
            raise damaged(f"entry {shown(entry.name)} has bytes behind its end")
    if not inflater.eof:
        raise damaged(f"entry {shown(entry.name)} ends inside its compressed data")


def _inflated_part(inflater: zlib._Decompress, packed: bytes, name: str) -> Iterator[bytes]:
    if inflater.eof:
        raise damaged(f"entry {shown(name)} has bytes behind its end")
    chunk_bytes = _CHUNK_BYTES
    # A full chunk may leave more to come, even where all packed bytes have been taken in.
    while packed or chunk_bytes == _CHUNK_BYTES:
        try:
            chunk = inflater.decompress(packed, _CHUNK_BYTES)
        except zlib.error:
            raise damaged(f"entry {shown(name)} cannot be unpacked") from None
        packed, chunk_bytes = inflater.unconsumed_tail, len(chunk)
        if chunk:
            yield chunk
        if inflater.eof:
            return


def _overlap(name: str) -> ServiceError:
    return damaged(f"entry {shown(name)} overlaps another entry or the directory")
