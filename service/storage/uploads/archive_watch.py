"""Reads the names of an archive's entries while its bytes come, so that a wrong one is refused at once.

A zip says in a header before each entry what follows, and so does a tar. What cannot be read here ends the watch and
nothing else: the whole archive is checked once it is there, by its directory and down to every byte.
"""

from __future__ import annotations

import bz2
import lzma
import os
import re
import struct
import tarfile
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, TypeAlias

from schemas.file_names import is_beside_manifest, is_ignored
from service.storage.uploads.archive_limits import SMALL_BYTES, require_ratio
from service.storage.uploads.archive_names import safe_name, unexpected_files, without_top
from service.storage.uploads.decompress import MAX_XZ_MEMORY_BYTES, compression_of
from service.storage.uploads.tar_reader import MAX_HEADER_BYTES, PAX_SIZE, checked_name, not_an_archive
from service.storage.uploads.zip_reader import SIGNATURES

Known = Callable[[Sequence[str]], Collection[str]]  # those of some names that are files of the drive

_START_BYTES = 8
_CHUNK_BYTES = 1 << 18
_LOCAL = struct.Struct("<4s5H3L2H")
_LOCAL_SIGNATURE, _DIRECTORY_SIGNATURES = b"PK\x03\x04", (b"PK\x01\x02", b"PK\x06\x08")
_ENCRYPTED, _SIZES_FOLLOW = 0x0001, 0x0008
_STORED, _DEFLATED = 0, 8
# CRC, packed and unpacked size behind an entry: with or without a signature, and with sizes of 4 or of 8 bytes.
_DESCRIPTORS = {16: "<4xL2L", 24: "<4xL2Q", 12: "<L2L", 20: "<L2Q"}
_LONGEST_DESCRIPTOR = max(_DESCRIPTORS)
_AFTER_ENTRY = re.compile(b"|".join(map(re.escape, (_LOCAL_SIGNATURE, *_DIRECTORY_SIGNATURES))))
_UNKNOWN = 0xFFFFFFFF
_ZIP64_FIELD = 1
_PAX_RECORD = re.compile(rb"([0-9]{1,9}) ([^=]{1,200})=")
_EXTENDED = {tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.XGLTYPE}
_LONG = {tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK}


@dataclass(frozen=True)
class _Read:
    size_bytes: int


@dataclass(frozen=True)
class _ReadSome:
    """Read at least one byte, and at most so many."""

    size_bytes: int


@dataclass(frozen=True)
class _Pass:
    """Pass over bytes; fewer than none: go back over what was just read."""

    size_bytes: int


@dataclass(frozen=True)
class _Entry:
    name: str
    is_folder: bool


_Step: TypeAlias = _Read | _ReadSome | _Pass | _Entry
_Steps: TypeAlias = Generator[_Step, bytes, None]


class ArchiveWatch:
    """Names of an archive that is being received.

    Parameters
    ----------
    known
        Selects the paths that the drive's manifest names.
    files_expected
        How many it names.
    max_ratio
        Unpacked to packed bytes: what is compressed more is not unpacked to look for names.
    """

    def __init__(self, known: Known, files_expected: int, *, max_ratio: float) -> None:
        self._known = known
        self._files_expected = files_expected
        self._max_ratio = max_ratio
        self._source: _Source | None = None
        self._steps: _Steps | None = None
        self._step: _Step | None = None
        self._is_over = False

    def look(self, path: Path) -> None:
        """Read the names that have come since the last look.

        Parameters
        ----------
        path
            The file that the archive is being written to; it may have grown, not changed.

        Raises
        ------
        ServiceError
            415 `not-an-archive`; 422 `unsafe-archive`, `archive-too-large` or `unexpected-file`, which name the entry.
        """
        if self._is_over:
            return
        with open(path, "rb") as stream:
            available = os.fstat(stream.fileno()).st_size
            if available < _START_BYTES:
                return
            names = []
            for entry in self._entries(stream, available):
                if not entry.is_folder and not is_ignored(entry.name):
                    names.append(entry.name)
        self._require_known(names)

    def _require_known(self, names: Sequence[str]) -> None:
        asked = {option for name in names for option in (name, without_top(name)) if option}
        known = self._known(sorted(asked)) if asked else ()
        strange = [
            name
            for name in names
            if not any(path in known or is_beside_manifest(path) for path in (name, without_top(name)))
        ]
        if strange:
            raise unexpected_files(strange, self._files_expected, is_whole=False)

    def _entries(self, stream: BinaryIO, available: int) -> Iterator[_Entry]:
        if self._source is None:
            self._begin(stream.read(_START_BYTES))
        assert self._source is not None
        self._source.stream, self._source.available = stream, available
        try:
            while not self._is_over:
                answer = self._fulfil(self._step)
                if answer is None:
                    return
                if isinstance(self._step, _Entry):
                    yield self._step
                self._advance(answer)
        except (zlib.error, lzma.LZMAError, OSError, EOFError):
            self._is_over = True  # damaged: said once all of it is there

    def _begin(self, start: bytes) -> None:
        if start.startswith(SIGNATURES):
            self._source, self._steps = _Plain(), _zip_steps(self._max_ratio)
        else:
            compression = compression_of(start)
            self._source = _Plain() if compression is None else _Packed(compression, self._max_ratio)
            self._steps = _tar_steps()
        self._step = next(self._steps)

    def _advance(self, answer: bytes) -> None:
        assert self._steps is not None
        try:
            self._step = self._steps.send(answer)
        except StopIteration:
            self._is_over = True

    def _fulfil(self, step: _Step | None) -> bytes | None:
        """Bytes that a step asks for; None where they have not come yet."""
        assert self._source is not None
        match step:
            case _Read(size_bytes):
                return self._source.read(size_bytes)
            case _ReadSome(size_bytes):
                return self._source.read_some(size_bytes)
            case _Pass(size_bytes):
                left = self._source.skip(size_bytes)
                self._step = _Pass(left)
                return None if left > 0 else b""
        return b""


class _Source(Protocol):
    stream: BinaryIO
    available: int

    def read(self, size_bytes: int) -> bytes | None: ...
    def read_some(self, size_bytes: int) -> bytes | None: ...
    def skip(self, size_bytes: int) -> int: ...


class _Plain:
    """A file as it is; contents are passed over without being read."""

    stream: BinaryIO
    available: int

    def __init__(self) -> None:
        self._at = 0

    def read(self, size_bytes: int) -> bytes | None:
        return self.read_some(size_bytes) if self._at + size_bytes <= self.available else None

    def read_some(self, size_bytes: int) -> bytes | None:
        if self._at >= self.available:
            return None
        self.stream.seek(self._at)
        data = self.stream.read(min(size_bytes, self.available - self._at))
        self._at += len(data)
        return data

    def skip(self, size_bytes: int) -> int:
        self._at += size_bytes
        return 0


class _Packed:
    """A compressed file, unpacked in pieces of bounded size."""

    stream: BinaryIO
    available: int

    def __init__(self, compression: str, max_ratio: float) -> None:
        self._decompressor = _decompressor(compression)
        self._max_ratio = max_ratio
        self._at = self._unpacked_bytes = 0
        self._rest = b""  # packed, not taken by the decompressor yet
        self._content = bytearray()

    def read(self, size_bytes: int) -> bytes | None:
        while len(self._content) < size_bytes:
            if not self._more():
                return None
        data = bytes(self._content[:size_bytes])
        del self._content[:size_bytes]
        return data

    def read_some(self, size_bytes: int) -> bytes | None:
        return self.read(min(size_bytes, max(1, len(self._content))))

    def skip(self, size_bytes: int) -> int:
        while size_bytes > 0 and (self._content or self._more()):
            taken = min(size_bytes, len(self._content))
            del self._content[:taken]
            size_bytes -= taken
        return size_bytes

    def _more(self) -> bool:
        """Unpack some more; whether that was possible."""
        packed = self._rest
        if not packed:
            self.stream.seek(self._at)
            packed = self.stream.read(min(_CHUNK_BYTES, self.available - self._at))
            self._at += len(packed)
        if not packed:
            return False
        content, self._rest = self._decompressor(packed)
        self._content += content
        self._unpacked_bytes += len(content)
        require_ratio(
            "the archive",
            packed_bytes=self._at,
            unpacked_bytes=self._unpacked_bytes,
            max_ratio=self._max_ratio,
        )
        return True


def _decompressor(compression: str) -> Callable[[bytes], tuple[bytes, bytes]]:
    """A function from packed bytes to some content and the packed bytes that are left.

    At the end of a piece it raises EOFError: pieces that are joined are left to the check of the whole.
    """
    if compression == "gzip":
        inflater = zlib.decompressobj(31)

        def gunzip(packed: bytes) -> tuple[bytes, bytes]:
            if inflater.eof:
                raise EOFError
            return inflater.decompress(packed, _CHUNK_BYTES), inflater.unconsumed_tail

        return gunzip
    lazy: bz2.BZ2Decompressor | lzma.LZMADecompressor = (
        bz2.BZ2Decompressor()
        if compression == "bzip2"
        else lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=MAX_XZ_MEMORY_BYTES)
    )

    def unpack(packed: bytes) -> tuple[bytes, bytes]:
        # These keep what they were given; what they keep has to be asked for with nothing new.
        content = lazy.decompress(packed, _CHUNK_BYTES)
        while not lazy.eof and not lazy.needs_input and len(content) < 8 * _CHUNK_BYTES:
            content += lazy.decompress(b"", _CHUNK_BYTES)
        if not lazy.eof and not lazy.needs_input:
            raise EOFError  # unpacks to far more than images do
        return content, b""

    return unpack


def _tar_steps() -> _Steps:
    """Headers of a tar: ustar, pax and GNU's long names."""
    name: str | None = None
    pax: dict[str, str] = {}
    is_first = True
    while True:
        block = yield _Read(tarfile.BLOCKSIZE)
        if block == bytes(tarfile.BLOCKSIZE):
            return
        try:
            member = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except tarfile.HeaderError:
            if is_first:
                raise not_an_archive() from None
            return
        is_first = False
        if member.type in _EXTENDED | _LONG:
            if not 0 <= member.size <= MAX_HEADER_BYTES:
                return
            data = (yield _Read(_padded(member.size)))[: member.size]
            if member.type == tarfile.GNUTYPE_LONGNAME:
                name = data.partition(b"\0")[0].decode("utf-8", "surrogateescape")
            elif member.type in (tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE):
                pax = _pax_records(data)
            continue
        member.name = pax.get("path", name if name is not None else member.name)
        # Another size is none: `checked_name` refuses the entry for it.
        size_bytes = int(pax["size"]) if PAX_SIZE.fullmatch(pax.get("size", "")) else member.size
        member.pax_headers = pax
        if size_bytes < 0:
            return
        member.size = size_bytes
        yield _Entry(checked_name(member), member.isdir())
        yield _Pass(_padded(size_bytes))
        name, pax = None, {}


def _padded(size_bytes: int) -> int:
    return -(-size_bytes // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


def _pax_records(data: bytes) -> dict[str, str]:
    """Records `LENGTH KEY=VALUE` of an extended header."""
    found, at = {}, 0
    while (match := _PAX_RECORD.match(data, at)) is not None:
        end = at + int(match[1])
        if end <= match.end() or end > len(data):
            break
        key = match[2].decode("utf-8", "surrogateescape")
        found[key] = data[match.end() : end - 1].decode("utf-8", "surrogateescape")
        at = end
    return found


def _zip_steps(max_ratio: float) -> _Steps:
    """Local headers of a zip; the directory follows its last entry."""
    while True:
        fixed = yield _Read(_LOCAL.size)
        if not fixed.startswith(_LOCAL_SIGNATURE):
            return
        _, _, flags, method, _, _, _, packed_bytes, unpacked_bytes, name_bytes, extra_bytes = _LOCAL.unpack(fixed)
        raw_name = yield _Read(name_bytes)
        extra = yield _Read(extra_bytes)
        is_folder = raw_name.endswith(b"/")
        if _UNKNOWN in (packed_bytes, unpacked_bytes):
            sizes = _zip64_sizes(extra)
            if sizes is None:
                return
            unpacked_bytes, packed_bytes = sizes
        yield _Entry(safe_name(raw_name, is_folder=is_folder), is_folder)
        if flags & _ENCRYPTED:
            return
        if not flags & _SIZES_FOLLOW:
            yield _Pass(packed_bytes)
            continue
        if method == _DEFLATED and not packed_bytes:
            yield from _inflated(raw_name, max_ratio)
        elif packed_bytes or raw_name.endswith(b"/"):
            yield _Pass(packed_bytes)
        elif method == _STORED:
            yield from _stored()
            continue
        else:
            return  # another method, and nothing says where it ends
        ahead = yield _Read(_LONGEST_DESCRIPTOR + len(_LOCAL_SIGNATURE))
        found = next((n for n in _DESCRIPTORS if _AFTER_ENTRY.match(ahead, n)), None)
        if found is None:
            return
        yield _Pass(found - len(ahead))


def _stored() -> _Steps:
    """Pass over content that is stored as it is, whose length only the descriptor behind it says, and over that.

    The descriptor is where its size is the distance from the content's begin and another entry, or the directory,
    follows. Content that looks so itself leads to a refusal, or to names that only the check of the whole finds.
    """
    data, passed_bytes = b"", 0
    while True:
        data += yield _ReadSome(_CHUNK_BYTES)
        for following in _AFTER_ENTRY.finditer(data):
            if any(_describes(data, following.start() - size, passed_bytes, size) for size in _DESCRIPTORS):
                yield _Pass(following.start() - len(data))
                return
        kept = data[-(_LONGEST_DESCRIPTOR + len(_LOCAL_SIGNATURE)) :]
        passed_bytes += len(data) - len(kept)
        data = kept


def _describes(data: bytes, at: int, passed_bytes: int, size_bytes: int) -> bool:
    """Return whether a descriptor of this size lies at a place, for content of as many bytes as there are before it."""
    if at < 0:
        return False
    _, packed_bytes, unpacked_bytes = struct.unpack_from(_DESCRIPTORS[size_bytes], data, at)
    return bool(packed_bytes == unpacked_bytes == passed_bytes + at)


def _inflated(raw_name: bytes, max_ratio: float) -> _Steps:
    """Pass over deflated content whose length only its own end says."""
    inflater = zlib.decompressobj(-15)
    packed_bytes = unpacked_bytes = 0
    while not inflater.eof:
        data = inflater.unconsumed_tail
        if not data:
            data = yield _ReadSome(SMALL_BYTES)
            packed_bytes += len(data)
        unpacked_bytes += len(inflater.decompress(data, _CHUNK_BYTES))
        require_ratio(
            f"entry {raw_name.decode('utf-8', 'backslashreplace')[:120]!r} of the archive",
            packed_bytes=packed_bytes,
            unpacked_bytes=unpacked_bytes,
            max_ratio=max_ratio,
        )
    yield _Pass(-len(inflater.unused_data))


def _zip64_sizes(extra: bytes) -> tuple[int, int] | None:
    """Unpacked and packed bytes of an entry of over 4 GB."""
    at = 0
    while at + 4 <= len(extra):
        field, size_bytes = struct.unpack_from("<2H", extra, at)
        if field == _ZIP64_FIELD and size_bytes >= 16 and at + 20 <= len(extra):
            unpacked_bytes, packed_bytes = struct.unpack_from("<2Q", extra, at + 4)
            return int(unpacked_bytes), int(packed_bytes)
        at += 4 + size_bytes
    return None


class KeptWatches:
    """Watches of archives that come in several requests, so that each goes on where the last one ended.

    One that is not here any more is made anew and reads again what has come.
    """

    def __init__(self, most: int = 64) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, ArchiveWatch] = OrderedDict()

    def take(self, upload_id: str) -> ArchiveWatch | None:
        """Take an upload's watch; nobody else has it until it is put back."""
        with self._lock:
            return self._kept.pop(upload_id, None)

    def put(self, upload_id: str, watch: ArchiveWatch) -> None:
        """Keep a watch whose upload goes on."""
        with self._lock:
            self._kept[upload_id] = watch
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
