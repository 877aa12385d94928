from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.onnx_file import external_tensors, read_model
from tests.helpers import learned_graphs


def write(folder: Path, data: bytes) -> Path:
    path = folder / "model.onnx"
    path.write_bytes(data)
    return path


def test_a_model_in_one_file_is_read_as_it_is(tmp_path: Path) -> None:
    data = learned_graphs.aliked()
    assert read_model(write(tmp_path, data)) == data


def test_weights_in_other_files_are_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, learned_graphs.with_external_data(learned_graphs.aliked()))
    with pytest.raises(InputError, match="keeps 1 tensors in other files, such as constant_0") as error:
        read_model(path)
    assert "one file" in error.value.remedy


def test_external_data_is_found_in_branches_and_attributes() -> None:
    tensor = numpy_helper.from_array(np.zeros(3, np.float32), "hidden")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    constant = helper.make_node("Constant", [], ["y"], value=tensor)
    branch = helper.make_graph([constant], "branch", [], [helper.make_tensor_value_info("y", 1, [3])])
    choice = helper.make_node("If", ["c"], ["z"], then_branch=branch, else_branch=branch)
    graph = helper.make_graph(
        [choice], "g", [helper.make_tensor_value_info("c", 9, [])], [helper.make_tensor_value_info("z", 1, [3])]
    )
    data = helper.make_model(graph).SerializeToString()
    assert list(external_tensors(memoryview(data))) == ["hidden", "hidden"]


@pytest.mark.parametrize("content", [b"", b"not a model", b"\x00" * 40, b"\xff" * 40, b"<html>sign in</html>"])
def test_other_files_are_no_models(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(InputError, match="is no ONNX model"):
        read_model(write(tmp_path, content))


def test_a_damaged_model_is_no_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    data = np.frombuffer(learned_graphs.aliked(), np.uint8)
    refused = 0
    for _ in range(300):
        damaged = data[: rng.integers(1, len(data))].copy()
        damaged[rng.integers(0, len(damaged), 3)] = rng.integers(0, 256, 3)
        try:
            read_model(write(tmp_path, damaged.tobytes()))
        except InputError:
            refused += 1
    assert 150 < refused <= 300


def test_a_large_model_is_read_in_pieces_to_its_end(tmp_path: Path) -> None:
    tensor = numpy_helper.from_array(np.arange(700_000, dtype=np.float32), "large")
    data = helper.make_model(helper.make_graph([], "g", [], [], [tensor])).SerializeToString()
    assert len(data) > 2**21
    assert read_model(write(tmp_path, data)) == data


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.onnx cannot be read"):
        read_model(tmp_path / "nowhere.onnx")
