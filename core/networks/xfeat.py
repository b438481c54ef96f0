"""XFeat: a small network of local features (Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching",
CVPR 2024), in its sparse mode.

A frame becomes three maps: how likely each pixel is a keypoint, how reliable the surroundings of a pixel are, and a
descriptor of 64 values for each cell of eight by eight pixels.  The backbone is a pyramid of five blocks, of which the
last three are added at an eighth of the frame's size.  Keypoints have a branch of their own, which sees nothing but the
pixels of one cell.  The published weights have a batch normalization after every convolution but the heads' last; the
packaged file has them folded into the convolutions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper
from safetensors import SafetensorError, safe_open

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.networks.forward import GraphRunner
from core.networks.graph import IR_VERSION, OPSET

FORMAT = "placerec-xfeat/1"
NAME = "xfeat"
PACKAGED_XFEAT = Path(__file__).parents[1] / "models" / "xfeat.safetensors"
CELL = 8
"""Pixels a side of a cell: the maps of descriptors and of reliability have one value for each."""
MULTIPLE = 32
"""Both sides of a frame are multiples of this many pixels, so that the levels of the pyramid lie on one another."""
LENGTH = 64
"""Values of a descriptor."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Conv:
    """A convolution with a bias; ``rectified``: a max(x, 0) follows it."""

    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    rectified: bool = True

    @property
    def pad(self) -> int:
        """Pixels of zeros at each border."""
        return 1 if self.kernel == 3 else 0


BLOCKS: dict[str, tuple[Conv, ...]] = {
    "skip1": (Conv(1, 24, 1, rectified=False),),
    "block1": (Conv(1, 4), Conv(4, 8, stride=2), Conv(8, 8), Conv(8, 24, stride=2)),
    "block2": (Conv(24, 24), Conv(24, 24)),
    "block3": (Conv(24, 64, stride=2), Conv(64, 64), Conv(64, 64, 1)),
    "block4": (Conv(64, 64, stride=2), Conv(64, 64), Conv(64, 64)),
    "block5": (Conv(64, 128, stride=2), Conv(128, 128), Conv(128, 128), Conv(128, 64, 1)),
    "fusion": (Conv(64, 64), Conv(64, 64), Conv(64, 64, 1, rectified=False)),
    "reliability": (Conv(64, 64, 1), Conv(64, 64, 1), Conv(64, 1, 1, rectified=False)),
    # The first sees the 64 pixels of a cell at once.
    "keypoints": (
        Conv(1, 64, CELL, CELL),
        Conv(64, 64, 1),
        Conv(64, 64, 1),
        Conv(64, CELL * CELL + 1, 1, rectified=False),
    ),
}
"""The convolutions of the network; those of a block follow one another."""


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """The names ``<block>.<number>.weight`` and ``.bias`` of all tensors, and their shapes."""
    shapes: dict[str, tuple[int, ...]] = {}
    for block, layers in BLOCKS.items():
        for number, layer in enumerate(layers):
            shapes[f"{block}.{number}.weight"] = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
            shapes[f"{block}.{number}.bias"] = (layer.outputs,)
    return shapes


@dataclass(frozen=True)
class FeatureMaps:
    """What the network sees in a frame of H x W pixels.

    heat: float32 [H, W], the probability within its cell that a pixel is the cell's keypoint, in [0, 1].
    reliability: float32 [H / 8, W / 8], in [0, 1].
    descriptors: float32 [H / 8, W / 8, 64], of unit length.
    """

    heat: Array
    reliability: Array
    descriptors: Array


class XFeat:
    """The network with its weights, computed by ONNX Runtime.  Thread-safe.

    Args:
        weights: the tensors of :func:`tensor_shapes`, float32.

    Raises:
        InvalidModel: a tensor is missing, has another shape, or is not finite.
    """

    def __init__(self, weights: Mapping[str, Array]) -> None:
        for name, shape in tensor_shapes().items():
            if name not in weights:
                raise InvalidModel(f"the weights of {NAME!r} lack {name}")
            if weights[name].shape != shape:
                raise InvalidModel(f"{name} has shape {weights[name].shape}, {NAME!r} needs {shape}")
            if not np.isfinite(weights[name]).all():
                raise InvalidModel(f"{name} holds values that are not finite")
        self._run = GraphRunner(NAME, xfeat_graph(weights))

    def __call__(self, pixels: Pixels) -> FeatureMaps:
        """The maps of a frame.

        Args:
            pixels: uint8 [H, W, 3], both sides multiples of ``MULTIPLE``; the order of the channels does not matter.

        Raises:
            InvalidModel: a side is not a multiple of ``MULTIPLE``.
        """
        height, width = pixels.shape[:2]
        if height % MULTIPLE or width % MULTIPLE or not height or not width:
            raise InvalidModel(f"{NAME!r} needs sides that are multiples of {MULTIPLE}, not {height} x {width}")
        heat, reliability, descriptors = self._run({"image": np.ascontiguousarray(pixels)})
        return FeatureMaps(heat, reliability, descriptors)


def load_xfeat(path: Path = PACKAGED_XFEAT) -> XFeat:
    """Read the weights from a file of half-precision tensors.

    Raises:
        InvalidModel: the file is missing, damaged or of another format.
    """
    try:
        with safe_open(path, "np") as file:
            if (file.metadata() or {}).get("format") != FORMAT:
                raise InvalidModel(f"{path.name} is not a {FORMAT} file.")
            weights = {name: file.get_tensor(name).astype(np.float32) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InvalidModel(f"{path.name} is not a readable file of weights: {error}") from error
    return XFeat(weights)


@cache
def packaged_xfeat() -> XFeat:
    """The packaged network, which is loaded once; this takes a tenth of a second.  Thread-safe.

    Raises:
        InvalidModel: its file is missing or damaged.
    """
    return load_xfeat()


def xfeat_graph(weights: Mapping[str, Array]) -> ModelProto:
    """The network as a graph in the ONNX format.

    Its input ``image`` is uint8 [H, W, 3]; its outputs are those of :class:`FeatureMaps`, in that order.
    """
    graph = _Graph(weights)
    values = graph.add("Cast", "image", to=TensorProto.FLOAT)
    grey = graph.add("Unsqueeze", graph.add("ReduceMean", values, axes=[2], keepdims=0), graph.whole_numbers(0, 1))
    # The authors scale pixels to [0, 1] and add 1e-5 to the variance.
    ones = graph.constant(np.ones(1, np.float32)), graph.constant(np.zeros(1, np.float32))
    shown = graph.add("InstanceNormalization", grey, *ones, epsilon=1e-5 * 255**2)

    small = graph.add("AveragePool", shown, kernel_shape=[4, 4], strides=[4, 4])
    first = graph.add("Add", graph.block("block1", shown), graph.block("skip1", small))
    third = graph.block("block3", graph.block("block2", first))
    fourth = graph.block("block4", third)
    fifth = graph.block("block5", fourth)
    pyramid = graph.add("Add", third, graph.enlarge(fourth, 2))
    features = graph.block("fusion", graph.add("Add", pyramid, graph.enlarge(fifth, 4)))

    # A softmax, of whose 65 values for a cell the last stands for "no keypoint"; ONNX Runtime's own takes longer.
    logits = graph.block("keypoints", shown)
    highest = graph.add("ReduceMax", logits, axes=[1])
    powers = graph.add("Exp", graph.add("Sub", logits, highest))
    shares = graph.add("Div", powers, graph.add("ReduceSum", powers, graph.whole_numbers(1)))
    pixels = graph.add("Slice", shares, *map(graph.whole_numbers, (0, CELL * CELL, 1)))
    heat = graph.add("DepthToSpace", pixels, blocksize=CELL)
    reliability = graph.add("Sigmoid", graph.block("reliability", features))
    descriptors = graph.add("Transpose", graph.add("LpNormalization", features, axis=1, p=2), perm=[0, 2, 3, 1])
    return graph.model(
        heat=graph.add("Squeeze", heat, graph.whole_numbers(0, 1)),
        reliability=graph.add("Squeeze", reliability, graph.whole_numbers(0, 1)),
        descriptors=graph.add("Squeeze", descriptors, graph.whole_numbers(0)),
    )


class _Graph:
    """Nodes and constants as they come; a value is known by its name."""

    def __init__(self, weights: Mapping[str, Array]) -> None:
        self._nodes: list[NodeProto] = []
        self._constants = [numpy_helper.from_array(weights[name], name) for name in tensor_shapes()]

    def constant(self, array: NDArray[Any]) -> str:
        name = f"constant {len(self._constants)}"
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def whole_numbers(self, *numbers: int) -> str:
        return self.constant(np.array(numbers, np.int64))

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"value {len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def block(self, name: str, values: str) -> str:
        for number, layer in enumerate(BLOCKS[name]):
            window = {"kernel_shape": [layer.kernel] * 2, "strides": [layer.stride] * 2, "pads": [layer.pad] * 4}
            values = self.add("Conv", values, f"{name}.{number}.weight", f"{name}.{number}.bias", **window)
            values = self.add("Relu", values) if layer.rectified else values
        return values

    def enlarge(self, values: str, times: int) -> str:
        scales = self.constant(np.array([1, 1, times, times], np.float32))
        return self.add("Resize", values, "", scales, mode="linear", coordinate_transformation_mode="half_pixel")

    def model(self, **outputs: str) -> ModelProto:
        for name, value in outputs.items():
            self._nodes.append(helper.make_node("Identity", [value], [name]))
        shown = helper.make_tensor_value_info("image", TensorProto.UINT8, ["height", "width", 3])
        made = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
        graph = helper.make_graph(self._nodes, NAME, [shown], made, self._constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
