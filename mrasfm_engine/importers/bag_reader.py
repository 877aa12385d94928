"""Reads ROS bags of all formats: ROS 1, and ROS 2 in SQLite or MCAP.

The bags are opened by rosbags, which is written in Python alone and needs no ROS. It is imported where a bag is opened:
commands that read none start without it.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from mrasfm_engine.errors import InputError, MrasfmError
from mrasfm_engine.importers.bag_unpacking import METADATA, unpacked

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

ROS1_SUFFIX = ".bag"
SUFFIXES = (ROS1_SUFFIX, ".mcap", ".db3")
# SQLite's files of what is not in the database yet, where its writer was killed or is at it; rosbags reads none of it.
JOURNALS = ("-wal", "-journal")
# Recorders close a chunk of messages after some megabytes; only one message that is larger makes a larger one, and no
# image that is read here has a gigabyte.
MAX_CHUNK_BYTES = 1 << 30
_REMEDIES = {
    ROS1_SUFFIX: "Repair it with `rosbag reindex` and `rosbag fix`, or record it again.",
    ".mcap": "Repair it with `mcap recover`, or record it again; its messages must be of ROS 2.",
    ".db3": "Repair it with `ros2 bag reindex`, or record it again.",
}


class Entry(NamedTuple):
    """One message of a bag with the time at which it was recorded."""

    topic: str
    received_ns: int
    message: Any  # as its definition in the bag has it


def bag_files(path: Path) -> list[Path]:
    """The files of a recording, or the folder of a ROS 2 bag; empty for anything else.

    Raises
    ------
    InputError
        If a folder holds bags of several formats.
    """
    if path.is_file():
        return [path] if path.suffix in SUFFIXES else []
    if not path.is_dir():
        return []
    if (path / METADATA).is_file():
        return [path]
    found = {suffix: sorted(path.glob(f"*{suffix}")) for suffix in SUFFIXES}
    kinds = [suffix for suffix, files in found.items() if files]
    if len(kinds) > 1:
        raise InputError(
            f"{path} holds bags of several formats: {', '.join(found[kind][0].name for kind in kinds)}",
            remedy="Give one of these files instead of the folder.",
            code="several-bags",
        )
    return found[kinds[0]] if kinds else []


class Bag:
    """An open recording of one or several files.

    Parameters
    ----------
    paths
        As `bag_files` finds them.
    scratch
        Folder for the files of bags that are compressed file by file, see `bag_unpacking`.
    """

    def __init__(self, paths: Sequence[Path], scratch: Path) -> None:
        self.paths = paths
        self.scratch = scratch
        self._readers: list[Reader1 | Reader2] = []
        self._open = ExitStack()

    def __enter__(self) -> Bag:
        for path in self.paths:
            with _defects_named(path):
                reader = _reader(path, self.scratch)
                self._open.enter_context(reader)
                self._readers.append(reader)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def types(self) -> dict[str, str]:
        """The type of each topic with messages, as `sensor_msgs/msg/Image`, in the order of their names."""
        found = {c.topic: c.msgtype for reader in self._readers for c in reader.connections if c.msgcount}
        return dict(sorted(found.items()))

    def entries(self, topics: Collection[str]) -> Iterator[Entry]:
        """Messages of the topics, by the time at which they were recorded; one at a time is in memory.

        Raises
        ------
        InputError
            If the bag is damaged, or a message is not what its definition says.
        """
        streams = [
            _entries(path, reader, topics) for path, reader in zip(self.paths, self._readers, strict=True) if topics
        ]
        return heapq.merge(*streams, key=lambda entry: entry.received_ns)


def _reader(path: Path, scratch: Path) -> Reader1 | Reader2:
    from rosbags import rosbag1, rosbag2

    _bound_decompression()
    _require_no_journal(path)
    if path.suffix == ROS1_SUFFIX and path.is_file():
        return rosbag1.Reader(path)
    return rosbag2.Reader(unpacked(path, scratch) if path.is_dir() else path)


def _require_no_journal(path: Path) -> None:
    """Refuse a bag with messages beside its database: those alone would be missing, without a word."""
    for database in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        for journal in (database.with_name(database.name + suffix) for suffix in JOURNALS):
            if journal.is_file() and journal.stat().st_size > 0:
                raise InputError(
                    f"bag {database} is not whole: {journal.name} holds what its recorder had not yet moved into it",
                    remedy=f"End the recorder; if it was killed, run `sqlite3 {database.name} VACUUM` in its folder.",
                    code="bad-bag",
                )


def _bound_decompression() -> None:
    """Let rosbags take nothing larger than `MAX_CHUNK_BYTES` out of a chunk, or out of a message that is compressed by
    itself: a small file may say to fill the memory.

    rosbags looks its decompressors up in two tables and a module, and gives them no limit.
    """
    from bz2 import BZ2Decompressor

    from backports.zstd import ZstdDecompressor
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    storage_mcap.DECOMPRESSORS.update(lz4=_bounded(LZ4FrameDecompressor), zstd=_bounded(ZstdDecompressor))
    ros1.decompressors.update(lz4=_bounded(LZ4FrameDecompressor), bz2=_bounded(BZ2Decompressor))
    vars(ros2)["zstd"] = SimpleNamespace(decompress=_bounded(ZstdDecompressor))


def _bounded(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
    def decompress(data: bytes, *_: int) -> bytes:
        parts: list[bytes] = []
        left = MAX_CHUNK_BYTES
        while data:
            stream = decompressor()
            parts.append(stream.decompress(data, max_length=left))
            left -= len(parts[-1])
            if not stream.eof:
                raise ValueError(f"a compressed chunk ends early, or holds over {MAX_CHUNK_BYTES / 1e6:.0f} MB")
            data = stream.unused_data or b""
        return b"".join(parts)

    return decompress


def _entries(path: Path, reader: Reader1 | Reader2, topics: Collection[str]) -> Iterator[Entry]:
    with _defects_named(path):
        connections = [c for c in reader.connections if c.topic in topics and c.msgcount]
        if not connections:
            return
        store = _typestore(connections)
        for connection, received_ns, raw in reader.messages(connections=connections):
            read = store.deserialize_ros1 if _is_ros1(connection) else store.deserialize_cdr
            yield Entry(connection.topic, received_ns, read(raw, connection.msgtype))


def _is_ros1(connection: Connection) -> bool:
    return getattr(connection.ext, "serialization_format", "ros1") == "ros1"


def _typestore(connections: Sequence[Connection]) -> Typestore:
    """Types of the wanted topics alone: another topic's odd definition does no harm.

    Bags of ROS 2 before Iron hold no definitions; those of the messages that are read here have not changed since.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.stores import ros2_humble

    types: dict[str, Any] = {}
    if any(c.msgdef.format is MessageDefinitionFormat.NONE for c in connections):
        types.update(ros2_humble.FIELDDEFS)
    for connection in connections:
        definition = connection.msgdef
        if definition.format is MessageDefinitionFormat.MSG:
            types.update(get_types_from_msg(definition.data, connection.msgtype))
        elif definition.format is MessageDefinitionFormat.IDL:
            for part in definition.data.split("=" * 80 + "\n"):
                text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                types.update(get_types_from_idl(text) if text.strip() else {})
    _require_fields(types, ros2_humble.FIELDDEFS)
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _require_fields(types: Mapping[str, Any], standard: Mapping[str, Any]) -> None:
    """Refuse definitions that lack fields of the standard ones: messages would parse as something else, or by chance.

    ROS 1 has some names in capitals. Fields beyond the standard ones do no harm.
    """
    for name in types.keys() & standard.keys():
        missing = {field.lower() for field, _ in standard[name][1]} - {field.lower() for field, _ in types[name][1]}
        if missing:
            raise ValueError(f"its definition of {name} has no field {', '.join(sorted(missing))}")


@contextmanager
def _defects_named(path: Path) -> Iterator[None]:
    """Turn what a damaged bag makes rosbags raise into an error that names the file.

    The bytes come from outside, and rosbags raises whatever its parsers meet: its own errors, those of struct, of the
    decompressors and of SQLite, failed assertions, missing keys.
    """
    try:
        yield
    except (MrasfmError, OSError, MemoryError):
        raise
    except Exception as error:
        kind = next((s for s in SUFFIXES if path.suffix == s or (path.is_dir() and any(path.glob(f"*{s}")))), ".db3")
        said = " ".join(str(error).split())[:300] or type(error).__name__
        raise InputError(f"bag {path} cannot be read: {said}", remedy=_REMEDIES[kind], code="bad-bag") from error
