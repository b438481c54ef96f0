"""The forward pass of a network by ONNX Runtime; torch computes it where a GPU or a lower precision is requested.

torch's own pass (``torch_passes.py``) brings the weights into the processor's layout at every call and rectifies each
map in a step of its own.  ONNX Runtime does both once, when a session is made; ``docs/benchmarks.md`` compares the two.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto

from core.errors import InvalidModel
from core.networks.backbone import Array, Device, OwnPass, Pass, Precision
from core.networks.graph import IMAGES, onnx_graph
from core.networks.network import ShallowNetwork
from core.threads import allowed_threads

SILENT = 4
"""ONNX Runtime's severity from which on it writes to standard error: errors are raised as well."""


class GraphRunner:
    """A graph in the ONNX format on the processor, computed by ONNX Runtime.

    A call has as many threads as the thread that calls it may use (``core.threads``).  Thread-safe.

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
        threads = allowed_threads()
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
    """A network in float32 on the processor, by ONNX Runtime.  Thread-safe.

    Raises:
        InvalidModel: ONNX Runtime has no such layer.
    """

    def __init__(self, network: ShallowNetwork) -> None:
        self._run = GraphRunner(network.definition.name, onnx_graph(network))

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output.

        Raises:
            InvalidModel: the images are too small for the layers.
        """
        return tuple(self._run({IMAGES: np.ascontiguousarray(images)}))


def forward_pass(network: ShallowNetwork | OwnPass, precision: Precision = "float32", device: Device = "cpu") -> Pass:
    """A network's forward pass: a shallow network's by ONNX Runtime, or by torch on a GPU or in a lower precision; any
    other computes in its own way.

    Raises:
        InvalidModel: this machine or this network cannot compute so.
    """
    plain = (precision, device) == ("float32", "cpu")
    if isinstance(network, ShallowNetwork):
        if plain:
            return GraphPass(network)
        try:
            from core.networks.torch_passes import torch_pass  # only here, for it loads torch
        except ModuleNotFoundError as error:
            raise InvalidModel(f"{device} in {precision} needs torch, which is not installed here.") from error
        return torch_pass(network, precision, device)
    if not plain:
        raise InvalidModel(
            "a plugged or imported network runs on the CPU in float32, unless it moves itself to another device."
        )
    return network
