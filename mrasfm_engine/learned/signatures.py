"""What goes into a model and comes out of it: the contract that a file must keep before it is used.

Shapes have a name where the size is free (the same name means nothing more) and a number where it is fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class ModelKind(StrEnum):
    """What a model is for."""

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
        """What of `found`, a file's signature, is not as it must be; empty where it is.

        A free size of the file fits any, and a fixed one fits a free size: networks are exported for one image size.
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


F32, I64, U8 = "float32", "int64", "uint8"


def _f32(name: str, *shape: str | int) -> Tensor:
    return Tensor(name, (F32,), shape)


# XFeat (Potje et al., CVPR 2024) as exported by noahzhy/xfeat_lightglue_onnx: image RGB 0..1, keypoints in pixels.
XFEAT = Signature(
    inputs=(_f32("images", 1, 3, "H", "W"),),
    outputs=(_f32("keypoints", "K", 2), _f32("descriptors", "K", 64), _f32("scores", "K")),
)
# LighterGlue of the same repository; keypoints as LightGlue was trained, (xy - size / 2) / (max(size) / 2).
LIGHTERGLUE = Signature(
    inputs=(
        _f32("kpts0", 1, "N0", 2),
        _f32("kpts1", 1, "N1", 2),
        _f32("desc0", 1, "N0", 64),
        _f32("desc1", 1, "N1", 64),
    ),
    outputs=(Tensor("matches", (I64,), ("M", 2)), _f32("scores", "M")),
)
# ALIKED (Zhao et al., TIM 2023) as COLMAP publishes it: image RGB 0..1, sides multiples of 32, keypoints in -1..1.
ALIKED = Signature(
    inputs=(
        _f32("image", 1, 3, "H", "W"),
        Tensor("max_keypoints", (I64,), ()),
        _f32("min_score"),
    ),
    outputs=(_f32("keypoints", 1, "K", 2), _f32("descriptors", 1, "K", "D"), _f32("scores", 1, "K")),
)
# LightGlue (Lindenberger et al., ICCV 2023) as COLMAP publishes it: keypoints in pixels, matches0 -1 where none.
LIGHTGLUE_COLMAP = Signature(
    inputs=(
        _f32("kpts0", 1, "N0", 2),
        _f32("kpts1", 1, "N1", 2),
        _f32("desc0", 1, "N0", "D"),
        _f32("desc1", 1, "N1", "D"),
        _f32("image_size0", 1, 2),
        _f32("image_size1", 1, 2),
    ),
    outputs=(Tensor("matches0", (I64, F32), ("N0",)), _f32("mscores0", "N0")),
)
# SuperPoint (DeTone et al., CVPRW 2018) as exported by fabio-sim/LightGlue-ONNX: gray 0..1, keypoints in pixels.
SUPERPOINT = Signature(
    inputs=(_f32("image", 1, 1, "H", "W"),),
    outputs=(Tensor("keypoints", (I64, F32), (1, "K", 2)), _f32("scores", 1, "K"), _f32("descriptors", 1, "K", 256)),
)
# LightGlue of the same repository; keypoints normalised as above.
LIGHTGLUE = Signature(
    inputs=(
        _f32("kpts0", 1, "N0", 2),
        _f32("kpts1", 1, "N1", 2),
        _f32("desc0", 1, "N0", 256),
        _f32("desc1", 1, "N1", 256),
    ),
    outputs=(Tensor("matches0", (I64,), ("M", 2)), _f32("mscores0", "M")),
)
# SuperGlue (Sarlin et al., CVPR 2020) as exported by yuefanhao/SuperPoint-SuperGlue-TensorRT and used by AirSLAM:
# keypoints (xy - size / 2) / (0.7 max(size)), descriptors by column, logarithms of the assignment with its dustbins.
SUPERGLUE = Signature(
    inputs=(
        _f32("keypoints_0", 1, "N0", 2),
        _f32("scores_0", 1, "N0"),
        _f32("descriptors_0", 1, 256, "N0"),
        _f32("keypoints_1", 1, "N1", 2),
        _f32("scores_1", 1, "N1"),
        _f32("descriptors_1", 1, 256, "N1"),
    ),
    outputs=(_f32("scores", 1, "N0+1", "N1+1"),),
)
# Any network for semantic segmentation: image RGB 0..1, ids of the drive's label map a pixel.
SEGMENTER = Signature(
    inputs=(_f32("image", 1, 3, "H", "W"),),
    outputs=(Tensor("classes", (U8,), (1, "H", "W")),),
)
