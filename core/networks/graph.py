"""A shallow network as a graph in the ONNX format, which ONNX Runtime computes."""

from __future__ import annotations

from typing import Any

from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from core.networks.network import Convolution, Layer, Normalization, Pooling, Relu, ShallowNetwork

OPSET, IR_VERSION = 17, 8
"""Versions of the operators and of the format: old enough for every ONNX Runtime that the project allows."""

IMAGES, CHANNELS_FIRST = "the images", "the images, channels first"
"""Names that no layer has, for layers' names are without spaces."""


def onnx_graph(network: ShallowNetwork) -> ModelProto:
    """The layers and weights of a network.

    The graph's input ``IMAGES`` is float32 [B, H, W, 3].  It has one output for each of the network's, in that order:
    float32 [B, X, Y, K], rectified.
    """
    nodes = [helper.make_node("Transpose", [IMAGES], [CHANNELS_FIRST], perm=[0, 3, 1, 2])]
    values, rectified, found = CHANNELS_FIRST, "", {}
    for layer in network.definition.layers:
        nodes.append(_node(layer, values))
        values = layer.name
        if not isinstance(layer, Relu):
            rectified = layer.name
        found[rectified] = values  # a rectifier replaces its input
    outputs = [f"output {index}" for index in range(len(network.outputs))]
    for name, output in zip(network.outputs, outputs, strict=True):
        nodes.append(helper.make_node("Transpose", [found[name]], [output], perm=[0, 2, 3, 1]))
    graph = helper.make_graph(
        nodes,
        network.definition.name,
        [helper.make_tensor_value_info(IMAGES, TensorProto.FLOAT, ["frames", "height", "width", 3])],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, None) for output in outputs],
        [numpy_helper.from_array(array, name) for name, array in network.weights().items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def _node(layer: Layer, values: str) -> NodeProto:
    """The node of one layer, whose output has the layer's name; ``values`` is the name of its input."""
    match layer:
        case Convolution():
            weights = [f"{layer.name}.weight", f"{layer.name}.bias"]
            window = _window(layer.kernel, layer.stride, layer.pad)
            return helper.make_node("Conv", [values, *weights], [layer.name], group=layer.groups, **window)
        case Relu(negative_slope=0.0):
            return helper.make_node("Relu", [values], [layer.name])
        case Relu():
            return helper.make_node("LeakyRelu", [values], [layer.name], alpha=layer.negative_slope)
        case Pooling(method="max"):
            window = _window(layer.kernel, layer.stride, layer.pad)
            return helper.make_node("MaxPool", [values], [layer.name], ceil_mode=int(layer.ceil), **window)
        case Pooling():
            window = _window(layer.kernel, layer.stride, layer.pad)
            shape: dict[str, Any] = {"ceil_mode": int(layer.ceil), "count_include_pad": 1}
            return helper.make_node("AveragePool", [values], [layer.name], **shape, **window)
        case Normalization():
            constants: dict[str, Any] = {"size": layer.size, "alpha": layer.alpha, "beta": layer.beta, "bias": layer.k}
            return helper.make_node("LRN", [values], [layer.name], **constants)


def _window(kernel: int, stride: int, pad: int) -> dict[str, Any]:
    return {"kernel_shape": [kernel] * 2, "strides": [stride] * 2, "pads": [pad] * 4}
