from __future__ import annotations

import pytest

from core.index import Coder
from core.maps.records import COMPACT_FROM, TierSetting
from core.maps.status import Tier
from core.store import Map, Store
from core.store.tiers import ON_DISK_FROM, holds_for, tier_for
from tests.core.store.conftest import OpenStore, on_both
from tests.core.store.frames import DIMENSION, LOCAL_SHAPE, frame


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


@on_both
def test_what_a_map_takes(store: Store, lab: Map) -> None:
    assert lab.storage_status().bytes_per_place == 0 or not lab.database.shared
    lab.enrol([frame(f"p{i}") for i in range(5)])
    status = lab.storage_status()
    assert (status.precision, status.descriptors) == ("half", 5 * (2 * DIMENSION + LOCAL_SHAPE[0] * LOCAL_SHAPE[1]))
    assert status.index == 5 * Coder.of(DIMENSION).bytes_per_place
    assert status.database >= status.keypoints.bytes > 0
    whole = status.descriptors + status.index + status.database
    assert status.bytes_per_place == round((lab.database.room() or whole) / 5)


@on_both
def test_a_map_that_was_not_used_yet_says_so(open_store: OpenStore, store: Store, lab: Map) -> None:
    lab.enrol([frame("p")])
    store.close()
    again = open_store()
    status = again.find("lab").index_status()
    assert (status.state, status.tier, status.wanted, status.setting) == ("unopened", "exact", "exact", "auto")
    assert again.opened("lab") is None and again.open_maps == 0
    found = again.get("lab")
    found.open()
    assert found.index_status().state == "ready" and again.open_maps == 1
