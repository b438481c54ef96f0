from __future__ import annotations

from lab.evaluation.data.presets import DATASETS
from lab.evaluation.data.published import PUBLISHED, RECALLS, published_figures


def test_every_figure_has_a_protocol_a_source_and_its_order() -> None:
    assert {one.protocol for one in PUBLISHED} <= {dataset.name for dataset in DATASETS}
    for one in PUBLISHED:
        assert 1 <= len(one.recall_at) <= len(RECALLS) and list(one.recall_at) == sorted(one.recall_at)
        assert 0 < one.recall_at[0] <= one.recall_at[-1] <= 1
        assert str(one.year) in one.source and one.system
    assert published_figures("") == []
    assert [one.system for one in published_figures("tokyo247")] == ["EigenPlaces", "CosPlace", "MixVPR", "NetVLAD"]
