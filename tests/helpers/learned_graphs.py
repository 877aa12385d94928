"""Small ONNX graphs that keep the signatures of trained models and do something whose result is known.

Extractors find bright pixels that are larger than their neighbours; their descriptors are the brightness there, written
as a rotation so that equal brightness means equal descriptors. Matchers take the most similar descriptor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

F32, I64, U8, BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.UINT8, TensorProto.BOOL
OPSET = 17
Shape = Sequence[int | str]


class Graph:
    """Nodes one after the other; every call returns the name of its result."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def __call__(self, operator: str, *inputs: str, **attributes: object) -> str:
        name = f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def constant(self, value: object, dtype: type = np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype), name))
        return name

    def model(
        self, inputs: dict[str, tuple[int, Shape]], outputs: dict[str, tuple[str, int, Shape]], opset: int = OPSET
    ) -> bytes:
        """The bytes; outputs are given as (result's name, type, shape)."""
        for name, (result, _, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [result], [name]))
        graph = helper.make_graph(
            self.nodes,
            "test",
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
            [helper.make_tensor_value_info(name, kind, shape) for name, (_, kind, shape) in outputs.items()],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
        data: bytes = model.SerializeToString()
        return data


def _maxima(g: Graph, image: str, threshold: float) -> tuple[str, str]:
    """Places (n, 2) as row and column, and brightness (n,)."""
    gray = g("ReduceMean", image, axes=[1], keepdims=1)
    largest = g("MaxPool", gray, kernel_shape=[5, 5], pads=[2, 2, 2, 2], strides=[1, 1])
    found = g("And", g("Equal", gray, largest), g("Greater", gray, g.constant(threshold)))
    plane = g("Squeeze", gray, g.constant([0, 1], np.int64))
    places = g("Transpose", g("NonZero", g("Squeeze", found, g.constant([0, 1], np.int64))), perm=[1, 0])
    return places, g("GatherND", plane, places)


def _xy(g: Graph, places: str) -> str:
    return g("Gather", places, g.constant([1, 0], np.int64), axis=1)


def _descriptors(g: Graph, brightness: str, size: int) -> str:
    """(n, size), of unit length."""
    angle = g("Mul", g("Unsqueeze", brightness, g.constant([1], np.int64)), g.constant(np.full((1, 1), 40.0)))
    both = g("Concat", g("Cos", angle), g("Sin", angle), axis=1)
    return g("Pad", both, g.constant([0, 0, 0, size - 2], np.int64))


def xfeat(rows: int | str = 64, columns: int | str = 96, threshold: float = 0.4) -> bytes:
    g = Graph()
    places, scores = _maxima(g, "images", threshold)
    return g.model(
        {"images": (F32, (1, 3, rows, columns))},
        {
            "keypoints": (g("Cast", _xy(g, places), to=F32), F32, ("K", 2)),
            "descriptors": (_descriptors(g, scores, 64), F32, ("K", 64)),
            "scores": (scores, F32, ("K",)),
        },
    )


def superpoint(rows: int | str = "H", columns: int | str = "W", threshold: float = 0.4) -> bytes:
    g = Graph()
    places, scores = _maxima(g, "image", threshold)
    batch = g.constant([0], np.int64)
    return g.model(
        {"image": (F32, (1, 1, rows, columns))},
        {
            "keypoints": (g("Unsqueeze", _xy(g, places), batch), I64, (1, "K", 2)),
            "scores": (g("Unsqueeze", scores, batch), F32, (1, "K")),
            "descriptors": (g("Unsqueeze", _descriptors(g, scores, 256), batch), F32, (1, "K", 256)),
        },
    )


def aliked() -> bytes:
    g = Graph()
    places, brightness = _maxima(g, "image", 0.4)
    enough = g("Where", g("Greater", brightness, "min_score"), brightness, g.constant(-1.0))
    count = g("Min", g("Shape", brightness), g("Unsqueeze", "max_keypoints", g.constant([0], np.int64)))
    top = f"TopK_{len(g.nodes)}"
    g.nodes.append(helper.make_node("TopK", [enough, count], [top, f"{top}_index"]))
    chosen = g("Compress", f"{top}_index", g("Greater", top, g.constant(0.0)), axis=0)
    xy = g("Cast", g("Gather", _xy(g, places), chosen, axis=0), to=F32)
    size = g("Gather", g("Shape", "image"), g.constant([3, 2], np.int64))
    last = g("Sub", g("Cast", size, to=F32), g.constant(1.0))
    normalised = g("Sub", g("Mul", g("Div", xy, last), g.constant(2.0)), g.constant(1.0))
    scores = g("Gather", brightness, chosen)
    batch = g.constant([0], np.int64)
    return g.model(
        {"image": (F32, (1, 3, "H", "W")), "max_keypoints": (I64, ()), "min_score": (F32, ())},
        {
            "keypoints": (g("Unsqueeze", normalised, batch), F32, (1, "K", 2)),
            "descriptors": (g("Unsqueeze", _descriptors(g, scores, 128), batch), F32, (1, "K", 128)),
            "scores": (g("Unsqueeze", scores, batch), F32, (1, "K")),
        },
    )


def _best(g: Graph, a: str, b: str) -> tuple[str, str]:
    """Of every row of a (1, n, D) the most similar one of b (n,), and how similar (n,)."""
    similarity = g("Squeeze", g("MatMul", a, g("Transpose", b, perm=[0, 2, 1])), g.constant([0], np.int64))
    return g("ArgMax", similarity, axis=1, keepdims=0), g("ReduceMax", similarity, axes=[1], keepdims=0)


def _pairs(g: Graph, best: str) -> str:
    rows = g("Range", g.constant(0, np.int64), g("Squeeze", g("Shape", best)), g.constant(1, np.int64))
    column = g.constant([1], np.int64)
    return g("Concat", g("Unsqueeze", rows, column), g("Unsqueeze", best, column), axis=1)


def _two_sides(size: int | str) -> dict[str, tuple[int, Shape]]:
    return {
        "kpts0": (F32, (1, "N0", 2)),
        "kpts1": (F32, (1, "N1", 2)),
        "desc0": (F32, (1, "N0", size)),
        "desc1": (F32, (1, "N1", size)),
    }


def lightglue(size: int = 256, matches: str = "matches0", scores: str = "mscores0") -> bytes:
    """Pairs and scores, as fabio-sim exports LightGlue; with other names as LighterGlue."""
    g = Graph()
    best, similarity = _best(g, "desc0", "desc1")
    return g.model(_two_sides(size), {matches: (_pairs(g, best), I64, ("M", 2)), scores: (similarity, F32, ("M",))})


def lighterglue() -> bytes:
    return lightglue(64, "matches", "scores")


def colmap_lightglue(places_only: bool = False) -> bytes:
    """-1 where nothing is similar. With `places_only` keypoints at the same share of both images match."""
    g = Graph()
    if places_only:
        a, b = (g("Div", f"kpts{i}", g("Unsqueeze", f"image_size{i}", g.constant([1], np.int64))) for i in (0, 1))
        column, row = g.constant([2], np.int64), g.constant([1], np.int64)
        difference = g("Sub", g("Unsqueeze", a, column), g("Unsqueeze", b, row))
        distance = g("Squeeze", g("ReduceL2", difference, axes=[3], keepdims=0), g.constant([0], np.int64))
        best = g("ArgMin", distance, axis=1, keepdims=0)
        similarity = g("Sub", g.constant(1.0), g("ReduceMin", distance, axes=[1], keepdims=0))
    else:
        best, similarity = _best(g, "desc0", "desc1")
    matches = g("Where", g("Greater", similarity, g.constant(0.99)), best, g.constant(-1, np.int64))
    return g.model(
        {**_two_sides("D"), "image_size0": (F32, (1, 2)), "image_size1": (F32, (1, 2))},
        {"matches0": (matches, I64, ("N0",)), "mscores0": (similarity, F32, ("N0",))},
    )


def superglue() -> bytes:
    g = Graph()
    similarity = g("MatMul", g("Transpose", "descriptors_0", perm=[0, 2, 1]), "descriptors_1")
    likely = g("Clip", similarity, g.constant(1e-6), g.constant(1.0))
    assignment = g("Pad", g("Log", likely), g.constant([0, 0, 0, 0, 1, 1], np.int64))
    sides = {
        f"{name}_{i}": (F32, shape)
        for i in (0, 1)
        for name, shape in (
            ("keypoints", (1, f"N{i}", 2)),
            ("scores", (1, f"N{i}")),
            ("descriptors", (1, 256, f"N{i}")),
        )
    }
    return g.model(sides, {"scores": (assignment, F32, (1, "N0+1", "N1+1"))})


def segmenter(rows: int | str = "H", columns: int | str = "W", *, dark: int = 2, bright: int = 13) -> bytes:
    """Cityscapes: what is bright is a car, the rest a building."""
    g = Graph()
    gray = g("ReduceMean", "image", axes=[1], keepdims=0)
    classes = g("Where", g("Greater", gray, g.constant(0.5)), g.constant(bright, np.uint8), g.constant(dark, np.uint8))
    return g.model({"image": (F32, (1, 3, rows, columns))}, {"classes": (classes, U8, (1, rows, columns))})


def endless_segmenter() -> bytes:
    """A segmenter that counts to 2^62 first."""
    g = Graph()
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go_on"], ["goes_on"]),
            helper.make_node("Add", ["before", "before"], ["after"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("count", I64, []),
            helper.make_tensor_value_info("go_on", BOOL, []),
            helper.make_tensor_value_info("before", F32, []),
        ],
        [helper.make_tensor_value_info("goes_on", BOOL, []), helper.make_tensor_value_info("after", F32, [])],
    )
    mean = g("ReduceMean", "image", axes=[0, 1, 2, 3], keepdims=0)
    last = g("Loop", g.constant(2**62, np.int64), g.constant(True, np.bool_), mean, body=body)
    classes = g("Cast", g("Mul", g("ReduceMean", "image", axes=[1], keepdims=0), last), to=U8)
    return g.model({"image": (F32, (1, 3, "H", "W"))}, {"classes": (classes, U8, (1, "H", "W"))})


def with_external_data(data: bytes) -> bytes:
    """The same model with its first constant in another file."""
    model = onnx.load_from_string(data)
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="weights.bin")
    changed: bytes = model.SerializeToString()
    return changed


def with_unknown_operator(data: bytes) -> bytes:
    """The same model with an operator of a domain that no runtime has."""
    model = onnx.load_from_string(data)
    model.graph.node[0].op_type, model.graph.node[0].domain = "Wizardry", "com.example"
    model.opset_import.append(helper.make_opsetid("com.example", 1))
    changed: bytes = model.SerializeToString()
    return changed
