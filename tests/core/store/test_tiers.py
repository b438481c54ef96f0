from __future__ import annotations

from pathlib import Path

import pytest

from core.maps.records import COMPACT_FROM, TierSetting
from core.maps.status import Tier
from core.store import Directory, Map
from core.store.tiers import ON_DISK_FROM, holds_for, tier_for
from tests.core.store.frames import ENCODER, frame


@pytest.mark.parametrize(
    ("setting", "places", "present", "wanted"),
    [
        ("auto", 0, "exact", "exact"),
        ("auto", COMPACT_FROM - 1, "exact", "exact"),
        ("auto", COMPACT_FROM, "exact", "compact"),
        ("auto", COMPACT_FROM // 2, "compact", "compact"),
        ("auto", COMPACT_FROM // 2 - 1, "compact", "exact"),
        ("auto", 10**7, "exact", "compact"),
        ("compact", 1, "exact", "compact"),
        ("compact", 0, "compact", "exact"),
        ("exact", 10**7, "compact", "exact"),
    ],
)
def test_the_tier_follows_setting_and_size(setting: TierSetting, places: int, present: Tier, wanted: Tier) -> None:
    assert tier_for(setting, places, present) == wanted


@pytest.mark.parametrize(
    ("setting", "places", "present", "wanted"),
    [
        ("auto", 0, False, True),
        ("auto", ON_DISK_FROM - 1, True, True),
        ("auto", ON_DISK_FROM, True, False),
        ("auto", ON_DISK_FROM // 2, False, False),
        ("auto", ON_DISK_FROM // 2 - 1, False, True),
        ("exact", 10**7, False, True),
        ("compact", 5, True, False),
        ("compact", 0, False, True),
    ],
)
def test_what_is_in_memory_follows_setting_and_size(
    setting: TierSetting, places: int, present: bool, wanted: bool
) -> None:
    assert holds_for(setting, places, present) == wanted


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


def test_a_map_that_was_not_used_yet_says_so(store: Directory, directory: Path) -> None:
    store.create("big", ENCODER, 16, local_shape=(0, 0)).enrol([frame("p", local_shape=(0, 0))])
    store.close()
    again = Directory(directory)
    status = again.find("big").index_status()
    assert (status.state, status.tier, status.wanted, status.setting) == ("unopened", "exact", "exact", "auto")
    assert again.get("big").index_status().state == "ready"
    again.close()
