"""A service process on a filled map."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.process import service
from core.method.catalogue import EncoderCatalogue
from service.commands.timing.samples import fill_map, jpeg, sample_frame


@pytest.mark.thorough
def test_a_filled_map_is_served(tmp_path: Path) -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    fill_map(tmp_path, "full", encoder, 5)
    with service(tmp_path) as process:
        data = jpeg(sample_frame(2))
        answer = process.client.post("/v1/maps/full/query", content=data, headers={"Content-Type": "image/jpeg"})
        assert answer.json()["matches"][0]["place"]["id"] == "p00002"
        assert 0 < process.ready < 60
        assert 50 < process.peak_memory() < 5000
