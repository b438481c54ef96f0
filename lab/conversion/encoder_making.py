"""Encoders of networks that others trained, made of pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.method.agreement import AgreementDefinition
from core.method.encoder import Encoder, EncoderDefinition, canary_frame
from core.method.equations import unit_length
from core.method.features import FeatureExtractor
from core.method.projection import Projection, fit_projection
from core.method.vlad import aggregate
from core.method.vocabulary import Vocabulary, pool_features, train_vocabulary
from core.method.whitening import fit_whitening
from core.networks.description import NetworkDescription
from core.networks.onnx_network import OUTPUT, OnnxNetwork
from core.recognition.encoder_calibration import UNMEASURED

MOST_CELLS = 10_000
FRAMES_OF_PROJECTION = 200
CELLS_OF_PROJECTION = 50
"""The number of pictures, and of cells of each, from which the projection of a second stage is learned."""


def encoder_definition(description: NetworkDescription) -> EncoderDefinition:
    """The metadata in the description of the encoder.

    A global descriptor is a feature of the whole frame, and one word of zeros leaves it as it is.
    """
    made, stage = description.aggregation, description.second_stage
    pooled = made.method in ("none", "gem")
    return EncoderDefinition(
        layers=(OUTPUT,),
        regions=made.regions if made.method == "regions" else MOST_CELLS,
        steps=(made.step,) if made.method == "regions" else (),
        unit_features=pooled or made.unit_features,
        parts={"none": "cells", "gem": "pooled", "vlad": "cells", "regions": None}[made.method],
        exponent=made.exponent if made.method == "gem" else None,
        words=1 if pooled else made.words,
        gamma=1.0 if pooled else made.gamma,
        normalization="global" if pooled else made.normalization,
        whitening=made.whitening,
        agreement=None
        if stage is None
        else AgreementDefinition(layers=(OUTPUT,), weights=(1.0,), **stage.model_dump()),
    )


def make_encoder(
    name: str, network: OnnxNetwork, frames: Callable[[], Iterable[Pixels]], seed: int
) -> tuple[Encoder, Vocabulary]:
    """An encoder of a network, not calibrated; its vocabulary, whitening and projection are fitted to frames.

    Args:
        frames: gives them anew at each call; it is not called if nothing is learned of them.

    Raises:
        InvalidModel: there are too few frames, or the network sees nothing in them.
    """
    definition = encoder_definition(network.description)
    projections = {}
    if definition.agreement is not None:
        projections[OUTPUT] = _fit_cells(network, definition, frames(), seed)
    extractor = FeatureExtractor(network, definition, projections)
    if network.description.aggregation.method in ("none", "gem"):
        length = extractor.activations([canary_frame()])[0][0].shape[-1]
        vocabulary = Vocabulary(np.zeros((1, length), np.float32), extractor.origin)
    else:
        features = pool_features((_features(extractor, frame) for frame in frames()), seed)
        vocabulary = train_vocabulary(features, definition.words, seed, extractor.origin)
    whitening = None
    if definition.whitening is not None:
        whole = [
            aggregate(features, vocabulary.centers, definition.gamma, definition.normalization)
            for features in (_features(extractor, frame) for frame in frames())
            if len(features)
        ]
        if not whole:
            raise InvalidModel("the network sees nothing in the frames.")
        whitening = fit_whitening(np.stack(whole), definition.whitening)
    return Encoder(name, extractor, definition, vocabulary, UNMEASURED, whitening=whitening), vocabulary


def _features(extractor: FeatureExtractor, frame: Pixels) -> NDArray[np.float32]:
    return extractor.regions(extractor.activations([frame])[0]).features


def _fit_cells(network: OnnxNetwork, definition: EncoderDefinition, frames: Iterable[Pixels], seed: int) -> Projection:
    """The projection of the second stage's cells: from pairs of one cell as it is, and in another light."""
    assert definition.agreement is not None
    chance = np.random.default_rng(seed)
    extractor = FeatureExtractor(network, definition.model_copy(update={"agreement": None}))
    clear, changed = [], []
    for _, frame in zip(range(FRAMES_OF_PROJECTION), frames, strict=False):
        a, b = (maps[0].reshape(-1, maps[0].shape[-1]) for maps in extractor.activations([frame, other_light(frame)]))
        seen = np.flatnonzero(a.any(axis=1) & b.any(axis=1))
        seen = chance.permutation(seen)[:CELLS_OF_PROJECTION]
        clear.append(unit_length(a[seen]))
        changed.append(unit_length(b[seen]))
    pairs = [np.concatenate(side) if side else np.zeros((0, 0), np.float32) for side in (clear, changed)]
    try:
        return fit_projection(pairs[0], pairs[1], definition.agreement.values)
    except ValueError as error:
        raise InvalidModel(f"the second stage cannot be made of these frames: {error}.") from error


def other_light(pixels: Pixels) -> Pixels:
    """The same view, darker, with less contrast and less sharp: uint8 [H, W, 3]."""
    darker = cv2.convertScaleAbs(pixels, alpha=0.6, beta=12)
    return np.asarray(cv2.GaussianBlur(darker, (5, 5), 0), np.uint8)
