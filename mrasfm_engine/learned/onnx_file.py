"""Header of an ONNX file, read without running it.

Only the few fields that matter are taken from the protobuf encoding (onnx.proto, whose field numbers never change): the
package that reads all of it is needed for nothing else here.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from io import BytesIO, FileIO
from pathlib import Path

from mrasfm_engine.errors import InputError

MAX_BYTES = 2**31 - 1  # of a protobuf message: no ONNX model in one file is larger
_PIECE_BYTES = 1 << 20
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MODEL_GRAPH, _MODEL_FUNCTIONS = 7, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE = 1, 5, 15
_NODE_ATTRIBUTE, _FUNCTION_NODE = 5, 7
_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS = 5, 6, 10, 11
_ATTRIBUTE_SPARSE, _ATTRIBUTE_SPARSES = 22, 23
_SPARSE_VALUES, _SPARSE_INDICES = 1, 2
_TENSOR_NAME, _TENSOR_EXTERNAL, _TENSOR_LOCATION = 8, 13, 14
MAX_DEPTH = 32

# Opening a pipe would wait for somebody who writes into it.
_READ_WITHOUT_WAITING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)

# What a path may be besides a regular file, by the test of its mode.
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

# Which fields of a message are messages that may hold tensors, and of which type these are.
_CHILDREN: dict[str, dict[int, str]] = {
    "model": {_MODEL_GRAPH: "graph", _MODEL_FUNCTIONS: "function"},
    "graph": {_GRAPH_NODE: "node", _GRAPH_INITIALIZER: "tensor", _GRAPH_SPARSE: "sparse"},
    "function": {_FUNCTION_NODE: "node"},
    "node": {_NODE_ATTRIBUTE: "attribute"},
    "attribute": {
        _ATTRIBUTE_TENSOR: "tensor",
        _ATTRIBUTE_TENSORS: "tensor",
        _ATTRIBUTE_GRAPH: "graph",
        _ATTRIBUTE_GRAPHS: "graph",
        _ATTRIBUTE_SPARSE: "sparse",
        _ATTRIBUTE_SPARSES: "sparse",
    },
    "sparse": {_SPARSE_VALUES: "tensor", _SPARSE_INDICES: "tensor"},
}


def read_model(path: Path) -> bytes:
    """A model's bytes.

    Raises
    ------
    InputError
        Where the file cannot be read, is no regular file, empty or too large, is no ONNX model, or keeps weights in
        other files.
    """
    try:
        descriptor = os.open(path, _READ_WITHOUT_WAITING)
        try:
            _require_regular(os.fstat(descriptor), path)
            with open(descriptor, "rb", buffering=0, closefd=False) as file:
                data = _read_in_pieces(file, path)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise InputError(
            f"model {path} cannot be read: {error.strerror}",
            remedy="Give an existing file that you may read.",
            code="unreadable-file",
        ) from error
    except MemoryError:
        raise InputError(
            f"model {path} needs more memory than there is",
            remedy="Give a smaller model, or more memory.",
            code="bad-model",
        ) from None
    try:
        outside = list(external_tensors(memoryview(data)))
        fields = {number for number, _, _ in _fields(memoryview(data))}
    except ValueError as error:
        raise _no_model(path) from error
    if _MODEL_GRAPH not in fields:
        raise _no_model(path)
    if outside:
        raise InputError(
            f"model {path} keeps {len(outside)} tensors in other files, such as {outside[0] or 'one without a name'}",
            remedy="Save it as one file (onnx.save with save_as_external_data=False).",
            code="bad-model",
        )
    return data


def _require_regular(status: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _KINDS if test(status.st_mode)), "no regular file")
        raise InputError(f"model {path} is {kind}", remedy="Give the ONNX file itself.", code="not-a-file")
    if status.st_size > MAX_BYTES:
        raise _too_large(path)


def _read_in_pieces(file: FileIO, path: Path) -> bytes:
    """The content: no more of it than the bound if the file grows, and of what is no model only the beginning."""
    content = BytesIO()
    while piece := file.read(_PIECE_BYTES):
        if content.tell() == 0 and not _begins_a_message(piece):
            raise _no_model(path)
        content.write(piece)
        if content.tell() > MAX_BYTES:
            raise _too_large(path)
    if content.tell() == 0:
        raise InputError(
            f"{path} is no ONNX model: it is empty (0 bytes)",
            remedy="Copy it again from its source.",
            code="empty-file",
        )
    return content.getvalue()


def _too_large(path: Path) -> InputError:
    return InputError(
        f"model {path} has more than {MAX_BYTES} bytes, the most that an ONNX model in one file can have",
        remedy="Give a smaller model.",
        code="bad-model",
    )


def _begins_a_message(piece: bytes) -> bool:
    """Return whether the first byte can be a field's key: a number over 0, of a type that ONNX has."""
    return piece[0] >> 3 > 0 and piece[0] & 7 in (_VARINT, _FIXED64, _BYTES, _FIXED32)


def sha256_of(data: bytes) -> str:
    """Hash of a model's bytes, as hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def external_tensors(data: memoryview, message: str = "model", depth: int = 0) -> Iterator[str]:
    """Names of tensors whose values lie in other files, in subgraphs and functions too.

    Raises
    ------
    ValueError
        Where the bytes are no protobuf message.
    """
    if depth > MAX_DEPTH:
        raise ValueError("nested too deeply")
    if message == "tensor":
        name, outside = "", False
        for number, kind, value in _fields(data):
            if number == _TENSOR_NAME and kind == _BYTES:
                name = bytes(value).decode("utf-8", "replace") if isinstance(value, memoryview) else ""
            outside |= number == _TENSOR_EXTERNAL or (number == _TENSOR_LOCATION and value == 1)
        if outside:
            yield name
        return
    children = _CHILDREN[message]
    for number, kind, value in _fields(data):
        if number in children and kind == _BYTES and isinstance(value, memoryview):
            yield from external_tensors(value, children[number], depth + 1)


def _fields(data: memoryview) -> Iterator[tuple[int, int, int | memoryview]]:
    """Field number, wire type and value of one message."""
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if number == 0:
            raise ValueError("field number 0")
        value: int | memoryview
        if kind == _VARINT:
            value, at = _varint(data, at)
        else:
            if kind == _BYTES:
                size, at = _varint(data, at)
            elif kind in (_FIXED64, _FIXED32):
                size = 8 if kind == _FIXED64 else 4
            else:
                raise ValueError(f"wire type {kind}")
            if at + size > end:
                raise ValueError("a field reaches beyond the end")
            value, at = data[at : at + size], at + size
        yield number, kind, value


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    result = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        result |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not byte & 0x80:
            return result, at
    raise ValueError("a number does not end")


def _no_model(path: Path) -> InputError:
    return InputError(
        f"{path} is no ONNX model",
        remedy="Give a file that torch.onnx.export or onnx.save has written.",
        code="bad-model",
    )
