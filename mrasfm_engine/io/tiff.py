"""Directories of BigTIFF files (TIFF 6.0 with offsets of 64 bits), little-endian: written, and read again."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

SHORT, LONG, DOUBLE, ASCII, LONG8 = 3, 4, 12, 2, 16
FORMAT = {SHORT: "H", LONG: "I", DOUBLE: "d", ASCII: "B", LONG8: "Q"}
HEADER_BYTES = 16
TILE_OFFSETS, TILE_SIZES = 324, 325
GEO_TAGS = (34264, 34735, 34736, 34737)  # ModelTransformation, GeoKeyDirectory, its numbers and its texts

Entry = tuple[int, int, bytes]  # tag, type, values


def entry(tag: int, kind: int, *values: float) -> Entry:
    """An entry of a directory."""
    return tag, kind, struct.pack(f"<{len(values)}{FORMAT[kind]}", *values)


def header() -> bytes:
    """The header of a file whose directories follow it."""
    return struct.pack("<2sHHHQ", b"II", 43, 8, 0, HEADER_BYTES)


def directories(
    tags: Sequence[Sequence[Entry]], offsets: Sequence[NDArray[Any]], sizes: Sequence[NDArray[Any]]
) -> bytes:
    """All directories, each followed by the values that do not fit into it; offsets and sizes of tiles are uint64."""
    data, at = b"", HEADER_BYTES
    for level, (own, offset, size) in enumerate(zip(tags, offsets, sizes, strict=True)):
        entries = sorted([*own, (TILE_OFFSETS, LONG8, offset.tobytes()), (TILE_SIZES, LONG8, size.tobytes())])
        beyond = at + 8 + 20 * len(entries) + 8
        table, values = struct.pack("<Q", len(entries)), b""
        for tag, kind, value in entries:
            count = len(value) // struct.calcsize(FORMAT[kind])
            inline = value.ljust(8, b"\0") if len(value) <= 8 else struct.pack("<Q", beyond + len(values))
            table += struct.pack("<HHQ", tag, kind, count) + inline
            values += b"" if len(value) <= 8 else value.ljust(-(-len(value) // 8) * 8, b"\0")
        end = beyond + len(values)
        data += table + struct.pack("<Q", 0 if level == len(tags) - 1 else end) + values
        at = end
    return data


def read_directories(path: Path) -> list[dict[int, Entry]]:
    """Entries of all directories by their tags.

    Raises
    ------
    ValueError
        Where the file is no such TIFF, or ends early.
    """
    found: list[dict[int, Entry]] = []
    size = path.stat().st_size
    with path.open("rb") as file:

        def take(at: int, count: int) -> bytes:
            if at + count > size:
                raise ValueError("it ends early")
            file.seek(at)
            return file.read(count)

        magic, version, bytes_of_offsets, _, at = struct.unpack("<2sHHHQ", take(0, HEADER_BYTES))
        if (magic, version, bytes_of_offsets) != (b"II", 43, 8):
            raise ValueError("it is no little-endian BigTIFF")
        while at and len(found) < 64:
            (count,) = struct.unpack("<Q", take(at, 8))
            table = take(at + 8, 20 * count + 8)
            own: dict[int, Entry] = {}
            for row in range(count):
                tag, kind, number, inline = struct.unpack_from("<HHQ8s", table, 20 * row)
                if kind not in FORMAT:
                    raise ValueError(f"its entry {tag} is of kind {kind}, which is not known")
                length = number * struct.calcsize(FORMAT[kind])
                own[tag] = (tag, kind, inline[:length] if length <= 8 else take(struct.unpack("<Q", inline)[0], length))
            found.append(own)
            (at,) = struct.unpack_from("<Q", table, 20 * count)
    return found
