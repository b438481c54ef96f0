"""The literal pipeline gives the vector that the encoder gives."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.thesis.reference_pipeline import reference_vlad
from benchmarks.thesis.thesis_pipeline import THESIS, literal, ours
from core.frames.images import decode
from core.method.catalogue import EncoderCatalogue
from core.method.vlad import aggregate
from service.commands.timing.samples import jpeg, sample_frame


def test_the_literal_vlad_is_the_compiled_one() -> None:
    generator = np.random.default_rng(0)
    features, centers = generator.random((50, 12)).astype(np.float32), generator.random((7, 12)).astype(np.float32)
    made = aggregate(features, centers, 0.5, "intra")
    np.testing.assert_allclose(reference_vlad(features, centers).reshape(-1), made, atol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("step", [2.0, 0.5])
def test_both_pipelines_give_one_vector(step: float) -> None:
    encoder = EncoderCatalogue().get(THESIS)
    data = jpeg(sample_frame(3))
    a, b = literal(encoder, data, step), ours(encoder, data, step, encoder.centers)
    assert float(a @ b) >= 0.995 * np.linalg.norm(a) * np.linalg.norm(b)


def test_at_the_packaged_step_it_is_the_encoders_own_vector() -> None:
    encoder = EncoderCatalogue().get(THESIS)
    frame = sample_frame(4)
    data = jpeg(frame)
    vector = ours(encoder, data, encoder.definition.steps[0], encoder.centers)
    np.testing.assert_allclose(vector, encoder.encode(decode(data)).descriptor, atol=1e-5)
