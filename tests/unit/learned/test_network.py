from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnxruntime
import pytest

from mrasfm_engine.errors import CancelledError, InputError, ReconstructionError
from mrasfm_engine.features import aliked, segmentation, superpoint, xfeat
from mrasfm_engine.learned.catalogue import known_models
from mrasfm_engine.learned.network import CPU_PROVIDER, GPU_PROVIDERS, Network
from mrasfm_engine.learned.signatures import Signature
from mrasfm_engine.learned.stoppable_calls import POLL_S
from mrasfm_engine.matching import lighterglue, lightglue, superglue
from tests.helpers import learned_graphs


def test_many_threads_share_one_network() -> None:
    network = Network("x", learned_graphs.xfeat(), gpu=False)
    rng = np.random.default_rng(0)
    images = [rng.random((1, 3, 64, 96), dtype=np.float32) for _ in range(12)]
    alone = [network.run({"images": image}) for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: network.run({"images": image}), images))
    for a, b in zip(alone, together, strict=True):
        assert 5 < len(a["keypoints"]) < 2000
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])


def test_an_operator_that_this_runtime_lacks_is_named() -> None:
    with pytest.raises(InputError, match=r"model wand cannot be run by onnxruntime .*Wizardry"):
        Network("wand", learned_graphs.with_unknown_operator(learned_graphs.xfeat()), gpu=False)


def test_what_the_network_cannot_compute_is_an_error_with_the_shapes() -> None:
    network = Network("x", learned_graphs.xfeat(), gpu=False)
    with pytest.raises(ReconstructionError, match=r"model x failed on images \[1, 3, 8, 8\]"):
        network.run({"images": np.zeros((1, 3, 8, 8), np.float32)})


def test_a_gpu_is_used_where_there_is_a_provider_and_the_cpu_elsewhere() -> None:
    there = [p for p in GPU_PROVIDERS if p in onnxruntime.get_available_providers()]
    assert Network("x", learned_graphs.xfeat(), gpu=False).provider == CPU_PROVIDER
    assert Network("x", learned_graphs.xfeat(), gpu=True).provider in (*there, CPU_PROVIDER)


def test_the_signature_and_the_fixed_size_are_read() -> None:
    fixed = Network("x", learned_graphs.xfeat(32, 64), gpu=False)
    assert fixed.fixed_size("images") == (32, 64)
    assert xfeat.SIGNATURE.mismatches(fixed.signature) == []
    free = Network("s", learned_graphs.superpoint(), gpu=False)
    assert free.fixed_size("image") is None
    assert superpoint.SIGNATURE.mismatches(free.signature) == []


@pytest.mark.parametrize(
    ("graph", "signature"),
    [
        (learned_graphs.aliked, aliked.SIGNATURE),
        (learned_graphs.lightglue, lightglue.LIGHTGLUE),
        (learned_graphs.colmap_lightglue, lightglue.LIGHTGLUE_COLMAP),
        (learned_graphs.lighterglue, lighterglue.LIGHTERGLUE),
        (learned_graphs.superglue, superglue.SUPERGLUE),
        (learned_graphs.segmenter, segmentation.SIGNATURE),
    ],
)
def test_every_signature_fits_its_own_graph_and_no_other(graph: object, signature: Signature) -> None:
    assert callable(graph)
    found = Network("x", graph(), gpu=False).signature
    known = [model.signature for model in known_models()]
    assert len(known) == 8
    assert [s for s in known if not s.mismatches(found)] == [signature]


@pytest.mark.parametrize("sides", [(0, 0), (0, 96), (20_001, 64), (64, "W"), ("H", 96)])
def test_an_image_of_no_size_or_of_half_a_size_is_a_mismatch(sides: tuple[int | str, int | str]) -> None:
    found = Network("s", learned_graphs.segmenter(*sides), gpu=False).signature
    (problem,) = segmentation.SIGNATURE.mismatches(found)
    assert problem.startswith(f"input image float32[1,3,{sides[0]},{sides[1]}] is for no image")
    assert "1 to 20000 pixels" in problem


def test_calls_under_way_end_when_the_work_is_no_longer_wanted() -> None:
    cancel = threading.Event()
    network = Network("endless", learned_graphs.endless_segmenter(), gpu=False, cancel=cancel.is_set)
    image = np.full((1, 3, 32, 32), 0.5, np.float32)
    with ThreadPoolExecutor(2) as pool:
        calls = [pool.submit(network.run, {"image": image}) for _ in range(2)]
        time.sleep(2 * POLL_S)
        assert not any(call.done() for call in calls)
        cancel.set()
        for call in calls:
            with pytest.raises(CancelledError):
                call.result(timeout=30)


def test_calls_are_watched_again_after_a_pause() -> None:
    cancel = threading.Event()
    network = Network("s", learned_graphs.segmenter(), gpu=False, cancel=cancel.is_set)
    image = np.full((1, 3, 32, 32), 0.9, np.float32)
    for _ in range(3):
        assert (network.run({"image": image})["classes"] == 13).all()
        time.sleep(2 * POLL_S)
    assert "stoppable-calls" not in {thread.name for thread in threading.enumerate()}


def test_all_lines_of_a_failure_are_told() -> None:
    network = Network("s", learned_graphs.segmenter(32, 64), gpu=False)
    with pytest.raises(ReconstructionError, match=r"failed on image \[1, 3, 8, 8\]: .* Got: 8 Expected: 32") as caught:
        network.run({"image": np.zeros((1, 3, 8, 8), np.float32)})
    assert "Export it for inputs of these sizes" in caught.value.remedy


def test_mismatches_say_what_is_expected_and_what_is_there() -> None:
    found = Network("x", learned_graphs.xfeat(), gpu=False).signature
    problems = superpoint.SIGNATURE.mismatches(found)
    assert "input image float32[1,1,H,W] is missing" in problems
    assert "input images float32[1,3,64,96] is not expected" in problems
    assert "output keypoints int64|float32[1,K,2] is expected, keypoints float32[K,2] is there" in problems
