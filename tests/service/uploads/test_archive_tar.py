"""Tar archives that lie."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import random
import struct
import tarfile
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.service.uploads.test_archive import Unpacker, png, tar_of

NAME = "front/0.png"
IMAGE = png()
END = bytes(1024)


@pytest.fixture
def unpacked(tmp_path: Path) -> Unpacker:
    return Unpacker(tmp_path)


def header(
    name: bytes = NAME.encode(), *, kind: bytes = b"0", size: bytes | int = 0, magic: bytes = b"ustar\x0000"
) -> bytes:
    """A header with the right checksum, whatever it says."""
    field = b"%011o\0" % size if isinstance(size, int) else size
    block = name.ljust(100, b"\0") + b"0000644\0" * 3 + field + b"00000000000\0" + b" " * 8 + kind + bytes(100) + magic
    block = block.ljust(512, b"\0")
    return block[:148] + b"%06o\0 " % sum(block) + block[156:]


def padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 512)


def member(name: bytes = NAME.encode(), data: bytes = IMAGE, kind: bytes = b"0") -> bytes:
    return header(name, kind=kind, size=len(data)) + padded(data)


def pax(**records: str) -> bytes:
    data = b""
    for key, value in records.items():
        record = f" {key.replace('__', '.')}={value}\n".encode()
        length = len(record)
        while length != len(record) + len(str(length)):
            length = len(record) + len(str(length))
        data += str(length).encode() + record
    return data


def test_the_helpers_can_tell_the_truth(unpacked: Unpacker) -> None:
    assert unpacked(member() + END) == {NAME: IMAGE}
    assert unpacked(member(kind=b"\0") + END) == {NAME: IMAGE}  # as tar wrote before POSIX
    named = member(b"PaxHeader", pax(path="back/0.png", mtime="1.5"), b"x") + member()
    assert unpacked(named + END) == {"back/0.png": IMAGE}
    commented = member(b"pax_global_header", pax(comment="0" * 40), b"g") + member()
    assert unpacked(commented + END) == {NAME: IMAGE}


def test_binary_sizes(unpacked: Unpacker) -> None:
    size = b"\x80" + len(IMAGE).to_bytes(11, "big")
    assert unpacked(header(size=size) + padded(IMAGE) + END) == {NAME: IMAGE}


def test_checksums_as_old_systems_counted(unpacked: Unpacker) -> None:
    block = header("köln/straße.png".encode(), size=len(IMAGE))
    summed = block[:148] + b" " * 8 + block[156:]
    signed = sum(struct.unpack("512b", summed))
    assert signed != sum(summed)
    archive = block[:148] + b"%06o\0 " % signed + block[156:] + padded(IMAGE) + END
    assert unpacked(archive) == {"köln/straße.png": IMAGE}


def test_long_names_as_posix_splits_them(unpacked: Unpacker) -> None:
    magic = b"ustar\x0000".ljust(88, b"\0") + b"front"
    assert unpacked(header(b"0.png", size=len(IMAGE), magic=magic) + padded(IMAGE) + END) == {NAME: IMAGE}


def test_padding_without_end(unpacked: Unpacker) -> None:
    archive = member() + bytes(2_000_000)
    unpacked.refused(archive, "archive-too-large", "unpacks to over", max_entries=1, max_bytes=1000)


@pytest.mark.parametrize("behind", [0, 1, 2, 3, 6])
def test_a_piece_that_begins_at_the_end_of_a_read(unpacked: Unpacker, behind: int) -> None:
    tar = tar_of([(NAME, png(filler=200_000))])
    cut = next(n for n in range(65_000, 65_536) if len(gzip.compress(tar[:n], 0)) == 65_536 - behind)
    assert list(unpacked(gzip.compress(tar[:cut], 0) + gzip.compress(tar[cut:]))) == [NAME]


def test_large_blocks_at_the_end(unpacked: Unpacker) -> None:
    assert unpacked(member() + bytes(1 << 19)) == {NAME: IMAGE}


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        (b"1", "hard link"),
        (b"2", "symbolic link"),
        (b"3", "device"),
        (b"4", "device"),
        (b"6", "pipe"),
        (b"S", "sparse"),
        (b"M", "another archive"),
        (b"D", "incremental"),
        (b"Z", "unknown type 'Z'"),
    ],
)
def test_what_is_no_file(unpacked: Unpacker, kind: bytes, word: str) -> None:
    unpacked.refused(header(kind=kind) + END, "unsafe-archive", f"'{NAME}'", word)


@pytest.mark.parametrize("link", [tarfile.SYMTYPE, tarfile.LNKTYPE])
def test_links_to_places_outside_as_tar_writes_them(unpacked: Unpacker, link: bytes) -> None:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        entry = tarfile.TarInfo(NAME)
        entry.type, entry.linkname = link, "/etc/" + "x" * 200
        archive.addfile(entry)
    unpacked.refused(stream.getvalue(), "unsafe-archive", f"'{NAME}'", "link")


@pytest.mark.parametrize("key", ["major", "realsize", "size", "name"])
def test_sparse_members_in_pax(unpacked: Unpacker, key: str) -> None:
    sparse = pax(path=NAME, **{f"GNU__sparse__{key}": "1000000000000"})
    unpacked.refused(member(b"PaxHeader", sparse, b"x") + member() + END, "unsafe-archive", "'", "sparse")


def test_a_map_of_a_sparse_member_that_fills_the_memory(unpacked: Unpacker) -> None:
    sparse = pax(GNU__sparse__major="1", GNU__sparse__minor="0")
    pieces = b"1000000000\n" + b"1\n" * 5_000_000
    archive = member() + member(b"PaxHeader", sparse, b"x") + member(b"front/1.png", pieces) + END
    unpacked.refused(archive, "archive-too-large", f"behind entry '{NAME}'", "headers of over 8192 bytes")


@pytest.mark.parametrize(
    ("size", "code", "word"),
    [
        (b"\xff" * 12, "damaged-archive", "negative"),
        (b"-0000000001\0", "damaged-archive", "not a number"),
        (b"0x00000000f\0", "damaged-archive", "wrong checksum or number"),
        (b"0000000000\xb2\0", "damaged-archive", "wrong checksum or number"),
        (b"77777777777\0", "archive-too-large", "bound of one file"),
        (b"\x80" + b"\xff" * 11, "archive-too-large", "bound of one file"),
    ],
)
def test_sizes_that_lie(unpacked: Unpacker, size: bytes, code: str, word: str) -> None:
    archive = member(b"front/1.png") + header(size=size) + padded(IMAGE) + END
    unpacked.refused(archive, code, f"'{NAME}'", word)


@pytest.mark.parametrize(
    ("size", "code", "word"),
    [
        ("-1", "damaged-archive", "not a number"),
        ("1e3", "damaged-archive", "not a number"),
        ("٣", "damaged-archive", "not a number"),
        ("²", "damaged-archive", "not a number"),
        ("9" * 30, "damaged-archive", "not a number"),
        ("9" * 4500, "damaged-archive", "not a number"),
        ("9" * 19, "archive-too-large", "bound of one file"),
    ],
)
def test_sizes_in_pax_that_lie(unpacked: Unpacker, size: str, code: str, word: str) -> None:
    unpacked.refused(member(b"PaxHeader", pax(size=size), b"x") + member() + END, code, word)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"5 a\n", ""),
        (b"9 a=b\n", ""),
        (b"0 a=b\n", "front/1.png"),
        (b"99999999999999999999 a=b\n", "damaged"),  # Pythons differ in how they say it
        (b"-6 a=b\n", ""),
        (b"6 a=b", ""),
        (b"2 \n", ""),
    ],
)
def test_pax_headers_that_are_malformed(unpacked: Unpacker, data: bytes, word: str) -> None:
    """Tarfile refuses them, or takes no notice of what it cannot read; nothing that they say escapes the checks."""
    for kind in (b"x", b"g"):
        archive = member(b"front/1.png") + member(b"PaxHeader", data, kind) + member() + END
        if word:
            unpacked.refused(archive, "damaged-archive", word)
        else:
            assert unpacked.outcome(archive) in ((200, {NAME: IMAGE, "front/1.png": IMAGE}), (422, {}))
        hidden = member(b"PaxHeader", data + pax(path="../evil.png"), kind) + member() + END
        assert unpacked.outcome(hidden) in ((200, {NAME: IMAGE}), (422, {}))


@pytest.mark.parametrize("kind", [b"x", b"g", b"L", b"K"])
def test_headers_of_gigabytes(unpacked: Unpacker, kind: bytes) -> None:
    start = header(b"././@LongLink", kind=kind, size=4 << 30)
    archive = member() + start + bytes(20_000)
    unpacked.refused(archive, "archive-too-large", f"'{NAME}'", "headers of over 8192 bytes")


@pytest.mark.parametrize("kind", [b"x", b"g", b"L", b"K"])
def test_headers_as_long_as_they_may_be(unpacked: Unpacker, kind: bytes) -> None:
    fits = {b"x": pax(comment="c" * 6000), b"g": pax(comment="c" * 6000)}.get(kind, NAME.encode() + bytes(6000))
    assert unpacked(member(b"Header", fits, kind) + member() + END) == {NAME: IMAGE}
    unpacked.refused(member() + member(b"Header", bytes(8192), kind) + END, "archive-too-large", "headers of over 8192")


def test_a_header_of_a_negative_size(unpacked: Unpacker) -> None:
    size = b"\xff" * 10 + b"\x00\x00"
    archive = member() + header(b"PaxHeader", kind=b"x", size=size) + member(b"front/1.png") + END
    unpacked.refused(archive, "damaged-archive", f"behind entry '{NAME}'", "negative")


def test_comments_for_all_entries_are_not_kept(unpacked: Unpacker) -> None:
    """Each is small, and all together are not."""
    pieces = []
    for i in range(3000):
        pieces += [member(b"g", pax(**{f"comment{i}": "c" * 6000}), b"g"), member(b"front/%d/.DS_Store" % i)]
    archive = b"".join(pieces) + member() + END
    tracemalloc.start()
    try:
        found = unpacked(archive, max_entries=5000)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found == {NAME: IMAGE}
    assert peak_bytes < 5_000_000


def test_headers_without_end(unpacked: Unpacker) -> None:
    chain = member(b"PaxHeader", pax(mtime="1"), b"x") * 100
    unpacked.refused(member() + chain + END, "archive-too-large", f"behind entry '{NAME}'", "headers of over")


def test_a_name_without_an_entry(unpacked: Unpacker) -> None:
    named = member(b"PaxHeader", pax(path=NAME), b"x")
    unpacked.refused(member(b"front/1.png") + named + END, "damaged-archive", "front/1.png", "its entry is missing")


@pytest.mark.parametrize("key", ["path", "size", "linkpath", "GNU__sparse__name"])
def test_one_name_for_all(unpacked: Unpacker, key: str) -> None:
    archive = member(b"pax_global_header", pax(**{key: "1"}), b"g") + member() + END
    unpacked.refused(archive, "unsupported-archive", key.replace("__", "."))


@pytest.mark.parametrize(
    ("name", "word"), [("../../0.png", "'..'"), ("/etc/passwd", "absolute"), ("a\0.png", "control"), ("", "empty")]
)
def test_names_in_extended_headers(unpacked: Unpacker, name: str, word: str) -> None:
    unpacked.refused(member(b"PaxHeader", pax(path=name), b"x") + member() + END, "unsafe-archive", word)
    if "\0" not in name:
        long_name = member(b"././@LongLink", name.encode() + b"\0", b"L")
        unpacked.refused(long_name + member() + END, "unsafe-archive", word)


def test_names_that_are_not_utf8(unpacked: Unpacker) -> None:
    unpacked.refused(member(b"front/\xfc.png") + END, "unsafe-archive", "UTF-8", "xfc")
    unpacked.refused(member(b"") + END, "unsafe-archive", "empty name")


def test_a_damaged_header(unpacked: Unpacker) -> None:
    second = bytearray(member(b"front/1.png"))
    second[3] ^= 1
    unpacked.refused(member() + bytes(second) + END, "damaged-archive", "checksum")


def test_archives_that_end_too_early(unpacked: Unpacker) -> None:
    unpacked.refused(member(), "damaged-archive", "end mark")
    unpacked.refused(member()[:600], "damaged-archive", f"'{NAME}'", "truncated")
    unpacked.refused(member()[:1000], "damaged-archive", f"'{NAME}'", "truncated")
    inside = member() + header(kind=b"x", size=1000) + bytes(512)
    unpacked.refused(inside, "damaged-archive", f"behind entry '{NAME}'", "truncated")


def test_files_behind_the_end_mark(unpacked: Unpacker) -> None:
    unpacked.refused(member() + END + member(b"front/1.png") + END, "damaged-archive", "follow its end mark")


def test_a_folder_with_content(unpacked: Unpacker) -> None:
    unpacked.refused(member(b"front/", kind=b"5") + END, "damaged-archive", "folder")


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress, lzma.compress])
def test_compressed_data_that_are_damaged(unpacked: Unpacker, compress: Callable[[bytes], bytes]) -> None:
    image = IMAGE + random.Random(3).randbytes(200_000)
    data = bytearray(compress(tar_of([(NAME, image)])))
    data[-30] ^= 0xFF  # among the last bytes and checksums
    unpacked.refused(bytes(data), "damaged-archive", "its ", " data ")


def test_a_bomb_behind_the_end_mark(unpacked: Unpacker) -> None:
    archive = gzip.compress(member() + END + bytes(80_000_000))
    unpacked.refused(archive, "archive-too-large", "compression ratio")


def test_xz_that_needs_gigabytes(unpacked: Unpacker) -> None:
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 1}]
    data = bytearray(lzma.compress(tar_of([(NAME, IMAGE)]), filters=filters))
    # The block header follows the stream's 12 bytes: size, flags, filter id, properties' size, dictionary's size.
    assert data[14:16] == b"\x21\x01"
    data[16] = 40  # 4 GiB
    block_header = bytes(data[12 : 12 + (data[12] + 1) * 4 - 4])
    data[12 + len(block_header) : 16 + len(block_header)] = struct.pack("<L", zlib.crc32(block_header))
    unpacked.refused(bytes(data), "unsupported-archive", "memory")
