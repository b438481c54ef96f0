"""The encoders of this project as systems of the comparison."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.presets import PRESETS
from lab.baselines.encoders import PAPERS, TITLES, EncoderSystem, constants
from lab.baselines.registry import build
from lab.baselines.stages import TWO_STAGES
from lab.baselines.system import About
from tests.service.scenes import blank, scene

ABOUT = About("any", "Any", "none", {})


@pytest.fixture(scope="module")
def models() -> EncoderCatalogue:
    return EncoderCatalogue()


def test_an_encoder_system_gives_the_encoders_own_scores(models: EncoderCatalogue) -> None:
    system, encoder = build(DEFAULT_ENCODER + TWO_STAGES, models=models), models.get(DEFAULT_ENCODER)
    generator = np.random.default_rng(4)
    frames = [np.kron(generator.integers(0, 255, (6, 8, 3)), np.ones((20, 20, 1))).astype(np.uint8) for _ in range(3)]
    described = [system.describe(frame) for frame in frames]
    assert described[0].arrays["descriptor"].shape == (encoder.dimension,)
    assert set(described[0].milliseconds) == {"forward", "regions", "vlad"}
    encodings = [encoder.encode(frame) for frame in frames]
    expected = [[encoder.score(a, b) for b in encodings] for a in encodings]
    np.testing.assert_allclose(system.index(described).score(described), expected, atol=1e-6)


def test_each_packaged_encoder_has_a_title_and_a_paper() -> None:
    assert set(PAPERS) == set(TITLES) == set(PRESETS)


def test_constants_of_parts_are_named_after_their_part() -> None:
    fields = {"words": 128, "projection": None, "stage": {"layers": ("conv2",), "inner": {"q": 0.5}}}
    assert constants(fields) == {"words": 128, "stage.layers": ("conv2",), "stage.inner.q": 0.5}


@pytest.mark.parametrize("name", ["m-region-vlad", "region-vlad"])
def test_region_boxes_are_fractions_strongest_first(name: str) -> None:
    encoder = EncoderCatalogue().get(name)
    system = EncoderSystem(encoder, ABOUT)
    boxes = system.region_boxes(scene(1))
    regions = encoder.encode(scene(1)).regions
    assert len(boxes) == len(regions) > 0
    assert all(0 <= left < right <= 1 and 0 <= top < bottom <= 1 for left, top, right, bottom in boxes)
    strongest = int(regions.energies.argmax())
    grids = encoder.layer_grids()
    rows, columns = grids[encoder.definition.layers[regions.layers[strongest]]]
    top, left, bottom, right = regions.boxes[strongest]
    assert boxes[0] == pytest.approx((left / columns, top / rows, right / columns, bottom / rows))
    assert system.region_boxes(blank()) == []
