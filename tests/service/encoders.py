"""Encoders made for the tests: one with few regions, few words, another normalization, and one with a second stage."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from core.judgement.verdict import Calibration
from core.method.agreement import AgreementDefinition
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue, save_encoder
from core.method.encoder import Encoder, EncoderDefinition
from core.method.equations import unit_length
from core.method.features import FeatureExtractor
from core.method.projection import Projection, fit_projection
from core.method.vocabulary import train_vocabulary
from core.networks.network import ShallowNetwork, load_network
from tests.service.scenes import scene, seen_again

COARSE = "coarse"
TWO_STAGES = "two-stages"

LAYERS = ("conv3", "conv4")
COARSE_DEFINITION = EncoderDefinition(
    layers=LAYERS,
    regions=50,
    steps=(0.5, 0.5),
    unit_features=True,
    words=8,
    gamma=0.5,
    normalization="global",
)
SECOND_STAGE = AgreementDefinition(
    layers=("pool2", "conv4"), values=8, weights=(0.5, 0.5), reach=(1, 1), candidates=3, share=0.6
)


def install_coarse_encoder(folder: Path) -> str:
    """Put the coarse encoder into a models directory; returns its identity."""
    return _copy(_coarse_encoder, folder)


def install_two_stage_encoder(folder: Path) -> str:
    """Put the coarse encoder with a second stage, which examines three places, into a models directory."""
    return _copy(_two_stage_encoder, folder)


def _copy(make: Callable[[], tuple[tempfile.TemporaryDirectory[str], str]], folder: Path) -> str:
    made, identity = make()
    shutil.copytree(made.name, folder, dirs_exist_ok=True)
    return identity


@cache
def _coarse_encoder() -> tuple[tempfile.TemporaryDirectory[str], str]:
    """A models directory with the encoder, made once for all tests, and the encoder's identity."""
    folder = tempfile.TemporaryDirectory()
    extractor = FeatureExtractor(_packaged_backbone(LAYERS), COARSE_DEFINITION)
    return folder, install(Path(folder.name), COARSE, extractor, COARSE_DEFINITION, _packaged_network())


@cache
def _two_stage_encoder() -> tuple[tempfile.TemporaryDirectory[str], str]:
    folder = tempfile.TemporaryDirectory()
    definition = COARSE_DEFINITION.model_copy(update={"agreement": SECOND_STAGE})
    extractor = FeatureExtractor(_packaged_backbone(definition.outputs), definition, _projections())
    return folder, install(Path(folder.name), TWO_STAGES, extractor, definition, _packaged_network())


def _packaged_network() -> str:
    (network,) = (summary.network for summary in EncoderCatalogue().describe() if summary.name == DEFAULT_ENCODER)
    return network


def _packaged_backbone(layers: tuple[str, ...]) -> ShallowNetwork:
    return load_network(EncoderCatalogue().network_file(_packaged_network()), layers)


def _projections() -> dict[str, Projection]:
    """For the second stage, fitted on scenes and the same scenes seen again."""
    layers = SECOND_STAGE.layers
    extractor = FeatureExtractor(_packaged_backbone(layers), COARSE_DEFINITION.model_copy(update={"layers": layers}))
    clear = extractor.activations([scene(seed) for seed in range(6)])
    again = extractor.activations([seen_again(scene(seed), seed) for seed in range(6)])
    projections = {}
    for index, layer in enumerate(layers):
        a, b = (
            unit_length(np.concatenate([maps[index].reshape(-1, maps[index].shape[2]) for maps in frames]))
            for frames in (clear, again)
        )
        projections[layer] = fit_projection(a, b, SECOND_STAGE.values)
    return projections


def install(folder: Path, name: str, extractor: FeatureExtractor, definition: EncoderDefinition, network: str) -> str:
    """Put an encoder with words of six scenes into a models directory; its identity."""
    folder.mkdir(parents=True, exist_ok=True)
    features = [extractor.regions(extractor.activations([scene(seed)])[0]).features for seed in range(6)]
    vocabulary = train_vocabulary(np.concatenate(features), definition.words, 0, extractor.origin)
    calibration = Calibration(
        source="encoder-default", threshold=1.0, margin=0.01, background_mean=0.3, background_deviation=0.1
    )
    encoder = Encoder(name, extractor, definition, vocabulary, calibration)
    save_encoder(folder, encoder, vocabulary, network, {"images": 6})
    return encoder.identity
