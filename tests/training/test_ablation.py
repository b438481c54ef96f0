"""What the ablation compares besides the definitions of encoders."""

from __future__ import annotations

import numpy as np

from core.method.agreement import local_descriptors
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import canary_frame
from core.method.presets import PRESETS
from core.method.vocabulary import Vocabulary
from training.ablation import CENTERED, FLOOR, StandardizedEncoder, standardized
from training.default_calibration import UNCALIBRATED


def test_standardized_cells_by_hand() -> None:
    cells = np.array([[1, 0], [0, 0], [0.6, 0.8]], np.float32)
    mean, deviation = np.array([0.8, 0.4]), np.array([0.2, 0.4])
    wanted = (cells[[0, 2]] - CENTERED * mean) / (deviation + FLOOR * 0.3)
    found = standardized(cells)
    np.testing.assert_allclose(found[[0, 2]], wanted / np.linalg.norm(wanted, axis=1, keepdims=True), atol=1e-6)
    assert not found[1].any() and not standardized(np.zeros((3, 2), np.float32)).any()


def test_its_encoder_differs_from_the_packaged_one_in_its_cells_alone() -> None:
    packaged = EncoderCatalogue().get(DEFAULT_ENCODER)
    vocabulary = Vocabulary(packaged.centers, packaged.extractor.origin)
    definition = PRESETS[DEFAULT_ENCODER]
    other = StandardizedEncoder("trial", packaged.extractor, definition, vocabulary, UNCALIBRATED)
    plain, made = packaged.encode(canary_frame()), other.encode(canary_frame())
    np.testing.assert_array_equal(made.descriptor, plain.descriptor)
    stage = definition.agreement
    assert stage is not None and made.local.shape == plain.local.shape
    activations = packaged.extractor.activations([canary_frame()])[0]
    products = packaged.extractor.products(activations)
    cells = packaged.extractor.projected_cells(activations, products, stage.layers, stage.values)
    wanted = local_descriptors([standardized(layer) for layer in cells], stage)
    np.testing.assert_allclose(made.local, wanted, atol=1)
    assert not np.array_equal(made.local, plain.local)
