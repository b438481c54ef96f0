"""Small networks in the ONNX format, sound and otherwise, written node by node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from core.frames.preprocessing import InputDefinition
from core.networks.description import Aggregation, NetworkDescription, Output
from lab.conversion.presets import PRESETS

SIDE = 32
SHOWN = InputDefinition(height=SIDE, width=SIDE, mean=(128.0, 128.0, 128.0), scale=(0.01, 0.01, 0.01))
MAPS = NetworkDescription(input=SHOWN, output=Output(kind="maps"), aggregation=Aggregation(method="gem"))
DESCRIPTOR = NetworkDescription(input=SHOWN, output=Output(kind="descriptor"))


def weights(channels: int = 6) -> NDArray[np.float32]:
    """Of a convolution of 8 x 8 in steps of 8."""
    return np.random.default_rng(0).normal(size=(channels, 3, 8, 8)).astype(np.float32)


def node(kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> NodeProto:
    return helper.make_node(kind, list(inputs), [output], **attributes)


CONVOLUTION = node("Conv", ["images", "w"], "maps", strides=[8, 8])


def onnx_network(
    nodes: Sequence[NodeProto] = (CONVOLUTION,),
    output: str = "maps",
    *,
    shape: Sequence[int | str] = (1, 3, SIDE, SIDE),
    kind: int = TensorProto.FLOAT,
    tensors: Sequence[TensorProto] = (),
    domains: Sequence[str] = (),
) -> ModelProto:
    """A network of these nodes on the input ``images``, with the weights ``w`` and further ones."""
    graph = helper.make_graph(
        list(nodes),
        "small",
        [helper.make_tensor_value_info("images", kind, list(shape))],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, None)],
        [numpy_helper.from_array(weights(), "w"), *tensors],
    )
    imports = [helper.make_opsetid("", 17), *(helper.make_opsetid(domain, 1) for domain in domains)]
    return helper.make_model(graph, opset_imports=imports, ir_version=8)


def published_network(preset: str, side: int | None = None) -> ModelProto:
    """A small network of random weights that takes and gives what the network of a preset does; 6 values.

    Args:
        side: of its input, in pixels; default: the preset's.
    """
    side = side or PRESETS[preset].input.height
    shape = (1, 3, side, side)
    if PRESETS[preset].output.kind == "descriptor":
        mean = node("GlobalAveragePool", ["maps"], "mean")
        return onnx_network([CONVOLUTION, mean, node("Flatten", ["mean"], "values")], "values", shape=shape)
    patches = node("Conv", ["images", "w"], "maps", strides=[14, 14], pads=[0, 0, 0, 0], dilations=[1, 1])
    rows = node("Reshape", ["maps", "shape"], "rows")
    tokens = node("Transpose", ["rows"], "tokens", perm=[0, 2, 1])
    count = numpy_helper.from_array(np.array([1, 6, (side // 14) ** 2]), "shape")
    return onnx_network([patches, rows, tokens], "tokens", shape=shape, tensors=[count])
