"""The status of a map: how it is searched, and its size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from core.maps.records import TierSetting

Tier = Literal["exact", "compact"]

Progress = Callable[[int, int], None]
"""Called with the number of rows done and of all; its exceptions end the work."""


def no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


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

    setting: TierSetting = Field(description="The setting that its owner chose.")
    tier: Tier = Field(description="exact: every place compared; compact: codes first.")
    wanted: Tier = Field(description="The tier that the map's settings and size ask for.")
    state: Literal["ready", "unopened"] = Field(
        description="Searches are answered in both; unopened: not in memory, and read at its next use."
    )
    rows_indexed: int = Field(ge=0, description="Rows with a code; the others are compared exactly.")
    recall: Recall | None = Field(
        description="Against exact search, measured when the index is rebuilt; null before that, and in the tier exact."
    )
    bytes_in_memory: int = Field(ge=0, description="Descriptors that are held, codes, and where the places are.")


class ErasureReport(BaseModel):
    """The leftovers of deleted places, and of former frames, that were erased."""

    model_config = ConfigDict(frozen=True)

    rows: int = Field(ge=0, description="Frames of which descriptors, pictures and keypoints were still stored.")
    bytes: int = Field(ge=0, description="Bytes by which the map's file became smaller; 0 in PostgreSQL.")


class KeypointsStatus(BaseModel):
    """The keypoints that a map keeps."""

    model_config = ConfigDict(frozen=True)

    places: int = Field(ge=0, description="How many places have keypoints.")
    bytes: int = Field(ge=0, description="Their size.")


class StorageStatus(BaseModel):
    """The size of what is stored of a map."""

    model_config = ConfigDict(frozen=True)

    precision: str = Field(description="How descriptors are stored.")
    bytes_per_place: int = Field(ge=0, description="All that is stored of the map, a place; 0 for an empty map.")
    descriptors: int = Field(ge=0, description="Bytes of descriptors and local descriptors.")
    index: int = Field(ge=0, description="Bytes of codes, which can be made again.")
    database: int = Field(
        ge=0, description="Bytes of all else: places, metadata, pictures, keypoints, frames for review, the log."
    )
    keypoints: KeypointsStatus
