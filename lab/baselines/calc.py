"""CALC: a small network taught to see in a distorted frame the histograms of gradients of the undistorted one.

Merrill, Huang: Lightweight Unsupervised Deep Loop Closure, RSS 2018.  Of the trained auto-encoder the part up to
the third convolution describes a frame: 4 x 14 x 19 = 1064 values.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.networks.network import Convolution, Layer, Normalization, Pooling, Relu
from core.networks.torch_network import build_layer
from lab.baselines.system import About, Array, Constants, Resources, VectorSystem, unit
from lab.conversion.caffemodel import CaffeLayer, read_caffemodel

HEIGHT, WIDTH = 120, 160

LAYERS: tuple[Layer, ...] = (
    Convolution(name="conv1", channels=64, kernel=5, stride=2, pad=4),
    Relu(name="relu1"),
    Pooling(name="pool1", kernel=3, stride=2),
    Normalization(name="norm1"),
    Convolution(name="conv2", channels=128, kernel=4, pad=2),
    Relu(name="relu2"),
    Pooling(name="pool2", kernel=3, stride=2),
    Normalization(name="norm2"),
    Convolution(name="conv3", channels=4, kernel=3),
    Relu(name="relu3"),
)

CONSTANTS: Constants = {"input": (HEIGHT, WIDTH), "grey": True, "equalized": True, "values": 1064}
ABOUT = About(
    "calc",
    "CALC",
    "Merrill, Huang: Lightweight Unsupervised Deep Loop Closure, RSS 2018",
    CONSTANTS,
    weights="the authors' calc.caffemodel, published with their code (rpng/calc).",
)


def grey_input(pixels: Pixels) -> Array:
    """The network's input as the authors prepare it: brightness equalized, grey, 120 x 160, from 0 to 1.

    Args:
        pixels: H x W x 3 uint8, BGR.
    """
    colour = cv2.cvtColor(pixels, cv2.COLOR_BGR2YUV)
    colour[:, :, 0] = cv2.equalizeHist(colour[:, :, 0])
    grey = cv2.cvtColor(cv2.cvtColor(colour, cv2.COLOR_YUV2BGR), cv2.COLOR_BGR2GRAY)
    small = cv2.resize(grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.asarray(small / np.float32(255), np.float32)


def load_calc(path: Path) -> nn.Sequential:
    """The network of a ``.caffemodel`` that has the paper's convolutions conv1, conv2 and conv3.

    Raises:
        InvalidModel: the file cannot be read, or a convolution is missing or of another shape.
    """
    layers = {layer.name: layer for layer in read_caffemodel(path).layers}
    network = nn.Sequential()
    channels = 1
    for layer in LAYERS:
        module = build_layer(layer, channels)
        if isinstance(layer, Convolution):
            assert isinstance(module, nn.Conv2d)
            channels = layer.channels
            _fill(module, layers.get(layer.name), f"{path.name}: {layer.name}")
        network.add_module(layer.name, module)
    return network.eval().requires_grad_(False)


def _fill(module: nn.Conv2d, source: CaffeLayer | None, what: str) -> None:
    arrays = source.arrays() if source is not None and source.type == "Convolution" else []
    targets: list[Tensor] = [module.weight, *([] if module.bias is None else [module.bias])]
    wanted = [tuple(target.shape) for target in targets]
    # The oldest files write all arrays with four dimensions.
    if len(arrays) != len(wanted) or arrays[0].shape != wanted[0] or arrays[1].size != wanted[1][0]:
        shapes = [array.shape for array in arrays] or "none"
        raise InvalidModel(f"{what} has arrays of the shapes {shapes}; CALC's are {wanted}.")
    with torch.no_grad():
        for target, array in zip(targets, arrays, strict=True):
            target.copy_(torch.from_numpy(array.reshape(target.shape)))


class Calc(VectorSystem):
    """One vector a frame, of unit length; scores are cosines."""

    def __init__(self, about: About, network: nn.Sequential) -> None:
        from core.networks.torch_network import tensors_digest

        super().__init__(about, weights=tensors_digest(network.state_dict()))
        self.network = network

    @torch.inference_mode()
    def vector(self, pixels: Pixels) -> Array:
        maps: Tensor = self.network(torch.from_numpy(grey_input(pixels))[None, None])
        return unit(maps.reshape(-1).numpy())


def build(about: About, resources: Resources) -> Calc:
    return Calc(about, load_calc(resources.file()))
