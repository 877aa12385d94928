"""Products of matrices of bytes, exact, in a quarter to half of the time of those of floats.

Processors multiply and add four bytes where they would one float, but BLAS has no such product. onnxruntime has one for
every kind of processor, as the operator MatMulInteger; this module writes the graph with that one operator.

The right side is a constant of its graph: packed as the instructions take it, which is done once, and not for each of
the many short products that one pair of images is made of.

Most processors have the instruction for bytes without a sign times bytes with one. Where it is missing, onnxruntime
adds such products in 16 bits, which overflow: it is tried once, and there both sides have no sign, at half the speed.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from mrasfm_engine.learned.network import Network
from mrasfm_engine.types import Bytes, Floats32, Ints32

IR_VERSION, OPERATORS_VERSION = 8, 13  # of ONNX
UINT8, INT8, INT32 = 2, 3, 6  # element types of ONNX
SIGN = 128  # what bytes with a sign are smaller by
TRIED = (64, 128, 64)  # shape of the products that are tried: several of every kernel's blocks


class RightSide:
    """The right side of products of bytes, packed; any thread may multiply by it.

    Parameters
    ----------
    rows
        (m, k) its columns.

    Attributes
    ----------
    nbytes
        About what it takes in memory: packed, and once more in the file of its graph.
    """

    def __init__(self, rows: Bytes) -> None:
        columns = np.ascontiguousarray(rows.T)
        self.nbytes = 2 * columns.nbytes
        self.is_signed = _signs_are_exact()
        self._operator = _operator(columns ^ np.uint8(SIGN), INT8) if self.is_signed else _operator(columns, UINT8)

    def product(self, a: Bytes) -> Ints32:
        """Matrix product (n, m) of bytes (n, k) and this side (k, m), less `missing` of each row."""
        return np.asarray(self._operator.run({"a": a})["y"], dtype=np.int32)


def missing(a: Bytes) -> Floats32:
    """Shortfall (n,) of all products with a row of bytes (n, k): a whole number, exact up to 512 bytes."""
    sums = a.sum(axis=1, dtype=np.float32)
    return np.float32(SIGN) * sums if _signs_are_exact() else np.zeros_like(sums)


@cache
def _signs_are_exact() -> bool:
    """Return whether this processor adds the largest products without overflow."""
    n, k, m = TRIED
    a, b = np.full((n, k), 255, np.uint8), np.full((k, m), 127, np.int8)
    b[:, ::2] = -128
    found = _operator(b.view(np.uint8), INT8).run({"a": a})["y"]
    return np.array_equal(found, a.astype(np.int32) @ b.astype(np.int32))


def _operator(right: Bytes, element: int) -> Network:
    """The product with a right side (k, m), whose bytes are numbers of an element type."""
    return Network("product of bytes", _model(right, element), gpu=False, keeps_memory=False)


def _model(right: Bytes, element: int) -> bytes:
    """The file: an ONNX ModelProto, of which the numbers are those of the fields in onnx.proto."""
    node = _field(1, b"a") + _field(1, b"b") + _field(2, b"y") + _field(4, b"MatMulInteger")
    sides = b"".join(_number(1, side) for side in right.shape)
    constant = sides + _number(2, element) + _field(8, b"b") + _field(9, right.tobytes())
    graph = _field(1, node) + _field(2, b"product") + _field(5, constant)
    graph += _field(11, _value(b"a", UINT8, b"n", b"k")) + _field(12, _value(b"y", INT32, b"n", b"m"))
    operators = _field(1, b"") + _number(2, OPERATORS_VERSION)
    return _number(1, IR_VERSION) + _field(7, graph) + _field(8, operators)


def _value(name: bytes, element: int, *sides: bytes) -> bytes:
    """A ValueInfoProto: a tensor of sides that only have names."""
    shape = b"".join(_field(1, _field(2, side)) for side in sides)
    return _field(1, name) + _field(2, _field(1, _number(1, element) + _field(2, shape)))


def _field(number: int, content: bytes) -> bytes:
    """A protobuf field of bytes."""
    return bytes([number << 3 | 2]) + _varint(len(content)) + content


def _number(number: int, value: int) -> bytes:
    return bytes([number << 3]) + _varint(value)


def _varint(value: int) -> bytes:
    low, rest = value & 127, value >> 7
    return bytes([low | 128]) + _varint(rest) if rest else bytes([low])
