from __future__ import annotations

from pathlib import Path

import pytest

from core.evaluation.region_overlays import region_finder
from core.frames.images import decode
from core.method.catalogue import EncoderCatalogue
from tests.service.scenes import blank, encoded, scene


@pytest.mark.parametrize("name", ["m-region-vlad", "region-vlad"])
def test_boxes_are_fractions_strongest_first(tmp_path: Path, name: str) -> None:
    encoder = EncoderCatalogue().get(name)
    path, black = tmp_path / "a.png", tmp_path / "b.png"
    path.write_bytes(encoded(scene(1), ".png"))
    black.write_bytes(encoded(blank(), ".png"))
    find = region_finder(encoder, lambda path: decode(path.read_bytes()))

    boxes = find(path)
    regions = encoder.encode(scene(1)).regions
    assert len(boxes) == len(regions) > 0
    assert all(0 <= left < right <= 1 and 0 <= top < bottom <= 1 for left, top, right, bottom in boxes)
    strongest = int(regions.energies.argmax())
    grids = encoder.layer_grids()
    rows, columns = grids[encoder.definition.layers[regions.layers[strongest]]]
    top, left, bottom, right = regions.boxes[strongest]
    assert boxes[0] == pytest.approx((left / columns, top / rows, right / columns, bottom / rows))
    assert find(black) == []
