"""The operators that a graph in the ONNX format may have, and its inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto

from core.errors import InvalidModel
from core.networks.description import NetworkDescription
from core.networks.operators import check_operator, check_shapes

MAX_NODES = 100_000
MAX_VALUES = 2**17
"""Values of a descriptor or of a cell."""

MAX_CELLS = 2**14

_DOMAINS = ("", "ai.onnx")


def read_graph(data: bytes) -> ModelProto:
    """The message in the bytes of a graph.

    Raises:
        InvalidModel: they are no message in the ONNX format.
    """
    model = ModelProto()
    try:
        model.ParseFromString(data)
    except DecodeError as error:
        raise InvalidModel("It is not a file in the ONNX format.") from error
    if not model.graph.node or not model.opset_import:
        raise InvalidModel("It is not a network in the ONNX format: it has no operators.")
    return model


def check_graph(model: ModelProto) -> None:
    """Check that a graph only computes: by the standard's operators, on its input and on weights that it holds, and in
    as much memory for one frame as for any other (:mod:`core.networks.operators`).

    Raises:
        InvalidModel: it does not; the text says why.
    """
    if model.functions:
        raise InvalidModel(f"It defines operators of its own ({model.functions[0].name[:60]}); export it without.")
    graph = model.graph
    if len(graph.node) > MAX_NODES:
        raise InvalidModel(f"It has more than {MAX_NODES} operators.")
    if graph.sparse_initializer or any(attribute.HasField("sparse_tensor") for attribute in _attributes(graph)):
        raise InvalidModel("It has sparse weights, which are not read.")
    for node in graph.node:
        _check_node(node)
    for tensor in _tensors(graph):
        _check_tensor(tensor)
    check_shapes(graph)


def _check_node(node: NodeProto) -> None:
    if node.domain not in _DOMAINS:
        raise InvalidModel(
            f"It needs the operator {node.domain[:60]}.{node.op_type[:60]}, which is not of the standard."
        )
    check_operator(node)


def _check_tensor(tensor: TensorProto) -> None:
    if tensor.data_location == TensorProto.EXTERNAL:
        raise InvalidModel(f"Its weights {tensor.name[:60]!r} are outside of the file.")
    held = len(tensor.raw_data)
    if tensor.HasField("raw_data") and held != bytes_of(tensor):
        raise InvalidModel(
            f"Its weights {tensor.name[:60]!r} have {held} bytes, not the {bytes_of(tensor)} of their shape."
        )


def bytes_of(tensor: TensorProto) -> int:
    """The bytes that the shape of a tensor requires; two values of four bits share a byte."""
    count = math.prod(tensor.dims)
    try:
        width = onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
    except (KeyError, TypeError) as error:
        raise InvalidModel(f"Its weights {tensor.name[:60]!r} are of an unknown type.") from error
    four_bits = tensor.data_type in (TensorProto.INT4, TensorProto.UINT4, TensorProto.FLOAT4E2M1)
    return (count + 1) // 2 if four_bits else count * width


def _attributes(graph: GraphProto) -> Iterator[AttributeProto]:
    return (attribute for node in graph.node for attribute in node.attribute)


def _tensors(graph: GraphProto) -> Iterator[TensorProto]:
    yield from graph.initializer
    for attribute in _attributes(graph):
        yield from [attribute.t] if attribute.HasField("t") else []
        yield from attribute.tensors


def graph_input(model: ModelProto, description: NetworkDescription) -> str:
    """The name of the one input of a graph, float32 [B or 1, 3, H, W].

    Raises:
        InvalidModel: it has others, or one of another type or shape than the description's.
    """
    held = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in held]
    if len(inputs) != 1:
        raise InvalidModel(f"It has {len(inputs)} inputs, not one for a picture.")
    taken = inputs[0].type.tensor_type
    if taken.elem_type != TensorProto.FLOAT:
        raise InvalidModel("Its input is not of float32; export it so, with weights of any type.")
    shape = [side.dim_value if side.HasField("dim_value") else None for side in taken.shape.dim]
    shown = description.input
    wanted = (1, 3, shown.height, shown.width)
    if len(shape) != 4 or any(side not in (None, want) for side, want in zip(shape, wanted, strict=True)):
        sides = " x ".join("any" if side is None else str(side) for side in shape)
        raise InvalidModel(
            f"Its input is {sides}, not 1 x 3 x {shown.height} x {shown.width} as it is described (--input-size)."
        )
    return str(inputs[0].name)


def graph_output(model: ModelProto, description: NetworkDescription) -> str:
    """The name of the output that the description means.

    Raises:
        InvalidModel: there is none of this name.
    """
    names = [str(value.name) for value in model.graph.output]
    wanted = description.output.name
    if not names or wanted not in (None, *names):
        raise InvalidModel(f"It has no output {wanted!r}; it has {', '.join(names)[:300] or 'none'}.")
    return names[0] if wanted is None else wanted


def as_maps(values: NDArray[Any], description: NetworkDescription) -> NDArray[np.float32]:
    """The output of a network for one frame as maps, float32 [1, K, X, Y].

    Raises:
        InvalidModel: it has another shape than is described, too many values, or such as are not finite.
    """
    output, shown = description.output, description.input
    if not isinstance(values, np.ndarray) or values.dtype not in (np.float32, np.float16, np.float64):
        raise InvalidModel("The network gives no floating-point numbers.")
    shape = list(values.shape)
    maps = np.asarray(values, np.float32)
    if output.kind == "tokens":
        assert output.patch is not None
        rows, columns = shown.height // output.patch, shown.width // output.patch
        wanted = output.skip + rows * columns
        if len(shape) != 3 or shape[1] != wanted:
            raise InvalidModel(
                f"The network gives {shape}, not {wanted} tokens: {output.skip}, and {rows} x {columns} of patches of "
                f"{output.patch} pixels."
            )
        maps = maps[:, output.skip :].reshape(shape[0], rows, columns, shape[2]).transpose(0, 3, 1, 2)
    elif output.kind == "descriptor":
        maps = maps.reshape([*shape, 1, 1] if len(shape) == 2 else shape)
    if maps.ndim != 4 or len(maps) != 1 or (output.kind == "descriptor" and maps.shape[2:] != (1, 1)):
        raise InvalidModel(f"The network gives {shape}, which is no {output.kind} of one frame.")
    if not 0 < maps.shape[1] <= MAX_VALUES or not 0 < maps.shape[2] * maps.shape[3] <= MAX_CELLS:
        raise InvalidModel(
            f"The network gives {shape}; up to {MAX_VALUES} values in up to {MAX_CELLS} cells are taken."
        )
    if not np.isfinite(maps).all():
        raise InvalidModel("The network gives values that are not finite.")
    return np.maximum(maps, 0) if output.rectify else maps
