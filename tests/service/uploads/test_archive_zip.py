"""Zip archives that lie."""

from __future__ import annotations

import io
import stat
import struct
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from service.storage.uploads.archive import ArchiveLimits
from service.storage.uploads.zip_reader import ZipReader
from tests.service.uploads.test_archive import LIMITS, Unpacker, png, zip_of

NAME = "front/0.png"


@pytest.fixture
def unpacked(tmp_path: Path) -> Unpacker:
    return Unpacker(tmp_path)


@dataclass(kw_only=True)
class Liar:
    """One entry whose local header and directory record say what they are told to."""

    name: bytes = NAME.encode()
    data: bytes = b""
    packed: bytes | None = None
    method: int = 0
    flags: int = 0
    attributes: int = 0
    extra: bytes = b""
    crc: int | None = None
    size_bytes: int | None = None
    packed_bytes: int | None = None
    offset: int | None = None
    disk: int = 0
    local_extra_bytes: int = 0  # declared by the local header, and not there
    local: dict[str, Any] | None = None  # what the local header says otherwise

    def numbers(self) -> tuple[int, int, int]:
        packed = self.data if self.packed is None else self.packed
        return (
            zlib.crc32(self.data) if self.crc is None else self.crc,
            len(packed) if self.packed_bytes is None else self.packed_bytes,
            len(self.data) if self.size_bytes is None else self.size_bytes,
        )

    def local_header(self) -> bytes:
        told = Liar(**(vars(self) | (self.local or {})))
        return (
            struct.pack("<4s5H", b"PK\3\4", 20, told.flags, told.method, 0, 33)
            + struct.pack("<3L2H", *told.numbers(), len(told.name), self.local_extra_bytes)
            + told.name
            + (self.data if self.packed is None else self.packed)
        )

    def record(self, offset: int) -> bytes:
        at = offset if self.offset is None else self.offset
        head = struct.pack("<4s6H", b"PK\1\2", 3 << 8 | 20, 20, self.flags, self.method, 0, 33)
        lengths = struct.pack("<3H", len(self.name), len(self.extra), 0)
        rest = struct.pack("<2H2L", self.disk, 0, self.attributes, at)
        return head + struct.pack("<3L", *self.numbers()) + lengths + rest + self.name + self.extra


def archive_of(*entries: Liar, count: int | None = None, directory_bytes: int | None = None) -> bytes:
    content, directory = b"", b""
    for entry in entries:
        directory += entry.record(len(content))
        content += entry.local_header()
    counted = len(entries) if count is None else count
    size_bytes = len(directory) if directory_bytes is None else directory_bytes
    return content + directory + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, counted, counted, size_bytes, len(content), 0)


def deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


IMAGE = png()


def test_the_liar_can_tell_the_truth(unpacked: Unpacker) -> None:
    assert unpacked(archive_of(Liar(data=IMAGE))) == {NAME: IMAGE}
    assert unpacked(archive_of(Liar(data=IMAGE, packed=deflate(IMAGE), method=8))) == {NAME: IMAGE}


def test_an_archive_with_a_comment(unpacked: Unpacker) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(NAME, IMAGE)
        archive.comment = b"of 3 May"
    assert unpacked(stream.getvalue()) == {NAME: IMAGE}
    two_ends = stream.getvalue()[:-8] + b"PK\x05\x06 May"  # zipfile takes the second
    unpacked.refused(two_ends, "damaged-archive", "directory")


def zip64_end(archive: bytes, **changes: int) -> bytes:
    """The archive with a zip64 end, as archives over 4 GB have."""
    *_, entries, size_bytes, offset, _ = struct.unpack("<4s4H2LH", archive[-22:])
    end_offset = offset + size_bytes
    entries, size_bytes = changes.get("entries", entries), changes.get("size_bytes", size_bytes)
    end = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, entries, entries, size_bytes, offset)
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, changes.get("end_offset", end_offset), changes.get("disks", 1))
    short = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, changes.get("short", 0xFFFF), 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    return archive[:-22] + end + locator + short


def test_zip64(unpacked: Unpacker) -> None:
    archive = archive_of(Liar(data=IMAGE))
    assert unpacked(zip64_end(archive)) == {NAME: IMAGE}
    field = struct.pack("<2H2Q", 1, 16, len(IMAGE), len(IMAGE))
    large = Liar(data=IMAGE, extra=field, size_bytes=0xFFFFFFFF, packed_bytes=0xFFFFFFFF, flags=8)
    large.local = {"size_bytes": 0, "packed_bytes": 0, "crc": 0}
    assert unpacked(zip64_end(archive_of(large))) == {NAME: IMAGE}


@pytest.mark.parametrize(
    ("changes", "code", "word"),
    [
        ({"entries": 1 << 40}, "archive-too-large", f"{1 << 40} entries"),
        ({"entries": 1 << 63, "size_bytes": 1 << 62}, "damaged-archive", "where it says"),
        ({"entries": 2}, "damaged-archive", "holds 1 entries and declares 2"),
        ({"size_bytes": 10}, "damaged-archive", "where it says"),
        ({"end_offset": 1 << 60}, "damaged-archive", "zip64"),
        ({"disks": 3}, "unsupported-archive", "several"),
    ],
)
def test_zip64_ends_that_lie(unpacked: Unpacker, changes: dict[str, int], code: str, word: str) -> None:
    unpacked.refused(zip64_end(archive_of(Liar(data=IMAGE)), **changes), code, word)


def test_more_entries_than_declared(unpacked: Unpacker) -> None:
    entries = [Liar(name=b"front/%d.png" % i, data=IMAGE) for i in range(2)]
    unpacked.refused(archive_of(*entries, count=1), "damaged-archive", "holds 2 entries and declares 1")
    unpacked.refused(
        archive_of(*entries, count=1), "archive-too-large", "over 1 entries, the bound is 1", max_entries=1
    )
    unpacked.refused(archive_of(*entries, count=3), "damaged-archive", "holds 2 entries and declares 3")


def test_a_directory_made_of_comments(unpacked: Unpacker) -> None:
    entries = [Liar(name=b"front/%d.png" % i, extra=struct.pack("<2H", 9, 60_000) + bytes(60_000)) for i in range(50)]
    unpacked.refused(archive_of(*entries), "archive-too-large", "directory has", "bound is 12800", max_entries=50)


@pytest.mark.parametrize(
    ("mode", "word"),
    [
        (stat.S_IFLNK, "symbolic link"),
        (stat.S_IFCHR, "device"),
        (stat.S_IFBLK, "device"),
        (stat.S_IFIFO, "pipe"),
        (stat.S_IFSOCK, "socket"),
    ],
)
def test_what_is_no_file(unpacked: Unpacker, mode: int, word: str) -> None:
    entry = Liar(data=b"/etc/passwd", attributes=(mode | 0o777) << 16)
    unpacked.refused(archive_of(entry), "unsafe-archive", f"'{NAME}'", word)


@pytest.mark.parametrize("flags", [1, 1 << 6, 1 << 13])
def test_encrypted(unpacked: Unpacker, flags: int) -> None:
    unpacked.refused(archive_of(Liar(data=IMAGE, flags=flags)), "unsupported-archive", f"'{NAME}'", "encrypted")


@pytest.mark.parametrize(("method", "word"), [(12, "bzip2"), (14, "LZMA"), (93, "Zstandard"), (99, "AES"), (77, "77")])
def test_methods_that_are_not_supported(unpacked: Unpacker, method: int, word: str) -> None:
    unpacked.refused(archive_of(Liar(data=IMAGE, method=method)), "unsupported-archive", f"'{NAME}'", word)


def test_pythons_own_bzip2_and_lzma(unpacked: Unpacker) -> None:
    unpacked.refused(zip_of([(NAME, IMAGE)], zipfile.ZIP_BZIP2), "unsupported-archive", "bzip2")
    unpacked.refused(zip_of([(NAME, IMAGE)], zipfile.ZIP_LZMA), "unsupported-archive", "LZMA")


@pytest.mark.parametrize(
    ("name", "word"),
    [(b"", "empty"), (b"front/\0.png", "control"), (b"front/\xfc.png", "UTF-8"), (b"\xff" * 2000, "2000 bytes")],
)
def test_names_that_python_cannot_write(unpacked: Unpacker, name: bytes, word: str) -> None:
    for flags in (0, 0x800):
        unpacked.refused(archive_of(Liar(name=name, data=IMAGE, flags=flags)), "unsafe-archive", word)


def test_utf8_without_the_flag_as_macos_writes_it(unpacked: Unpacker) -> None:
    assert unpacked(archive_of(Liar(name="köln/straße.png".encode(), data=IMAGE))) == {"köln/straße.png": IMAGE}


def test_a_second_name_in_unicode_does_not_count(unpacked: Unpacker) -> None:
    second = b"../evil.png"
    value = b"\1" + struct.pack("<L", zlib.crc32(NAME.encode())) + second
    entry = Liar(data=IMAGE, extra=struct.pack("<2H", 0x7075, len(value)) + value)
    assert unpacked(archive_of(entry)) == {NAME: IMAGE}


def test_a_header_with_another_name_than_the_directory(unpacked: Unpacker) -> None:
    for name in (b"../evil.png", b"front/\xfc.png"):
        entry = Liar(data=IMAGE, local={"name": name})
        unpacked.refused(archive_of(entry), "damaged-archive", f"'{NAME}'", "cannot be unpacked")


@pytest.mark.parametrize(
    "local", [{"flags": 0x800}, {"method": 8}, {"size_bytes": 1}, {"packed_bytes": 1 << 31}, {"crc": 1}, {"flags": 1}]
)
def test_only_the_directory_counts(unpacked: Unpacker, local: dict[str, Any]) -> None:
    assert unpacked(archive_of(Liar(data=IMAGE, local=local))) == {NAME: IMAGE}


@pytest.mark.parametrize(("size_bytes", "word"), [(10, "wrong checksum"), (1000, f"holds {len(IMAGE)} of the 1000")])
def test_sizes_that_lie(unpacked: Unpacker, size_bytes: int, word: str) -> None:
    entry = Liar(data=IMAGE, packed=deflate(IMAGE), method=8, size_bytes=size_bytes)
    unpacked.refused(archive_of(entry), "damaged-archive", f"'{NAME}'", word)
    unpacked.refused(archive_of(Liar(data=IMAGE, size_bytes=size_bytes)), "damaged-archive", f"'{NAME}'")


def test_a_bomb_that_declares_little(unpacked: Unpacker) -> None:
    entry = Liar(data=b"", packed=deflate(bytes(40_000_000)), method=8, size_bytes=1000)
    unpacked.refused(archive_of(entry), "damaged-archive", f"'{NAME}'", "wrong checksum")
    entry.crc = zlib.crc32(bytes(1000))  # no more than declared comes out, whatever there is
    unpacked.refused(archive_of(entry), "not-an-image", f"image {NAME} ")


@pytest.mark.parametrize("packed", [deflate(IMAGE)[:-5], b"\xff" * 50, b""])
def test_compressed_data_that_are_damaged(unpacked: Unpacker, packed: bytes) -> None:
    entry = Liar(data=IMAGE, packed=packed, method=8)
    unpacked.refused(archive_of(entry), "damaged-archive", f"'{NAME}'", "cannot be unpacked")


def test_bytes_behind_the_compressed_data_are_not_read(unpacked: Unpacker) -> None:
    assert unpacked(archive_of(Liar(data=IMAGE, packed=deflate(IMAGE) + b"more", method=8))) == {NAME: IMAGE}


def test_a_wrong_checksum(unpacked: Unpacker) -> None:
    unpacked.refused(archive_of(Liar(data=IMAGE, crc=1)), "damaged-archive", f"'{NAME}'", "checksum")


def test_entries_that_share_their_bytes(unpacked: Unpacker) -> None:
    first, second = Liar(data=IMAGE), Liar(name=b"front/1.png", data=IMAGE, offset=0)
    unpacked.refused(archive_of(first, second), "damaged-archive", "overlaps")


def test_entries_inside_one_another(unpacked: Unpacker) -> None:
    """Fifield's bomb: each entry quotes the next one's header and goes on in its content."""
    kernel = deflate(bytes(30_000_000))
    inner = Liar(name=b"front/1.png", data=b"", packed=kernel, method=8, crc=0, size_bytes=30_000_000)
    quoted = inner.local_header()
    quote = struct.pack("<BHH", 0, len(quoted) - len(kernel), 0xFFFF ^ (len(quoted) - len(kernel)))
    outer = Liar(data=b"", packed=quote, method=8, crc=0, size_bytes=30_000_000, packed_bytes=len(quote) + len(quoted))
    unpacked.refused(archive_of(outer, inner), "damaged-archive", "overlaps", max_ratio=1e9)


def test_an_entry_that_reaches_into_the_directory(unpacked: Unpacker) -> None:
    entry = Liar(data=IMAGE, size_bytes=len(IMAGE) + 40, packed_bytes=len(IMAGE) + 40)
    unpacked.refused(archive_of(entry), "damaged-archive", "overlaps")


def test_a_local_header_that_moves_its_content(unpacked: Unpacker) -> None:
    first, second = Liar(data=IMAGE, local_extra_bytes=40), Liar(name=b"front/1.png", data=b"\0" * 4 + IMAGE)
    unpacked.refused(archive_of(first, second), "damaged-archive", f"'{NAME}'")
    padding = struct.pack("<2H", 9, 36) + bytes(36)
    moved = Liar(data=padding + IMAGE, packed_bytes=len(IMAGE), size_bytes=len(IMAGE), local_extra_bytes=40)
    moved.crc = zlib.crc32(IMAGE)
    assert unpacked(archive_of(moved)) == {NAME: IMAGE}
    moved.data = padding + IMAGE[:-1]  # the last byte would come from the directory
    unpacked.refused(archive_of(moved), "damaged-archive", f"'{NAME}'", "checksum")


@pytest.mark.parametrize("field", [struct.pack("<2HL", 1, 4, 5), struct.pack("<2HL", 9, 400, 5)])
def test_extra_fields_that_are_malformed(unpacked: Unpacker, field: bytes) -> None:
    entry = Liar(data=IMAGE, extra=field, size_bytes=0xFFFFFFFF)
    unpacked.refused(archive_of(entry), "damaged-archive", "directory cannot be read")


def test_content_that_waits_in_the_decompressor() -> None:
    """All packed bytes are taken in with the first chunk, and not all content is given out."""
    data = bytes((1 << 18) + 21)
    inflater = zlib.decompressobj(-15)
    inflater.decompress(deflate(data), 1 << 18)
    assert not inflater.unconsumed_tail
    assert not inflater.eof
    stream = io.BytesIO(archive_of(Liar(data=data, packed=deflate(data), method=8)))
    archive = ZipReader(stream, ArchiveLimits(**(LIMITS | {"max_ratio": 1e9})))
    assert b"".join(archive.read(*archive.entries[0])) == data


def test_an_entry_that_does_not_lie_there(unpacked: Unpacker) -> None:
    shifted = Liar(data=IMAGE, size_bytes=10, packed_bytes=10, offset=3)
    unpacked.refused(archive_of(shifted), "damaged-archive", f"'{NAME}'", "cannot be unpacked")
    far = Liar(data=IMAGE, offset=1 << 31)
    unpacked.refused(archive_of(far), "damaged-archive", "overlaps")


def test_an_archive_in_parts(unpacked: Unpacker) -> None:
    archive = archive_of(Liar(data=IMAGE))
    parts = archive[:-18] + struct.pack("<2H", 1, 1) + archive[-14:]
    unpacked.refused(parts, "unsupported-archive", "several")
    unpacked.refused(archive_of(Liar(data=IMAGE, disk=2)), "unsupported-archive", "several")


def test_an_archive_behind_a_program(unpacked: Unpacker) -> None:
    unpacked.refused(b"MZ" + bytes(500) + archive_of(Liar(data=IMAGE)), "not-an-archive", status=415)
    unpacked.refused(b"PK\3\4" + archive_of(Liar(data=IMAGE)), "damaged-archive", "where it says")


@pytest.mark.slow
def test_memory_is_bounded(tmp_path: Path) -> None:
    """Forty thousand entries with long names and an image of 256 MB."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for i in range(40_000):
            archive.writestr(f"front/{'n' * 100}{i}.png", b"")
        with archive.open("back/0.png", "w") as entry:
            entry.write(png())
            for _ in range(256):
                entry.write(bytes(1_000_000))
    script = """
import resource, sys
from pathlib import Path
from service.errors import ServiceError
from service.storage.uploads.archive import ArchiveLimits, unpack

root = Path(sys.argv[1])
limits = ArchiveLimits(max_entries=200_000, max_bytes=10**9, max_ratio=200, max_file_bytes=10**9, min_free_bytes=0)
def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000
def attempt(expected):
    before = peak_mb()
    try:
        unpack(root / "a.zip", expected, folder=root / "spool", limits=limits, same_manifest=lambda raw: False)
    except ServiceError as error:
        print(error.code, peak_mb() - before, len(list((root / "spool").glob("*"))))
attempt(["back/0.png"])
attempt(["back/0.png", *(f"front/{'n' * 100}{i}.png" for i in range(40_000))])
"""
    done = subprocess.run([sys.executable, "-c", script, tmp_path], capture_output=True, text=True, timeout=300)
    first, second = (line.split() for line in done.stdout.splitlines())
    assert (first[0], first[2], second[0], second[2]) == ("unexpected-file", "0", "empty-file", "0"), done.stderr
    assert int(first[1]) + int(second[1]) < 80
