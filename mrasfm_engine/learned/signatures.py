"""Inputs and outputs of models: the contract that a file must keep before it is used.

Shapes have a name where the size is free (the same name means nothing more) and a number where it is fixed. `H` and `W`
are the sides of an image: both are fixed or both free, as an image is either resized or filled up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from schemas.drive import MAX_IMAGE_SIDE_PX

SIDES = ("H", "W")
_IMAGE_SIZES = f"both free, or both fixed to 1 to {MAX_IMAGE_SIDE_PX} pixels"


class ModelKind(StrEnum):
    """Use of a model."""

    EXTRACTOR = "extractor"
    MATCHER = "matcher"
    SEGMENTER = "segmenter"


@dataclass(frozen=True)
class Tensor:
    """One input or output."""

    name: str
    types: tuple[str, ...]  # element types that are accepted
    shape: tuple[str | int, ...]

    def __str__(self) -> str:
        return f"{self.name} {'|'.join(self.types)}[{','.join(map(str, self.shape))}]"


@dataclass(frozen=True)
class Signature:
    """Inputs and outputs of a model, by name; their order in the file does not matter."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]

    def __str__(self) -> str:
        return f"{', '.join(map(str, self.inputs))} -> {', '.join(map(str, self.outputs))}"

    def mismatches(self, found: Signature) -> list[str]:
        """List the differences of `found`, a file's signature; empty where it fits.

        A free size of the file fits any, and a fixed one fits a free size: networks are exported for one image size,
        which is that of an image.
        """
        return [
            *_mismatches("input", self.inputs, found.inputs, complete=True),
            *_mismatches("output", self.outputs, found.outputs, complete=False),
        ]


def _mismatches(what: str, expected: Sequence[Tensor], found: Sequence[Tensor], *, complete: bool) -> list[str]:
    there = {tensor.name: tensor for tensor in found}
    problems = []
    for tensor in expected:
        other = there.pop(tensor.name, None)
        if other is None:
            problems.append(f"{what} {tensor} is missing")
        elif not _fits(tensor, other):
            problems.append(f"{what} {tensor} is expected, {other} is there")
        elif complete and not _has_image_size(tensor, other):
            problems.append(f"{what} {other} is for no image, whose sides are {_IMAGE_SIZES}")
    # Outputs that nobody asked for cost nothing; an input that nobody feeds fails.
    if complete:
        problems += [f"{what} {tensor} is not expected" for tensor in there.values()]
    return problems


def _fits(expected: Tensor, found: Tensor) -> bool:
    if not set(found.types) <= set(expected.types):
        return False
    if len(expected.shape) != len(found.shape):
        # Exporters lose the rank of outputs that depend on the data.
        return not found.shape and bool(expected.shape)
    return all(
        isinstance(a, str) or isinstance(b, str) or a == b for a, b in zip(expected.shape, found.shape, strict=True)
    )


def _has_image_size(expected: Tensor, found: Tensor) -> bool:
    """Return whether the sides of an image are free, or fixed to a size that images have; of no image they are none."""
    sides = [size for name, size in zip(expected.shape, found.shape, strict=False) if name in SIDES]
    are_fixed = [isinstance(size, int) for size in sides]
    bounded = all(1 <= size <= MAX_IMAGE_SIDE_PX for size in sides if isinstance(size, int))
    return bounded and len(set(are_fixed)) <= 1


FLOAT32, INT64, UINT8 = "float32", "int64", "uint8"


def float_tensor(name: str, *shape: str | int) -> Tensor:
    """Declare a tensor of 32 bit floats."""
    return Tensor(name, (FLOAT32,), shape)
