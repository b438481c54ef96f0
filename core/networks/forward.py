"""The forward pass of a shallow network: ONNX Runtime computes it, and torch where a GPU or bfloat16 is asked for.

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
from core.networks.graph import IMAGES, onnx_graph
from core.networks.network import ShallowNetwork

Precision = Literal["float32", "bfloat16"]
Device = Literal["cpu", "cuda"]
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}

SILENT = 4
"""ONNX Runtime's severity from which on it writes to standard error: what goes wrong is raised as well."""


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
        """The session of as many threads as the calling thread may use."""
        threads = torch.get_num_threads()
        with self._making:
            if threads not in self._sessions:
                options = onnxruntime.SessionOptions()
                options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
                options.log_severity_level = SILENT
                # A thread that polls for work takes a core from what follows the pass, and from other processes.
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
            InvalidModel: the inputs are too small for the layers, or not what the graph takes.
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
    """A copy of a network in torch, on a device and in a precision; it is called like the network.

    Raises:
        InvalidModel: torch finds no CUDA device.
    """

    def __init__(self, network: ShallowNetwork, precision: Precision, device: Device) -> None:
        if device == "cuda":
            if not torch.cuda.is_available():
                raise InvalidModel("torch finds no CUDA device on this machine; use the device cpu.")
            # By default torch allows cuDNN a mantissa of ten bits, which changes regions.
            torch.backends.cudnn.allow_tf32 = False
        self._device, self._dtype = torch.device(device), DTYPES[precision]
        copied = copy.deepcopy(network)
        self._network = copied.to(self._device, self._dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W float32 to one B x K x X x Y float32 tensor for each output, on the CPU."""
        outputs = self._network(images.to(self._device, self._dtype))
        return tuple(output.to("cpu", torch.float32) for output in outputs)


def has_bfloat16() -> bool:
    """Whether torch lets the processor multiply bfloat16, twice as fast as float32; elsewhere it is emulated.

    ``ATEN_CPU_CAPABILITY`` can keep torch to a part of what the processor has.
    """
    able = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return bool(able) and torch.backends.cpu.get_cpu_capability() == "AVX512"
