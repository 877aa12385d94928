"""Tar archives from outside (pax, ustar, GNU's long names), read in one pass with the standard library's tarfile.

Tarfile reads headers of any length into memory, with a pax parser (before Python 3.11.10) whose time and memory grow
with the square of it, and takes a damaged header for the end: so its stream gives it only so much, and is looked at.
"""

from __future__ import annotations

import io
import lzma
import re
import tarfile
from collections.abc import Iterator
from functools import partial
from typing import Any, BinaryIO, cast

from service.errors import ArchiveTooLarge, NotAnArchive, ServiceError, UnsafeArchive, UnsupportedArchive
from service.storage.uploads.archive_errors import damaged, shown
from service.storage.uploads.archive_limits import SMALL_BYTES, ArchiveLimits, Budget, require_ratio
from service.storage.uploads.archive_names import safe_name
from service.storage.uploads.decompress import ERRORS, MAX_XZ_MEMORY_BYTES, Packed, unpacked

_CHUNK_BYTES = 1 << 18
_READ_AHEAD_BYTES = 1 << 16
MAX_HEADER_BYTES = 8 << 10  # of one entry: names, times and extended attributes
_PADDING_BYTES = 1 << 20  # of the archive's end, at most

_FILES = frozenset({tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.CONTTYPE})
_REFUSED = {
    tarfile.LNKTYPE: "a hard link",
    tarfile.SYMTYPE: "a symbolic link",
    tarfile.CHRTYPE: "a device",
    tarfile.BLKTYPE: "a device",
    tarfile.FIFOTYPE: "a pipe",
    tarfile.GNUTYPE_SPARSE: "a sparse file",
    b"M": "the rest of a file of another archive",
    b"D": "a list of files of an incremental backup",
}
_SPARSE_KEY = "GNU.sparse."
PAX_SIZE = re.compile("[0-9]{1,19}")  # digits as int() takes them, and no number that takes long to read


def read_tar(
    stream: BinaryIO, compression: str | None, limits: ArchiveLimits
) -> Iterator[tuple[str, int, Iterator[bytes]]]:
    """Name, size and content of all files of the archive in their order; folders are left out.

    A content that is not read before the next file is asked for is skipped.

    Raises
    ------
    ServiceError
        415 `not-an-archive` if there is no tar archive inside, 422 that names the entry if it is damaged, over a limit
        or holds what is refused.
    """
    _require_tar(_Stream(stream, compression, limits))
    stream.seek(0)
    blocks = _Stream(stream, compression, limits)
    budget = Budget(limits)
    for archive, member in _members(blocks):
        name = checked_name(member)
        budget.entry(name, member.size)
        blocks.begin(f"entry {shown(name)}", member.size)
        if not member.isdir():
            content = cast(BinaryIO, archive.extractfile(member))
            yield name, member.size, iter(partial(content.read, _CHUNK_BYTES), b"")
    while rest := blocks.take(_CHUNK_BYTES):
        if rest.strip(b"\0"):
            raise damaged("other bytes follow its end mark")


class _Stream(io.BufferedIOBase):
    """Input of tarfile: forwards, whole or not at all, and of an entry's headers only so much.

    The total size and the compression ratio, of the archive and of each entry, are watched.
    """

    def __init__(self, stream: BinaryIO, compression: str | None, limits: ArchiveLimits) -> None:
        self._packed = Packed(stream)
        self._content = unpacked(self._packed, compression)
        self._compression = compression
        self._max_ratio = limits.max_ratio
        self._max_bytes = limits.max_bytes + limits.max_entries * MAX_HEADER_BYTES + _PADDING_BYTES
        self._left_bytes = MAX_HEADER_BYTES
        self._entry_start = (0, 0)
        self.where = "its beginning"
        self.latest = b""

    def begin(self, where: str, content_bytes: int) -> None:
        """An entry's content begins; `where` names it in messages."""
        self.where = where
        self._left_bytes = content_bytes
        self._entry_start = (self._packed.packed_bytes, self._packed.unpacked_bytes)

    def allow_headers(self) -> None:
        """The next entry's headers may be read."""
        self._left_bytes = MAX_HEADER_BYTES

    def tell(self) -> int:
        return self._packed.unpacked_bytes

    def read(self, size: int | None = -1) -> bytes:
        if size is None or size < 0:
            raise damaged(f"a header behind {self.where} declares a negative size")
        self._left_bytes -= size
        if self._left_bytes < 0:
            raise ArchiveTooLarge(
                f"the archive has headers of over {MAX_HEADER_BYTES} bytes for one entry, behind {self.where}",
                remedy="Make the archive without extended attributes (tar --no-xattrs).",
            )
        self.latest = self._whole(size)
        return self.latest

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence != io.SEEK_SET or offset < self.tell():
            raise damaged(f"a header behind {self.where} points back")
        while self.tell() < offset:
            self._whole(min(offset - self.tell(), _CHUNK_BYTES))
        return offset

    def take(self, size_bytes: int) -> bytes:
        """The next bytes; fewer only at the end."""
        try:
            data = self._content.read(size_bytes)
        except ERRORS as error:
            raise self._refusal(error) from None
        self._packed.unpacked_bytes += len(data)
        if self._packed.unpacked_bytes > self._max_bytes:
            raise ArchiveTooLarge(
                f"the archive unpacks to over {self._max_bytes} bytes", remedy="Send the drive in several archives."
            )
        self._check_ratio("the archive", self._packed.packed_bytes, self._packed.unpacked_bytes)
        # What was read ahead of the entry may belong to it.
        packed_bytes = self._packed.packed_bytes - self._entry_start[0] + _READ_AHEAD_BYTES
        unpacked_bytes = self._packed.unpacked_bytes - self._entry_start[1] - SMALL_BYTES
        self._check_ratio(f"{self.where} of the archive", packed_bytes, unpacked_bytes)
        return data

    def _whole(self, size_bytes: int) -> bytes:
        data = self.take(size_bytes)
        if len(data) < size_bytes:
            raise damaged(f"it ends in or behind {self.where} without its end mark, so it is truncated")
        return data

    def _check_ratio(self, what: str, packed_bytes: int, unpacked_bytes: int) -> None:
        require_ratio(what, packed_bytes=packed_bytes, unpacked_bytes=unpacked_bytes, max_ratio=self._max_ratio)

    def _refusal(self, error: Exception) -> ServiceError:
        if isinstance(error, lzma.LZMAError) and "emory" in str(error):
            return UnsupportedArchive(
                f"the archive needs over {MAX_XZ_MEMORY_BYTES // 1_000_000} MB of memory to be unpacked",
                remedy="Compress it with xz -9 at most, or with gzip.",
            )
        return damaged(f"its {self._compression} data are damaged or truncated, or other bytes follow them")


def _require_tar(stream: _Stream) -> None:
    """Refuse what begins neither with a header nor with the end mark of an empty archive."""
    block = stream.take(tarfile.BLOCKSIZE)
    try:
        if block != bytes(tarfile.BLOCKSIZE):
            tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
    except tarfile.HeaderError:
        raise not_an_archive() from None


def not_an_archive() -> ServiceError:
    """The file is none of the kinds of archive that are taken."""
    return NotAnArchive(
        "the file is neither a zip nor a tar archive",
        remedy="Send a zip, or a tar that is plain or compressed with gzip, bzip2 or xz.",
    )


def _members(blocks: _Stream) -> Iterator[tuple[tarfile.TarFile, tarfile.TarInfo]]:
    """The archive at each of its entries."""
    try:
        archive = tarfile.TarFile(fileobj=cast(Any, blocks), encoding="utf-8", errors="surrogateescape")
        while (member := archive.next()) is not None:
            _forget(archive)
            yield archive, member
            blocks.allow_headers()
    except (tarfile.TarError, ValueError, LookupError, ArithmeticError):
        raise damaged(f"a header behind {blocks.where} is malformed, or its entry is missing") from None
    if blocks.latest.strip(b"\0"):
        name = blocks.latest[:100].partition(b"\0")[0]
        raise damaged(f"the header {shown(name)} behind {blocks.where} has a wrong checksum or number")


def _forget(archive: Any) -> None:
    """Drop the entry and the comments for all entries, as git's, that the archive keeps in memory."""
    for key in archive.pax_headers:
        if key in ("path", "size", "linkpath") or key.startswith(_SPARSE_KEY):
            raise UnsupportedArchive(
                f"the archive gives all its entries the same {key!r}",
                remedy="Make the archive again with another tool.",
            )
    archive.pax_headers.clear()
    archive.members.clear()


def checked_name(member: tarfile.TarInfo) -> str:
    """An entry's safe name.

    Raises
    ------
    ServiceError
        422, if the entry is a link or another thing that is no file, or its name or size is refused.
    """
    raw_name = member.name.encode("utf-8", "surrogateescape")
    kind = _REFUSED.get(member.type)
    if any(key.startswith(_SPARSE_KEY) for key in member.pax_headers):
        kind = _REFUSED[tarfile.GNUTYPE_SPARSE]
    elif kind is None and member.type not in _FILES and not member.isdir():
        kind = f"of the unknown type {shown(member.type)}"
    if kind is not None:
        raise UnsafeArchive(
            f"entry {shown(raw_name)} of the archive is {kind}", remedy="Put the file itself into the archive."
        )
    name = safe_name(raw_name, is_folder=member.isdir())
    # Tarfile takes a pax size that is not a number for 0.
    if member.size < 0 or not PAX_SIZE.fullmatch(member.pax_headers.get("size", "0")):
        raise damaged(f"entry {shown(name)} declares a size that is negative or not a number")
    if member.isdir() and member.size:
        raise damaged(f"folder {shown(name)} has content")
    return name
