"""Compact networks at eight bits with generalized-mean pooling: rivals of this project's own size.

Grainge, Milford, Bodala, Ramchurn, Ehsan: Design Space Exploration of Low-Bit Quantized Neural Networks for Visual
Place Recognition, RA-L 2024, compares such systems: a small trunk, its last map pooled by GeM (Radenović, Tolias, Chum:
Fine-tuning CNN Image Retrieval with No Human Annotation, TPAMI 2019), weights and activations of eight bits.  The
authors trained theirs on pictures of places.  The ones here have a trunk trained to classify, MobileNetV1 on ImageNet
or SqueezeNet 1.1 on Places365, and learn from the training frames only the ranges of the eight bits; so they stand for
the size and the layout, not for the authors' figures.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels, prepare
from core.networks.forward import GraphRunner
from core.networks.graph import IR_VERSION, OPSET
from lab.baselines.system import (
    About,
    Array,
    Constants,
    Description,
    InnerProducts,
    ReferenceIndex,
    Resources,
    arrays_digest,
    stack,
    system_identity,
    unit,
)

SIDE = 224
"""Of the square input, in pixels."""
EXPONENT = 3.0
SMALLEST = 1e-6
"""Activations under this count as this much, as in the authors' GeM."""
FRAMES = 200
"""How many of the training frames show the ranges of the activations."""
IMAGE, MAP = "image", "map"

_GEM: Constants = {"input": (SIDE, SIDE), "p": EXPONENT, "bits": 8}
_PAPER = (
    "Grainge, Milford, Bodala, Ramchurn, Ehsan: Design Space Exploration of Low-Bit Quantized Neural Networks for "
    "Visual Place Recognition, RA-L 2024; not the authors' trained network"
)
MOBILENET = About(
    "mobilenet-gem",
    "MobileNetV1-GeM, 8 bits",
    _PAPER,
    {"trunk": "MobileNetV1, ImageNet", "layer": "conv5_6", **_GEM},
    weights="an .npz of MobileNetV1 with its batch norm folded: conv1 and conv2_1_dw to conv5_6_sep, each /W and /b.",
)
SQUEEZENET = About(
    "squeezenet-gem",
    "SqueezeNet-GeM, 8 bits",
    _PAPER,
    {"trunk": "SqueezeNet 1.1, Places365", "layer": "fire9", **_GEM},
    weights="squeezenet_places365 as an .npz of Lasagne's arrays: conv1 and fire2 to fire9, each with its batch norm.",
)

Tensors = Mapping[str, NDArray[np.float32]]


# The trunks


@dataclass(frozen=True)
class Trunk:
    """A network of a published layout: its input, and its graph of the arrays of a file."""

    input: InputDefinition
    graph: Callable[[Tensors], ModelProto]


class _CompactGraph:
    """Nodes and constants as they come; a value is known by its name.

    Raises:
        InvalidModel: the weights lack an array, or have one of another shape.
    """

    def __init__(self, weights: Tensors) -> None:
        self._weights = weights
        self._nodes: list[NodeProto] = []
        self._constants: list[TensorProto] = []

    def array(self, name: str) -> NDArray[np.float32]:
        if name not in self._weights or not np.isfinite(self._weights[name]).all():
            raise InvalidModel(f"the weights have no finite array {name}.")
        return np.asarray(self._weights[name], np.float32)

    def add(self, operator: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        name = output or f"value {len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, list(inputs), [name], name=name, **attributes))
        return name

    def conv(
        self, values: str, name: str, weight: NDArray[np.float32], bias: NDArray[np.float32], stride: int, pad: int
    ) -> str:
        """A convolution; a weight of three sides is one filter a channel."""
        groups = 1
        if weight.ndim == 3:
            weight, groups = weight[:, None], len(weight)
        if weight.ndim != 4 or bias.shape != weight.shape[:1]:
            raise InvalidModel(f"{name} is not a convolution: {list(weight.shape)} and {list(bias.shape)}.")
        parts = [f"{name} weight", f"{name} bias"]
        self._constants += [numpy_helper.from_array(a, part) for a, part in zip((weight, bias), parts, strict=True)]
        window: dict[str, Any] = {"strides": [stride] * 2, "pads": [pad] * 4, "group": groups}
        return self.add("Conv", values, *parts, kernel_shape=list(weight.shape[2:]), **window)

    def model(self, values: str, name: str) -> ModelProto:
        self.add("Identity", values, output=MAP)
        shown = helper.make_tensor_value_info(IMAGE, TensorProto.FLOAT, [1, 3, SIDE, SIDE])
        made = helper.make_tensor_value_info(MAP, TensorProto.FLOAT, None)
        graph = helper.make_graph(self._nodes, name, [shown], [made], self._constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


MOBILENET_STRIDES = {"conv2_2_dw": 2, "conv3_2_dw": 2, "conv4_2_dw": 2, "conv5_6_dw": 2}
MOBILENET_BLOCKS = ("2_1", "2_2", "3_1", "3_2", "4_1", "4_2", "5_1", "5_2", "5_3", "5_4", "5_5", "5_6")


def mobilenet_graph(weights: Tensors) -> ModelProto:
    """MobileNetV1 down to conv5_6 (Howard et al., 2017): 1 x 3 x 224 x 224 to 1 x 1024 x 7 x 7."""
    graph = _CompactGraph(weights)

    def rectified(values: str, name: str, stride: int, pad: int) -> str:
        made = graph.conv(values, name, graph.array(f"{name}/W"), graph.array(f"{name}/b"), stride, pad)
        return graph.add("Relu", made)

    values = rectified(IMAGE, "conv1", 2, 1)
    for block in MOBILENET_BLOCKS:
        depthwise = f"conv{block}_dw"
        values = rectified(values, depthwise, MOBILENET_STRIDES.get(depthwise, 1), 1)
        values = rectified(values, f"conv{block}_sep", 1, 0)
    return graph.model(values, "mobilenet")


SLOPE = 0.55
"""Of the randomized rectifier of the published SqueezeNet when it is not trained."""


def squeezenet_graph(weights: Tensors) -> ModelProto:
    """SqueezeNet 1.1 down to fire9 (Iandola et al., 2016) with batch norm: 1 x 3 x 224 x 224 to 1 x 512 x 13 x 13.

    Lasagne convolves where others correlate, so that kernels are turned; the batch norm is folded in.
    """
    graph = _CompactGraph(weights)

    def rectified(values: str, name: str, stride: int = 1, pad: int = 0) -> str:
        beta, gamma, mean, inverse = (graph.array(f"{name}/bn_{part}") for part in ("beta", "gamma", "mean", "inv_std"))
        gain = gamma * inverse
        weight = graph.array(f"{name}/W")[:, :, ::-1, ::-1] * gain[:, None, None, None]
        bias = (graph.array(f"{name}/b") - mean) * gain + beta
        made = graph.conv(values, name, np.ascontiguousarray(weight), bias, stride, pad)
        return graph.add("LeakyRelu", made, alpha=SLOPE)

    def pooled(values: str) -> str:
        return graph.add("MaxPool", values, kernel_shape=[3, 3], strides=[2, 2])

    values = pooled(rectified(IMAGE, "conv1", 2))
    for number in range(2, 10):
        squeezed = rectified(values, f"fire{number}/squeeze1x1")
        ones, threes = (rectified(squeezed, f"fire{number}/expand{side}x{side}", pad=side // 2) for side in (1, 3))
        values = graph.add("Concat", ones, threes, axis=1)
        if number in (3, 5):
            values = pooled(values)
    return graph.model(values, "squeezenet")


TRUNKS = {
    "mobilenet-gem": Trunk(
        InputDefinition(height=SIDE, width=SIDE, mean=(103.94, 116.78, 123.68), scale=(0.017, 0.017, 0.017)),
        mobilenet_graph,
    ),
    "squeezenet-gem": Trunk(
        InputDefinition(height=SIDE, width=SIDE, mean=(104.051, 112.514, 116.676), scale=(1 / 255, 1 / 255, 1 / 255)),
        squeezenet_graph,
    ),
}


def read_arrays(path: Path) -> dict[str, NDArray[np.float32]]:
    """The arrays of an ``.npz`` by name; nothing is unpickled.

    Raises:
        InvalidModel: it cannot be read, or holds anything but plain arrays of numbers.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name], np.float32) for name in arrays.files}
    except Exception as error:  # numpy and zipfile raise many classes for a damaged file
        raise InvalidModel(f"{path.name} is not a readable .npz of plain arrays: {error}") from error


# Eight bits


def quantized(graph: ModelProto, images: Sequence[Array]) -> bytes:
    """The graph with weights and activations of eight bits, by ONNX Runtime's static quantization.

    Args:
        images: float32 [1, 3, 224, 224] each; the smallest and largest activations of them are the ranges.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.quant_utils import add_pre_process_metadata

    class Images(CalibrationDataReader):  # type: ignore[misc]
        left = iter(images)

        def get_next(self) -> dict[str, Array] | None:
            return next(({IMAGE: image} for image in self.left), None)

    add_pre_process_metadata(graph)  # nothing in it could be folded; without the mark there is a warning
    with TemporaryDirectory(prefix="placerec-") as folder:
        written = Path(folder) / "quantized.onnx"
        quantize_static(
            graph,
            written,
            Images(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            weight_type=QuantType.QInt8,
            activation_type=QuantType.QUInt8,
            reduce_range=True,  # processors without VNNI add pairs of products in 16 bits, which eight would overflow
        )
        return written.read_bytes()


# The systems


def generalized_mean(maps: Array) -> Array:
    """GeM, (1/n Σ max(x, ε)^p)^(1/p) over the n cells of each map: float32 [K, X, Y] to [K]."""
    raised = np.maximum(maps, SMALLEST) ** EXPONENT
    return np.asarray(raised.mean(axis=(1, 2)) ** (1 / EXPONENT), np.float32)


class CompactGem:
    """One vector of unit length; scores are cosines.

    Args:
        trunk: its layout.
        weights: its arrays.

    Raises:
        InvalidModel: the arrays are not those of the layout.
    """

    sequential = False

    def __init__(self, about: About, trunk: Trunk, weights: Tensors) -> None:
        self.about, self._input, self._graph = about, trunk.input, trunk.graph(weights)
        self._digests = {"weights": arrays_digest(**weights)}
        # Refuses arrays that do not fit each other.
        GraphRunner(about.name, self._graph)({IMAGE: np.zeros((1, 3, SIDE, SIDE), np.float32)})
        self._run: GraphRunner | None = None
        self.nbytes = 0
        """Bytes of the network at eight bits, once trained."""

    @property
    def identity(self) -> str:
        return system_identity(self.about, **self._digests)

    def train(self, frames: Iterable[Pixels], seed: int) -> None:
        """Learn the ranges of the activations from a random choice of the frames.

        Raises:
            InvalidModel: there is none.
        """
        generator, chosen = np.random.default_rng(seed), list[Pixels]()
        for seen, pixels in enumerate(frames):
            if len(chosen) < FRAMES:
                chosen.append(pixels)
            elif (place := int(generator.integers(seen + 1))) < FRAMES:
                chosen[place] = pixels
        if not chosen:
            raise InvalidModel(f"{self.about.name} needs a training frame.")
        network = quantized(self._graph, [self._image(pixels) for pixels in chosen])
        self._run, self.nbytes = GraphRunner(self.about.name, network), len(network)
        self._digests["network"] = hashlib.sha256(network).hexdigest()

    def _image(self, pixels: Pixels) -> Array:
        return np.ascontiguousarray(prepare(pixels, self._input).transpose(2, 0, 1)[None])

    def describe(self, pixels: Pixels) -> Description:
        if self._run is None:
            raise InvalidModel(f"{self.about.name} has no ranges yet; train it on frames first.")
        began = time.perf_counter()
        vector = unit(generalized_mean(self._run({IMAGE: self._image(pixels)})[0][0]))
        return Description({"descriptor": vector}, {"forward": 1e3 * (time.perf_counter() - began)})

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return InnerProducts(stack(references))


def build(about: About, resources: Resources) -> CompactGem:
    return CompactGem(about, TRUNKS[about.name], read_arrays(resources.file()))
