"""The forward pass of a shallow network: ONNX Runtime computes it, and torch where a GPU or bfloat16 is requested.

torch's own pass brings the weights into the processor's layout at every call and rectifies each map in a step of its
own.  ONNX Runtime does both once, when a session is made; ``docs/benchmarks.md`` compares the two.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import ModelProto
from torch import Tensor

from core.errors import InvalidModel
from core.networks.gathering import GatheredPass
from core.networks.graph import IMAGES, onnx_graph
from core.networks.network import ShallowNetwork

Precision = Literal["float32", "bfloat16", "float16"]
Device = Literal["cpu", "cuda"]
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

LANES = 2
"""Batches that are on a GPU at the same time: one is computed while the other is brought there or back."""

MOST_IMAGES = 64
"""Images of one batch on a GPU."""

SILENT = 4
"""ONNX Runtime's severity from which on it writes to standard error: errors are raised as well."""


class GraphRunner:
    """A graph in the ONNX format on the processor, computed by ONNX Runtime.

    A call has as many threads as torch has in the thread that calls it.  Thread-safe.

    Args:
        name: by which errors call the network.
        outputs: names of those that are computed; None: all.

    Raises:
        InvalidModel: ONNX Runtime has no such layer, as a normalization over an even number of channels.
    """

    def __init__(self, name: str, graph: ModelProto | bytes, outputs: list[str] | None = None) -> None:
        self._name, self._outputs = name, outputs
        self._graph = graph if isinstance(graph, bytes) else graph.SerializeToString()
        self._sessions: dict[int, onnxruntime.InferenceSession] = {}
        self._making = threading.Lock()
        self._session()

    def _session(self) -> onnxruntime.InferenceSession:
        """The session with the number of threads that the calling thread may use."""
        threads = torch.get_num_threads()
        with self._making:
            if threads not in self._sessions:
                options = onnxruntime.SessionOptions()
                options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
                options.log_severity_level = SILENT
                # A thread that polls for work takes a core from the steps after the pass, and from other processes.
                options.add_session_config_entry("session.intra_op.allow_spinning", "0")
                try:
                    self._sessions[threads] = onnxruntime.InferenceSession(
                        self._graph, options, providers=["CPUExecutionProvider"]
                    )
                except Exception as error:  # its classes have no common base
                    raise InvalidModel(f"{self._name!r} cannot be computed: {error}") from error
            return self._sessions[threads]

    def __call__(self, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[np.float32]]:
        """The outputs, in their order, for the graph's inputs by name.

        Raises:
            InvalidModel: the inputs are too small for the layers, or not those that the graph takes.
        """
        try:
            return self._session().run(self._outputs, dict(inputs))
        except Exception as error:
            shapes = ", ".join(str(list(array.shape)) for array in inputs.values())
            raise InvalidModel(f"{self._name!r} cannot compute images of {shapes}: {error}") from error


class GraphPass:
    """A network in float32 on the processor, by ONNX Runtime; it is called like the network.  Thread-safe.

    Args:
        network: its weights are copied, so that later changes to it have no effect.

    Raises:
        InvalidModel: ONNX Runtime has no such layer.
    """

    def __init__(self, network: ShallowNetwork) -> None:
        self._run = GraphRunner(network.definition.name, onnx_graph(network))

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W to one B x K x X x Y tensor for each output, float32, channels last in memory.

        Raises:
            InvalidModel: the images are too small for the layers.
        """
        outputs = self._run({IMAGES: images.permute(0, 2, 3, 1).contiguous().numpy()})
        return tuple(torch.from_numpy(output).permute(0, 3, 1, 2) for output in outputs)


class TorchPass:
    """A copy of a network in torch, on the processor and in a precision; it is called like the network."""

    def __init__(self, network: ShallowNetwork, precision: Precision) -> None:
        self._dtype = DTYPES[precision]
        self._network = _copied(network, torch.device("cpu"), self._dtype)

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W float32 to one B x K x X x Y float32 tensor for each output."""
        return tuple(output.to(torch.float32) for output in self._network(images.to(self._dtype)))


def cuda_pass(network: ShallowNetwork, precision: Precision) -> GatheredPass:
    """A copy of a network on a GPU; threads that call it at the same time share batches.

    Raises:
        InvalidModel: torch finds no CUDA device.
    """
    if not torch.cuda.is_available():
        raise InvalidModel("torch finds no CUDA device on this machine; use the device cpu.")
    # By default torch allows cuDNN a mantissa of ten bits, which changes regions.
    torch.backends.cudnn.allow_tf32 = False
    copied = _copied(network, torch.device("cuda"), DTYPES[precision])
    return GatheredPass([_CudaLane(copied, DTYPES[precision]) for _ in range(LANES)], MOST_IMAGES)


class _CudaLane:
    """Computes one batch after the other in a stream of its own, by way of memory that the GPU reads and writes itself.

    Args:
        network: on the GPU.
        dtype: of its weights.
    """

    def __init__(self, network: ShallowNetwork, dtype: torch.dtype) -> None:
        self._network, self._dtype = network, dtype
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W float32 to one B x K x X x Y float32 tensor for each output, both on the processor."""
        with torch.cuda.stream(self._stream):
            there = images.pin_memory().to("cuda", non_blocking=True)
            outputs = [output.to(torch.float32) for output in self._network(there.to(self._dtype))]
            here = [torch.empty_like(output, device="cpu", pin_memory=True) for output in outputs]
            for back, output in zip(here, outputs, strict=True):
                back.copy_(output, non_blocking=True)
            self._stream.synchronize()
        return tuple(here)


def _copied(network: ShallowNetwork, device: torch.device, dtype: torch.dtype) -> ShallowNetwork:
    return copy.deepcopy(network).to(device, dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]


def has_bfloat16() -> bool:
    """Whether torch lets the processor multiply bfloat16, twice as fast as float32; elsewhere it is emulated.

    ``ATEN_CPU_CAPABILITY`` can restrict torch to a part of the processor's instructions.
    """
    able = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return bool(able) and torch.backends.cpu.get_cpu_capability() == "AVX512"
