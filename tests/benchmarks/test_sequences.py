"""What following a run is worth, on the real walks where they are at hand."""

from __future__ import annotations

import pytest

from benchmarks.maps.sequences import HALVED, RECALL, SHARE, costs, recalls
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from tests.service.server import ROOT

DATA = ROOT.parent / "shared" / "datasets" / "eval"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the evaluation images are not at hand")


@needs_data
@pytest.mark.soak
@pytest.mark.timeout(1500)
def test_the_bars() -> None:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    walk = recalls(encoder, "lip6_outdoor", DATA)["put right"]
    assert walk["session"]["wrong"] <= HALVED * walk["single"]["wrong"]
    (railway,) = recalls(encoder, "nordland_tiny", DATA).values()
    assert 1 - railway["session"]["wrong"] / railway["queries"] >= RECALL


@pytest.mark.benchmark
def test_a_frames_belief_is_cheap() -> None:
    times = costs(EncoderCatalogue().get(DEFAULT_ENCODER), 5000, 40)
    for name in ("sequence", "speed limit", "odometry"):
        assert times[name] <= SHARE * times["encode"], name
