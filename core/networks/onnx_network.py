"""A network in the ONNX format that others trained, as an encoder's backbone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.networks.backbone import Array
from core.networks.description import NetworkDescription
from core.networks.forward import GraphRunner
from core.networks.onnx_graph import as_maps, check_graph, graph_input, graph_output, read_graph

FORMAT = "placerec-onnx-network/1"

OUTPUT = "output"
"""The name of the only layer that such a network has for an encoder."""


class OnnxNetwork:
    """The backbone; it computes one frame after the other, so that no frame has a part in another one's features.

    Some networks compare the pictures of a batch with each other (CricaVPR), and many files take only one.  A call has
    as many threads as the thread that calls it may use.  Thread-safe.

    Args:
        name: by which errors call the network.
        graph: in the ONNX format, with all its weights.

    Raises:
        InvalidModel: the graph is damaged, or not one of those that are imported.
    """

    outputs = (OUTPUT,)

    def __init__(self, name: str, graph: bytes, description: NetworkDescription) -> None:
        self.name, self.description, self._graph = name, description, graph
        model = read_graph(graph)
        check_graph(model)
        self._input, output = graph_input(model, description), graph_output(model, description)
        self._run = GraphRunner(name, graph, [output])

    @property
    def input(self) -> InputDefinition:
        return self.description.input

    def describe(self) -> dict[str, Any]:
        return self.description.model_dump(mode="json", include={"input", "output"}, exclude_none=True)

    def weights(self) -> Mapping[str, NDArray[Any]]:
        """The whole graph, operators and weights, as bytes."""
        return {"graph": np.frombuffer(self._graph, np.uint8)}

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K].

        Raises:
            InvalidModel: the graph's output is not as its description says, or is not finite.
        """
        frames = np.ascontiguousarray(images.transpose(0, 3, 1, 2))
        found = [as_maps(self._run({self._input: frame[np.newaxis]})[0], self.description) for frame in frames]
        return (np.ascontiguousarray(np.concatenate(found).transpose(0, 2, 3, 1)),)


def save_onnx_network(path: Path, name: str, graph: bytes, description: NetworkDescription) -> None:
    """Write a checked graph and its description to one safetensors file."""
    metadata = {"format": FORMAT, "name": name, "description": description.model_dump_json()}
    save_file({"graph": np.frombuffer(graph, np.uint8)}, path, metadata)
    path.chmod(0o644)


def is_onnx_network(path: Path) -> bool:
    """Whether a network's file holds a graph in the ONNX format; False if it cannot be read."""
    try:
        with safe_open(path, "np") as file:
            return (file.metadata() or {}).get("format") == FORMAT
    except (OSError, SafetensorError):
        return False


def read_onnx_description(path: Path) -> tuple[str, NetworkDescription]:
    """Read name and description in a network's file, without the graph.

    Raises:
        InvalidModel: the file is missing, damaged or of another format.
    """
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise InvalidModel(f"{path.name} is not a {FORMAT} file.")
        return metadata["name"], NetworkDescription.model_validate_json(metadata["description"])
    except (OSError, SafetensorError, KeyError, ValidationError) as error:
        raise InvalidModel(f"{path.name} is not a readable network file: {error}") from error


def load_onnx_network(path: Path) -> OnnxNetwork:
    """Load a network from its file.

    Raises:
        InvalidModel: the file is missing, damaged, or holds a graph that is not one of those that are imported.
    """
    name, description = read_onnx_description(path)
    try:
        with safe_open(path, "np") as file:
            graph = np.asarray(file.get_tensor("graph"), np.uint8).tobytes()
    except (OSError, SafetensorError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    try:
        return OnnxNetwork(name, graph, description)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} cannot be used: {error}") from error
