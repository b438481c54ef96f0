"""The map that queries are measured against has descriptors like those of an encoder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.process import descriptors, fill_map, service
from core.evaluation.timing import jpeg, sample_picture
from core.method.catalogue import EncoderCatalogue


def test_descriptors_are_made_of_parts_of_real_ones() -> None:
    encoder = EncoderCatalogue().get("region-vlad")
    words = encoder.definition.words
    made = [descriptor for descriptor, _ in descriptors(encoder, 8, pictures=3)]
    real = np.stack(made[:3]).reshape(3, words, -1)
    assert len(made) == 8
    for descriptor in made[3:]:
        parts = descriptor.reshape(words, -1)
        assert all((real[:, word] == parts[word]).all(axis=1).any() for word in range(words))
        assert not any(np.array_equal(descriptor, one) for one in made[:3])


def test_a_filled_map_is_served(tmp_path: Path) -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    fill_map(tmp_path, "full", encoder, 5)
    with service(tmp_path) as process:
        data = jpeg(sample_picture(2))
        answer = process.client.post("/v1/maps/full/query", content=data, headers={"Content-Type": "image/jpeg"})
        assert answer.json()["matches"][0]["place"]["id"] == "p00002"
        assert 0 < process.ready < 60
        assert 50 < process.peak_memory() < 5000
