"""Runs a model: one session for all our threads, whose own threads it does not add to."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import CancelledError, InputError, ReconstructionError
from mrasfm_engine.learned.signatures import Signature, Tensor
from mrasfm_engine.learned.stoppable_calls import StoppableCalls
from mrasfm_engine.types import Cancel

Array = NDArray[Any]

# DirectML is left out: its sessions may run in one thread only.
CUDA_PROVIDER = "CUDAExecutionProvider"
GPU_PROVIDERS = (CUDA_PROVIDER, "ROCMExecutionProvider")
CPU_PROVIDER = "CPUExecutionProvider"
STRIDE_PX = 32  # sides of an image for a network of free size are multiples of it
_ELEMENT_TYPES = {"float": "float32", "double": "float64", "float16": "float16"}
MAX_ERROR_CHARACTERS = 600  # of an error of onnxruntime: its own words begin after a name of a function in C++
_QUIET = 4  # onnxruntime writes nothing: its errors become our own


class Network:
    """A model that is ready to run.

    `run` may be called from many threads at once: each call computes on its caller's thread alone, so that a pool of
    ours is all there is. Images and pairs are what is parallel; all known models take them one by one. Memory is that
    of the largest input times the number of threads, until the network is dropped.

    Parameters
    ----------
    name
        For messages.
    data
        The model's bytes, see `onnx_file.read_model`.
    gpu
        Use a GPU where this onnxruntime has a provider that starts; else the CPU.
    keeps_memory
        Keep a call's memory for the next one; without, a network of one operator is a megabyte smaller.
    cancel
        Ends calls when the work is no longer wanted; called in a thread of its own.

    Raises
    ------
    InputError
        Where this runtime cannot load the model, as when it lacks an operator.
    """

    def __init__(
        self, name: str, data: bytes, *, gpu: bool, keeps_memory: bool = True, cancel: Cancel = lambda: False
    ) -> None:
        # Loads in half a second; who uses no model does not wait for it.
        import onnxruntime

        self.name = name
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        # The number of keypoints differs from call to call: plans of memory for one shape would not be used again.
        options.enable_mem_pattern = False
        options.enable_cpu_mem_arena = keeps_memory
        options.log_severity_level = _QUIET
        there = onnxruntime.get_available_providers()
        providers = [p for p in GPU_PROVIDERS if gpu and p in there] + [CPU_PROVIDER]
        try:
            # A command's own output is JSON: onnxruntime prints there where a GPU does not start. On a CPU it prints
            # nothing, and networks are made in many threads at once.
            with nullcontext() if providers == [CPU_PROVIDER] else redirect_stdout(sys.stderr):
                if CUDA_PROVIDER in providers:
                    onnxruntime.preload_dlls()  # as pip installs CUDA beside onnxruntime-gpu, it lies on no search path
                self._session = onnxruntime.InferenceSession(data, options, providers=providers)
        except Exception as error:  # onnxruntime raises a dozen kinds without a common root
            raise InputError(
                f"model {name} cannot be run by onnxruntime {onnxruntime.__version__}: {_in_one_line(error)}",
                remedy="Export it with operators and an opset that this onnxruntime has, or install a newer one.",
                code="bad-model",
            ) from error
        self.provider: str = self._session.get_providers()[0]
        self.signature = Signature(
            inputs=tuple(_tensor(node) for node in self._session.get_inputs()),
            outputs=tuple(_tensor(node) for node in self._session.get_outputs()),
        )
        self._outputs = [tensor.name for tensor in self.signature.outputs]
        self._cancel, self._calls, self._call_options = cancel, StoppableCalls(cancel), onnxruntime.RunOptions

    def run(self, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Outputs by name.

        Raises
        ------
        CancelledError
            Where the work is no longer wanted.
        ReconstructionError
            Where the runtime fails.
        """
        options = self._call_options()
        options.log_severity_level = _QUIET
        try:
            with self._calls.one(options):
                found = self._session.run(self._outputs, dict(inputs), options)
        except MemoryError:
            raise
        except Exception as error:
            if self._cancel():
                raise CancelledError from error
            shapes = ", ".join(f"{name} {list(np.shape(value))}" for name, value in inputs.items())
            raise ReconstructionError(
                f"model {self.name} failed on {shapes}: {_in_one_line(error)}",
                remedy="Export it for inputs of these sizes, or use another model. Where it lacks memory, lower "
                "features.max_side_px, matching.max_keypoints or threads.",
                code="model-failed",
            ) from error
        return dict(zip(self._outputs, found, strict=True))

    def fixed_size(self, image: str) -> tuple[int, int] | None:
        """Rows and columns that the model's image must have, None where they are free."""
        shape = next(tensor.shape for tensor in self.signature.inputs if tensor.name == image)
        rows, columns = shape[-2:]
        return (rows, columns) if isinstance(rows, int) and isinstance(columns, int) else None


def _tensor(node: Any) -> Tensor:
    kind = node.type.removeprefix("tensor(").removesuffix(")")
    shape = tuple(size if isinstance(size, int) else str(size) for size in node.shape)
    return Tensor(node.name, (_ELEMENT_TYPES.get(kind, kind),), shape)


def _in_one_line(error: Exception) -> str:
    """Words of an error, which stand on several lines and are as long as a model's author likes."""
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= MAX_ERROR_CHARACTERS else words[:MAX_ERROR_CHARACTERS] + "..."
