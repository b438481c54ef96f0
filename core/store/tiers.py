"""The tiers: how a map is searched, chosen by its size or by its owner."""

from __future__ import annotations

from core.maps.records import COMPACT_FROM, TierSetting
from core.maps.status import Tier

ON_DISK_FROM = 4096
"""From this number of places on, descriptors are not held in memory, where the default encoder's take 65 KB a place."""


def tier_for(setting: TierSetting, places: int, present: Tier) -> Tier:
    """The tier that a map with this number of places should have.

    A map that shrinks changes its tier at half the number of places at which a growing one does, so that a map of about
    that size is not built again and again.

    Args:
        present: the tier that the map has.
    """
    if setting == "exact" or not places:
        return "exact"
    return "compact" if setting != "auto" or places >= _limit(COMPACT_FROM, present == "compact") else "exact"


def holds_for(setting: TierSetting, places: int, present: bool) -> bool:
    """Whether a map with this number of places should hold its descriptors in memory.

    Args:
        present: whether it does.
    """
    if setting == "exact" or not places:
        return True
    return setting == "auto" and places < _limit(ON_DISK_FROM, not present)


def _limit(places: int, is_over: bool) -> int:
    return places // 2 if is_over else places
