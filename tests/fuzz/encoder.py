"""The smallest possible encoder, because its work would take most of the time and is not what is fuzzed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import InputDefinition
from core.method.catalogue import NETWORK_SUFFIX
from core.method.encoder import EncoderDefinition
from core.method.features import FeatureExtractor
from core.networks.network import Convolution, NetworkDefinition, Relu, load_network, save_network
from tests.service.encoders import install

SMALL = "small"

NETWORK = NetworkDefinition(
    name=SMALL,
    input=InputDefinition(height=65, width=65, mean=(104.0, 117.0, 123.0)),
    layers=(
        Convolution(name="conv1", channels=12, kernel=5, stride=3),
        Relu(name="relu1"),
        Convolution(name="conv2", channels=12, kernel=3, stride=2, pad=1),
        Relu(name="relu2"),
    ),
)
DEFINITION = EncoderDefinition(
    layers=("conv1", "conv2"),
    regions=20,
    steps=(0.5, 0.5),
    unit_features=True,
    words=4,
    gamma=0.5,
    normalization="global",
)


def install_small_encoder(folder: Path) -> str:
    """Put a network of two small layers with random weights, and its encoder, into a models directory; its identity."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{SMALL}{NETWORK_SUFFIX}"
    save_network(file, NETWORK, _weights())
    extractor = FeatureExtractor(load_network(file, DEFINITION.outputs), DEFINITION)
    return install(folder, SMALL, extractor, DEFINITION, SMALL)


def _weights() -> dict[str, NDArray[np.float32]]:
    random = np.random.default_rng(0)
    weights = {}
    for name, shape in NETWORK.weight_shapes().items():
        drawn = random.standard_normal(shape, np.float32) / np.float32(math.sqrt(math.prod(shape[1:])))
        weights[name] = drawn if name.endswith("weight") else np.zeros(shape, np.float32)
    return weights
