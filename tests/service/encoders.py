"""A second encoder, made for the tests: few regions, few words, another normalization."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from core.encoder import Encoder, EncoderDefinition, FeatureExtractor
from core.encoders import DEFAULT_ENCODER, EncoderCatalogue, save_encoder
from core.network import load_network
from core.verdict import Calibration
from core.vocabulary import train_vocabulary
from tests.service.scenes import scene

COARSE = "coarse"


def install_coarse_encoder(folder: Path) -> str:
    """Put the encoder into a models directory; returns its identity."""
    folder.mkdir(parents=True, exist_ok=True)
    catalogue = EncoderCatalogue()
    (network,) = (summary.network for summary in catalogue.describe() if summary.name == DEFAULT_ENCODER)
    layers = ("conv3", "conv4")
    backbone = load_network(catalogue.network_file(network), layers)
    definition = EncoderDefinition(
        layers=layers,
        regions=50,
        steps=(0.5, 0.5),
        unit_features=True,
        words=8,
        gamma=0.5,
        normalization="global",
    )
    extractor = FeatureExtractor(backbone, definition)
    features = [extractor.regions(extractor.activations([scene(seed)])[0]).features for seed in range(6)]
    vocabulary = train_vocabulary(np.concatenate(features), 8, 0, extractor.origin)
    calibration = Calibration(
        source="encoder-default", threshold=1.0, margin=0.01, background_mean=0.3, background_deviation=0.1
    )
    encoder = Encoder(COARSE, extractor, definition, vocabulary, calibration)
    save_encoder(folder, encoder, vocabulary, network, {"images": 6})
    return encoder.identity
