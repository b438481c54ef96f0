"""The smallest encoder that is one: what is fuzzed are the ways to it, and its own work would take most of the time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from core.encoder import Encoder, EncoderDefinition
from core.encoders import NETWORK_SUFFIX, save_encoder
from core.features import FeatureExtractor
from core.network import Convolution, NetworkDefinition, Relu, load_network, save_network
from core.preprocessing import InputDefinition
from core.verdict import Calibration
from core.vocabulary import train_vocabulary
from tests.service.scenes import scene

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
CALIBRATION = Calibration(
    source="encoder-default", threshold=1.0, margin=0.01, background_mean=0.3, background_deviation=0.1
)


def install_small_encoder(folder: Path) -> str:
    """Put a network of two small layers with random weights, and its encoder, into a models directory; its identity."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{SMALL}{NETWORK_SUFFIX}"
    save_network(file, NETWORK, _weights())
    extractor = FeatureExtractor(load_network(file, DEFINITION.outputs), DEFINITION)
    features = [extractor.regions(extractor.activations([scene(seed)])[0]).features for seed in range(6)]
    vocabulary = train_vocabulary(np.concatenate(features), DEFINITION.words, 0, extractor.origin)
    encoder = Encoder(SMALL, extractor, DEFINITION, vocabulary, CALIBRATION)
    save_encoder(folder, encoder, vocabulary, SMALL, {"images": 6})
    return encoder.identity


def _weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights, channels = {}, 3
    for layer in NETWORK.convolutions():
        shape = (layer.channels, channels, layer.kernel, layer.kernel)
        weights[f"{layer.name}.weight"] = torch.randn(shape, generator=generator) / math.sqrt(math.prod(shape[1:]))
        weights[f"{layer.name}.bias"] = torch.zeros(layer.channels)
        channels = layer.channels
    return weights
