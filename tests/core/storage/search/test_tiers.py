from __future__ import annotations

from pathlib import Path

import pytest

from core.storage import Atlas, Map
from core.storage.search.tiers import COMPACT_FROM, INVERTED_FROM, Tier, TierSetting, tier_for
from tests.core.storage.frames import ENCODER, frame


@pytest.mark.parametrize(
    ("setting", "places", "present", "wanted"),
    [
        ("auto", 0, "exact", "exact"),
        ("auto", COMPACT_FROM - 1, "exact", "exact"),
        ("auto", COMPACT_FROM, "exact", "compact"),
        ("auto", COMPACT_FROM // 2, "compact", "compact"),
        ("auto", COMPACT_FROM // 2 - 1, "compact", "exact"),
        ("auto", INVERTED_FROM - 1, "compact", "compact"),
        ("auto", INVERTED_FROM, "exact", "inverted"),
        ("auto", INVERTED_FROM // 2, "inverted", "inverted"),
        ("auto", INVERTED_FROM // 2 - 1, "inverted", "compact"),
        ("auto", 10, "inverted", "exact"),
        ("compact", 1, "exact", "compact"),
        ("compact", 0, "compact", "exact"),
        ("inverted", 5, "exact", "inverted"),
        ("exact", 10**7, "inverted", "exact"),
    ],
)
def test_the_tier_follows_setting_and_size(setting: TierSetting, places: int, present: Tier, wanted: Tier) -> None:
    assert tier_for(setting, places, present) == wanted


def test_what_a_map_takes_on_disk(lab: Map, directory: Path) -> None:
    assert lab.storage_status().bytes_per_place == 0
    lab.enrol([frame(f"p{i}") for i in range(5)])
    status = lab.storage_status()
    files = {path.name: path.stat().st_size for path in (directory / "maps" / "lab").iterdir()}
    assert status.precision == "half"
    assert status.descriptors == sum(size for name, size in files.items() if name.endswith(".seg"))
    assert status.database == sum(size for name, size in files.items() if name.startswith("map.sqlite"))
    assert status.index == 0
    assert status.bytes_per_place == round(sum(files.values()) / 5)


def test_a_map_that_was_not_used_yet_says_so(atlas: Atlas, directory: Path) -> None:
    atlas.create("big", ENCODER, 16, local_shape=(0, 0)).enrol([frame("p", local_shape=(0, 0))])
    atlas.close()
    again = Atlas(directory)
    status = again.find("big").index_status()
    assert (status.state, status.tier, status.wanted, status.setting) == ("unopened", "exact", "exact", "auto")
    assert again.get("big").index_status().state == "ready"
    again.close()
