"""Networks as files: whichever of the two formats one has, it is opened as a backbone."""

from __future__ import annotations

from pathlib import Path

from core.errors import InvalidModel
from core.networks.backbone import OwnPass
from core.networks.network import ShallowNetwork, load_network, read_definition
from core.networks.onnx_network import is_onnx_network, load_onnx_network, read_onnx_description


def open_network(path: Path, outputs: tuple[str, ...]) -> ShallowNetwork | OwnPass:
    """Load a network that returns the given layers.

    Raises:
        InvalidModel: the file cannot be used, or has no such layers.
    """
    if not is_onnx_network(path):
        return load_network(path, outputs)
    network = load_onnx_network(path)
    if outputs != network.outputs:
        raise InvalidModel(f"network {network.name!r} has no layers but {', '.join(network.outputs)}.")
    return network


def network_name(path: Path) -> str:
    """The name of the network in a file.

    Raises:
        InvalidModel: the file is missing, damaged or of another format.
    """
    return read_onnx_description(path)[0] if is_onnx_network(path) else read_definition(path).name
