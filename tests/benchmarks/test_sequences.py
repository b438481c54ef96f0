"""What following a run is worth, on the real walks where they are at hand."""

from __future__ import annotations

import pytest

from benchmarks.maps.sequences import HALVED, RECALL, SHARE, costs, recalls
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from tests.service.server import ROOT

DATA = ROOT.parent / "shared" / "datasets" / "eval"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the evaluation images are not at hand")


@pytest.mark.thorough
@needs_data
def test_a_stretch_of_railway_in_another_season() -> None:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    (counts,) = recalls(encoder, "nordland_tiny", DATA, frames=500).values()
    single, learnt, given = (counts[how]["wrong"] for how in ("single", "session", "session, given the pace"))
    assert single > 0.1 * counts["queries"], "or there would be nothing to gain"
    assert given <= 0.6 * single, "the whole run is held to more below"
    assert learnt <= 0.6 * single, "one that has to learn the pace"


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
