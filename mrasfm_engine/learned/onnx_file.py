"""What an ONNX file says of itself, read without running it.

Only the few fields that matter are taken from the protobuf encoding (onnx.proto, whose field numbers never change): the
package that reads all of it is needed for nothing else here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from mrasfm_engine.errors import InputError

MAX_BYTES = 2**31 - 1  # of a protobuf message
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MODEL_GRAPH, _MODEL_FUNCTIONS = 7, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_SPARSE = 1, 5, 15
_NODE_ATTRIBUTE, _FUNCTION_NODE = 5, 7
_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS = 5, 6, 10, 11
_ATTRIBUTE_SPARSE, _ATTRIBUTE_SPARSES = 22, 23
_SPARSE_VALUES, _SPARSE_INDICES = 1, 2
_TENSOR_NAME, _TENSOR_EXTERNAL, _TENSOR_LOCATION = 8, 13, 14
MAX_DEPTH = 32

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
        Where the file cannot be read, is too large, is no ONNX model, or keeps weights in other files.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(
                f"model {path} has more than {MAX_BYTES} bytes", remedy="Give a smaller model.", code="bad-model"
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"model {path} cannot be read: {error.strerror}", remedy="Give an existing file.", code="unreadable-file"
        ) from error
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
