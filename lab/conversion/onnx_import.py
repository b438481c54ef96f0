"""Importing a network that was exported to the ONNX format.

Such a file is a program.  It is read in a process of its own (``lab.conversion.isolation``), which takes it only if it
is made of the standard's own operators, without graphs within it, chance, or sizes that depend on the picture, and if
its weights lie in the file or beside it; and which then lets it compute three frames, within the same limits of memory
and time.  What the process gives back is the graph with all its weights in it, and nothing else of the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto, TensorProto
from safetensors.numpy import save_file

from core.errors import InvalidModel
from core.networks.description import NetworkDescription
from core.networks.onnx_graph import as_maps, bytes_of, check_graph, graph_input, graph_output, read_graph
from lab.conversion.isolation import Tree, read_in_child, serve

MAX_GRAPH = 2**31 - 2**20
"""Bytes of a network with its weights, which the format's messages do not exceed."""

TOLERANCE = 1e-5
"""By how much two passes over one frame may differ, relative to the largest value."""


def import_onnx(path: Path, description: NetworkDescription) -> bytes:
    """The graph of a network in a ``.onnx`` file, checked and tried out, with all its weights in it.

    Raises:
        InvalidModel: the file is damaged, too large, takes or gives something else than the description says, or does
            what no network here may do; the text says what.
    """
    beside = sum(_size(file) for file in path.parent.glob(f"{path.name}*") if file != path)
    room = 4 * min(beside, MAX_GRAPH) + 2 * min(_size(path), MAX_GRAPH) + 2**30
    found = read_in_child(__name__, path, description.model_dump_json(), framework="numpy", room=room)
    return bytes(found["graph"])


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


# In the child process


def _read(path: Path, description: str) -> tuple[Tree, dict[str, NDArray[np.uint8]]]:
    """The graph of a file as bytes, once it is checked and has computed three frames."""
    described = NetworkDescription.model_validate_json(description)
    if path.stat().st_size > MAX_GRAPH:
        raise InvalidModel(f"It has more than {MAX_GRAPH} bytes; export the network in half precision.")
    model = read_graph(path.read_bytes())
    _bring_in(model.graph.initializer, path.parent)
    check_graph(model)
    for field in ("doc_string", "metadata_props", "training_info"):
        model.ClearField(field)
    graph = model.SerializeToString(deterministic=True)
    if len(graph) > MAX_GRAPH:
        raise InvalidModel(f"With its weights it has more than {MAX_GRAPH} bytes; export it in half precision.")
    shape = _tried(graph, model, described)
    return {"shape": shape}, {"graph": np.frombuffer(graph, np.uint8)}


def _bring_in(tensors: Iterable[TensorProto], folder: Path) -> None:
    """Put the weights that lie in files beside the network's into the graph."""
    total = 0
    for tensor in tensors:
        if tensor.data_location != TensorProto.EXTERNAL:
            continue
        where = {entry.key: entry.value for entry in tensor.external_data}
        name = where.get("location", "")
        path = (folder / name).resolve()
        if not name or os.path.isabs(name) or not path.is_relative_to(folder.resolve()) or not path.is_file():
            raise InvalidModel(f"Its weights are to be read from {name[:120]!r}, which is no file beside it.")
        start, length = int(where.get("offset", 0)), bytes_of(tensor)
        size = path.stat().st_size
        if start < 0 or not 0 <= length <= size - start or int(where.get("length", length)) != length:
            raise InvalidModel(f"Its weights {tensor.name[:60]!r} are not in {name[:120]!r}: the file is cut off.")
        total += length
        if total > MAX_GRAPH:
            raise InvalidModel(f"Its weights have more than {MAX_GRAPH} bytes; export the network in half precision.")
        with path.open("rb") as file:
            file.seek(start)
            tensor.raw_data = file.read(length)
        tensor.ClearField("external_data")
        tensor.ClearField("data_location")


def _tried(graph: bytes, model: ModelProto, description: NetworkDescription) -> list[int]:
    """K, X and Y of what the network gives for a black frame, a white one, and one of noise."""
    shown, options = description.input, onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    name, output = graph_input(model, description), graph_output(model, description)
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its classes have no common base
        raise InvalidModel(f"ONNX Runtime cannot compute it: {error}") from error
    pixels = np.random.default_rng(0).uniform(0, 255, (1, 3, shown.height, shown.width))
    found = []
    for frame in (np.zeros_like(pixels), np.full_like(pixels, 255), pixels, pixels):
        image = (frame - np.reshape(shown.mean, (1, 3, 1, 1))) * np.reshape(shown.scale, (1, 3, 1, 1))
        try:
            (values,) = session.run([output], {name: image.astype(np.float32)})
        except Exception as error:
            raise InvalidModel(f"It does not compute a frame of {shown.width}x{shown.height}: {error}") from error
        found.append(as_maps(values, description))
    once, again = found[-2:]
    if once.shape != again.shape or np.abs(once - again).max() > TOLERANCE * max(1e-9, float(np.abs(once).max())):
        raise InvalidModel("It gives other values for the same frame each time.")
    if once.shape != found[0].shape:
        raise InvalidModel("What it gives for two frames has two shapes.")
    if not any(maps.any() for maps in found) or (once == found[0]).all():
        raise InvalidModel("It gives the same for every frame.")
    return [int(side) for side in once.shape[1:]]


if __name__ == "__main__":
    serve(_read, save_file)
