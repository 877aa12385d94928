"""Zip archives from outside, read with the standard library's zipfile: stored and deflated entries, zip64.

Zipfile reads a directory of any size into memory, and lets entries overlap: that is checked here. Otherwise it believes
the directory alone, stops at the size that an entry declares there, and compares the checksum.
"""

from __future__ import annotations

import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from service.errors import ArchiveTooLarge, UnsafeArchive, UnsupportedArchive
from service.storage.uploads.archive_errors import damaged, shown
from service.storage.uploads.archive_limits import ArchiveLimits, Budget, require_ratio, too_many_entries
from service.storage.uploads.archive_names import safe_name

SIGNATURES = (b"PK\x03\x04", b"PK\x05\x06")  # of an archive's first entry; of an archive without entries

_CHUNK_BYTES = 1 << 18
_MAX_COMMENT_BYTES = 65_535
_DIRECTORY_BYTES_PER_ENTRY = 256  # a name, and what tools note of owners and times
_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q4sLQL")  # with its locator
_LOCAL_HEADER_BYTES = 30

_ENCRYPTED = 0x0001 | 0x0040 | 0x2000  # traditional, strong, with a masked directory
_PATCH = 0x0020
_METHODS = {9: "Deflate64", 12: "bzip2", 14: "LZMA", 93: "Zstandard", 95: "xz", 99: "AES encryption"}
_FILE_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}
_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OverflowError)


class ZipReader:
    """A zip archive whose directory is checked.

    Attributes
    ----------
    entries
        All files with their safe names in the order of their bytes; folders are left out.

    Raises
    ------
    ServiceError
        422 that names the entry, if the archive is damaged, over a limit, or holds what is refused.
    """

    def __init__(self, stream: BinaryIO, limits: ArchiveLimits) -> None:
        archive_bytes = stream.seek(0, os.SEEK_END)
        declared, directory_offset = _check_directory(stream, archive_bytes, limits)
        try:
            self._archive = zipfile.ZipFile(stream, metadata_encoding="utf-8")
        except UnicodeDecodeError as error:
            safe_name(error.object)  # which refuses it, as it is not UTF-8
            raise
        except _ERRORS:
            raise damaged("its directory cannot be read") from None
        infos = sorted(self._archive.infolist(), key=lambda info: info.header_offset)
        if len(infos) != declared:
            raise damaged(f"its directory holds {len(infos)} entries and declares {declared}")
        ends = [*(info.header_offset for info in infos), directory_offset][1:]
        budget = Budget(limits)
        self.entries: list[tuple[str, zipfile.ZipInfo]] = []
        for info, end in zip(infos, ends, strict=True):
            name, is_folder = _checked_name(info)
            _check_content(info, name, end, limits.max_ratio)
            budget.entry(name, info.file_size)
            if not is_folder:
                self.entries.append((name, info))
        unpacked_bytes = sum(info.file_size for info in infos)
        _check_ratio("the archive", archive_bytes, unpacked_bytes, limits.max_ratio)

    def read(self, name: str, info: zipfile.ZipInfo) -> Iterator[bytes]:
        """An entry's content in chunks of bounded size.

        Raises
        ------
        ServiceError
            422 `damaged-archive`, if the content is not what the directory says of it.
        """
        size_bytes = 0
        try:
            with self._archive.open(info) as content:
                while chunk := content.read(_CHUNK_BYTES):
                    size_bytes += len(chunk)
                    yield chunk
        except _ERRORS:
            raise damaged(f"entry {shown(name)} cannot be unpacked, or has the wrong checksum") from None
        if size_bytes != info.file_size:
            raise damaged(f"entry {shown(name)} holds {size_bytes} of the {info.file_size} bytes that it declares")


def _check_directory(stream: BinaryIO, archive_bytes: int, limits: ArchiveLimits) -> tuple[int, int]:
    """The number of entries that the directory declares, and where it lies, if zipfile may read it into memory."""
    declared, size_bytes, offset = _find_directory(stream, archive_bytes)
    if declared > limits.max_entries:
        raise too_many_entries(str(declared), limits.max_entries)
    max_bytes = limits.max_entries * _DIRECTORY_BYTES_PER_ENTRY
    if size_bytes > max_bytes:
        raise ArchiveTooLarge(
            f"the archive's directory has {size_bytes} bytes, the bound is {max_bytes}",
            remedy="Make the archive without comments and extended attributes.",
        )
    stream.seek(offset)
    if stream.read(size_bytes).count(b"PK\x01\x02") > limits.max_entries:  # zipfile goes by the size, not the number
        raise too_many_entries(f"over {limits.max_entries}", limits.max_entries)
    return declared, offset


def _find_directory(stream: BinaryIO, archive_bytes: int) -> tuple[int, int, int]:
    """Entries, size and offset of the directory, as zipfile will find it."""
    stream.seek(max(0, archive_bytes - _END.size - _MAX_COMMENT_BYTES))
    tail = stream.read()
    at = tail.rfind(b"PK\x05\x06")
    if at < 0 or len(tail) - at < _END.size:
        raise damaged("its directory is missing at the end, so it is truncated, or other bytes follow it")
    _, disk, start_disk, entries_here, entries, size_bytes, offset, comment_bytes = _END.unpack_from(tail, at)
    if at + _END.size + comment_bytes != len(tail):
        raise damaged("other bytes follow its directory, or it is truncated")
    end_offset = archive_bytes - len(tail) + at
    stream.seek(max(0, end_offset - _END64.size))
    block = stream.read(min(end_offset, _END64.size))
    if block[-20:].startswith(b"PK\x06\x07"):  # the locator of a zip64 end
        end_offset -= _END64.size
        if not block.startswith(b"PK\x06\x06") or len(block) < _END64.size:
            raise damaged("its zip64 directory end does not lie where it says")
        _, _, _, _, disk, start_disk, entries_here, entries, size_bytes, offset, _, _, at, disks = _END64.unpack(block)
        if at != end_offset:
            raise damaged("its zip64 directory end does not lie where it says")
        disk = disk or disks > 1
    if disk or start_disk or entries_here != entries:
        raise UnsupportedArchive("the archive is one part of several", remedy="Send one archive that is not split.")
    if offset + size_bytes != end_offset:
        raise damaged("its directory does not lie where it says")
    return entries, size_bytes, offset


def _checked_name(info: zipfile.ZipInfo) -> tuple[str, bool]:
    """An entry's safe name, and whether it is a folder."""
    raw_name = info.orig_filename.encode("utf-8")  # `filename` is cut at a zero byte
    kind = stat.S_IFMT(info.external_attr >> 16)
    is_folder = raw_name.endswith(b"/") or kind == stat.S_IFDIR
    name = safe_name(raw_name, is_folder=is_folder)
    if kind in _FILE_KINDS:
        what = f"entry {shown(name)} of the archive is {_FILE_KINDS[kind]}"
        raise UnsafeArchive(what, remedy="Put the file itself into the archive.")
    return name, is_folder


def _check_content(info: zipfile.ZipInfo, name: str, end: int, max_ratio: float) -> None:
    """Refuse what is encrypted, not deflated, or in another's place; `end` is where the next entry begins."""
    entry = f"entry {shown(name)} of the archive"
    if info.flag_bits & _ENCRYPTED:
        raise UnsupportedArchive(f"{entry} is encrypted", remedy="Make the archive without a password.")
    if info.volume not in (0, 0xFFFF):
        raise UnsupportedArchive(
            f"{entry} lies in another of several parts", remedy="Send one archive that is not split."
        )
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & _PATCH:
        method = _METHODS.get(info.compress_type, f"method {info.compress_type}")
        raise UnsupportedArchive(
            f"{entry} is compressed with {method}", remedy="Make the archive with Deflate, or without compression."
        )
    # The local header has the same name, so that the content ends here at the earliest.
    name_bytes = len(info.orig_filename.encode("utf-8"))
    if info.header_offset + _LOCAL_HEADER_BYTES + name_bytes + info.compress_size > end:
        raise damaged(f"entry {shown(name)} overlaps another entry or the directory")
    _check_ratio(entry, info.compress_size, info.file_size, max_ratio)


def _check_ratio(what: str, packed_bytes: int, unpacked_bytes: int, max_ratio: float) -> None:
    require_ratio(what, packed_bytes=packed_bytes, unpacked_bytes=unpacked_bytes, max_ratio=max_ratio)
