from __future__ import annotations

from lab.evaluation.data.published import published_figures


def test_figures_of_a_protocol_come_with_their_systems() -> None:
    assert published_figures("") == []
    assert [one.system for one in published_figures("tokyo247")] == ["EigenPlaces", "CosPlace", "MixVPR", "NetVLAD"]
