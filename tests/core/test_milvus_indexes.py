"""What a Milvus is asked to make of descriptors, by its version.  tests/core/milvus asks a real one."""

from __future__ import annotations

import pytest
from core.milvus.indexes import indexing_for, search_settings


@pytest.mark.parametrize(
    ("version", "half", "index"),
    [
        ("2.3.5-lite", False, "FLAT"),
        ("v2.4.0", True, "HNSW"),
        ("v2.5.12", True, "HNSW"),
        ("2.6.4", True, "IVF_RABITQ"),
        ("v2.10.1-dev", True, "IVF_RABITQ"),
        ("v3.0", True, "IVF_RABITQ"),
        ("milvus_lite-3.2.2", False, "FLAT"),
        ("", False, "FLAT"),
    ],
)
def test_the_index_is_chosen_by_the_version_of_the_server(version: str, half: bool, index: str) -> None:
    chosen = indexing_for(version)
    assert (chosen.half, chosen.index["index_type"], chosen.index["metric_type"]) == (half, index, "IP")


@pytest.mark.parametrize("limit", [1, 135, 16_384])
def test_no_index_looks_at_fewer_than_are_wanted(limit: int) -> None:
    assert search_settings("HNSW", limit)["params"]["ef"] >= limit
    assert search_settings("IVF_RABITQ", limit)["params"]["refine_k"] >= 1
    assert search_settings("FLAT", limit) == {"metric_type": "IP", "params": {}}


def test_all_lists_are_searched_for_a_whole_map() -> None:
    lists = indexing_for("2.6.0").index["params"]["nlist"]
    assert search_settings("IVF_RABITQ", 16_384)["params"]["nprobe"] == lists
