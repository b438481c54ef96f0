"""Sample frames and descriptors are like those of a camera and of an encoder."""

from __future__ import annotations

import numpy as np

from core.frames.images import decode
from core.method.catalogue import EncoderCatalogue
from service.commands.timing.samples import jpeg, sample_descriptors, sample_frame


def test_a_frame_is_that_of_a_camera() -> None:
    data = jpeg(sample_frame())
    assert data == jpeg(sample_frame())
    assert decode(data).shape == (480, 640, 3)
    assert 30_000 < len(data) < 300_000


def test_descriptors_are_made_of_parts_of_real_ones() -> None:
    encoder = EncoderCatalogue().get("region-vlad")
    words = encoder.definition.words
    made = [descriptor for descriptor, _ in sample_descriptors(encoder, 8, frames=3)]
    real = np.stack(made[:3]).reshape(3, words, -1)
    assert len(made) == 8
    for descriptor in made[3:]:
        parts = descriptor.reshape(words, -1)
        assert all((real[:, word] == parts[word]).all(axis=1).any() for word in range(words))
        assert not any(np.array_equal(descriptor, one) for one in made[:3])
