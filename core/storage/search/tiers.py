"""The tiers: how a map is searched, chosen by its size or by its owner, and the status about it."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from core.maps.records import COMPACT_FROM, Precision, TierSetting
from core.maps.status import IndexStatus, KeypointsStatus, StorageStatus, Tier

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


def unopened(setting: TierSetting, places: int) -> IndexStatus:
    """The status of a map that was not read from disk yet."""
    tier = tier_for(setting, places, "exact")
    return IndexStatus(
        setting=setting,
        tier=tier,
        wanted=tier,
        state="unopened",
        progress=0,
        rows_indexed=0,
        recall=None,
        bytes_in_memory=0,
    )


def storage_of(folder: Path, precision: Precision, places: int, keypoints: KeypointsStatus | None) -> StorageStatus:
    """How much room the files of a map take; a file that is deleted meanwhile counts as empty.

    Args:
        keypoints: which of the map's places have keypoints; None: not known.

    Raises:
        OSError: the disk refuses.
    """
    sizes = {".seg": 0, ".index": 0, "": 0}
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):
            kind = Path(entry.name).suffix
            sizes[kind if kind in sizes else ""] += entry.stat().st_size
    return StorageStatus(
        precision=precision,
        bytes_per_place=round(sum(sizes.values()) / places) if places else 0,
        descriptors=sizes[".seg"],
        index=sizes[".index"],
        database=sizes[""],
        keypoints=keypoints,
    )
