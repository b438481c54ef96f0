"""The tiers: how a map is searched, chosen by its size or by its owner, and what it reports about this."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from core.maps.records import COMPACT_FROM, Precision, TierSetting

Tier = Literal["exact", "compact"]

ON_DISK_FROM = 4096
"""From so many places on descriptors are not held in memory, where the default encoder's take 65 KB a place."""


def tier_for(setting: TierSetting, places: int, present: Tier) -> Tier:
    """The tier that a map of so many places should have.

    A map that shrinks changes its tier at half the number of places at which a growing one does, so that a map of about
    that size is not built again and again.

    Args:
        present: the tier that the map has.
    """
    if setting == "exact" or not places:
        return "exact"
    return "compact" if setting != "auto" or places >= _limit(COMPACT_FROM, present == "compact") else "exact"


def holds_for(setting: TierSetting, places: int, present: bool) -> bool:
    """Whether a map of so many places should hold its descriptors in memory.

    Args:
        present: whether it does.
    """
    if setting == "exact" or not places:
        return True
    return setting == "auto" and places < _limit(ON_DISK_FROM, not present)


def _limit(places: int, is_over: bool) -> int:
    return places // 2 if is_over else places


class Recall(BaseModel):
    """How often the place that an exact search finds first is found first by way of the codes."""

    model_config = ConfigDict(frozen=True)

    at_1: float = Field(ge=0, le=1, description="Share of the queries for which it is.")
    queries: int = Field(
        ge=1,
        description="Stored places looked for by descriptors of which a third is theirs and the rest another place's.",
    )
    shortlist: int = Field(ge=1, description="Places that the codes choose and that are then compared exactly.")
    places: int = Field(ge=1, description="Places that the map had when this was measured.")


class IndexStatus(BaseModel):
    """How a map is searched now, and how it will be."""

    model_config = ConfigDict(frozen=True)

    setting: TierSetting = Field(description="What its owner chose.")
    tier: Tier = Field(description="exact: every place compared; compact: codes first.")
    wanted: Tier = Field(description="The tier that the map's settings and size ask for.")
    state: Literal["ready", "building", "unopened"] = Field(
        description="Searches are answered in all; unopened: not used since the start, read from disk at its next use."
    )
    progress: float = Field(ge=0, le=1, description="Of what is being built; 1 when ready.")
    rows_indexed: int = Field(ge=0, description="Rows with a code; the others are compared exactly.")
    recall: Recall | None = Field(description="Against exact search; null in the tier exact and until it is measured.")
    bytes_in_memory: int = Field(ge=0, description="Descriptors that are held, codes, and where the places are.")
    problem: str | None = Field(
        default=None, description="Why the last attempt to build came to no end; it is tried again with the next write."
    )


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


class KeypointsStatus(BaseModel):
    """The keypoints that a map keeps."""

    model_config = ConfigDict(frozen=True)

    places: int = Field(ge=0, description="How many places have keypoints.")
    bytes: int = Field(ge=0, description="What they take in map.sqlite.")


class StorageStatus(BaseModel):
    """What a map takes on disk."""

    model_config = ConfigDict(frozen=True)

    precision: str = Field(description="How descriptors are kept.")
    bytes_per_place: int = Field(ge=0, description="All files of the map, a place; 0 for an empty map.")
    descriptors: int = Field(ge=0, description="Bytes of the segment files, rows of forgotten places included.")
    index: int = Field(ge=0, description="Bytes of codes, which can be made again.")
    database: int = Field(ge=0, description="Bytes of map.sqlite and its log: places, metadata, pictures, keypoints.")
    keypoints: KeypointsStatus | None = Field(
        description="Of how many places keypoints are kept; null until the map is first used after a start."
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
