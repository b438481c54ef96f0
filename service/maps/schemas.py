"""Maps and their traverses."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from core.judgement.verdict import Calibration
from core.places import Timestamp
from core.storage import IndexStatus, Keep, MapSettings, NewPrecision, SequenceSummary, StorageStatus, TierSetting
from core.storage.search.tiers import COMPACT_FROM, INVERTED_FROM
from service.http.schemas import IDENTITY_EXAMPLE, Cursor

MAP_EXAMPLE: dict[str, Any] = {
    "id": "lab",
    "encoder": IDENTITY_EXAMPLE,
    "dimension": 16384,
    "description": "Second floor, by day",
    "keep": "thumbnail",
    "same_place_radius": 5.0,
    "same_place_frames": 3,
    "calibration": {
        "source": "encoder-default",
        "threshold": 0.09,
        "margin": 0.004,
        "background_mean": 0.07,
        "background_deviation": 0.014,
    },
    "index": {
        "setting": "auto",
        "tier": "exact",
        "wanted": "exact",
        "state": "ready",
        "progress": 1.0,
        "rows_indexed": 0,
        "recall": None,
        "bytes_in_memory": 10902753,
    },
    "storage": {
        "precision": "half",
        "bytes_per_place": 68742,
        "descriptors": 7245776,
        "index": 0,
        "database": 384512,
    },
    "places": 111,
    "revision": 1,
    "created_at": "2026-11-20T09:00:00Z",
    "updated_at": "2026-11-20T09:00:00Z",
}


class MapView(BaseModel):
    """One environment, bound for life to one encoder."""

    model_config = ConfigDict(json_schema_extra={"examples": [MAP_EXAMPLE]})

    id: str
    encoder: str = Field(description="Identity of its encoder.")
    dimension: int = Field(description="Values of one descriptor.")
    description: str
    keep: Keep = Field(description="What is kept of each frame.")
    same_place_radius: float = Field(description="Metres within which two places are no rivals.")
    same_place_frames: int = Field(description="Without poses: frames of a sequence within which they are no rivals.")
    calibration: Calibration | None = Field(
        description="When a match is believed; its source is encoder-default until the map has its own. "
        "Null if its encoder is not installed."
    )
    index: IndexStatus = Field(description="How it is searched; its `setting` is set by sending `index`.")
    storage: StorageStatus = Field(description="What it takes on disk.")
    places: int
    revision: int = Field(description="Counts the edits; the ETag is made of it.")
    created_at: Timestamp
    updated_at: Timestamp


class QuarantinedMap(BaseModel):
    """A damaged map, out of service."""

    id: str
    reason: str


class MapPage(BaseModel):
    """Maps in the order of their ids."""

    items: list[MapView]
    next_cursor: Cursor
    quarantined: list[QuarantinedMap] = Field(description="Damaged maps; they are not among the items.")


class NewMap(MapSettings):
    """A map to create."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"id": "lab", "encoder": "m-region-vlad", "description": "Second floor, by day"}]
        },
    )

    id: str = Field(description="[a-z0-9][a-z0-9._-]{0,63}, not 'import'.")
    encoder: str | None = Field(
        default=None, max_length=256, description="Name or full identity; the default encoder if left out."
    )
    precision: NewPrecision = Field(default="half", description="How its descriptors are kept, for good.")


class CalibrationChanges(BaseModel):
    """Values to set by hand; null is the encoder's own."""

    model_config = ConfigDict(extra="forbid")

    threshold: float | None = Field(strict=True, default=None, allow_inf_nan=False)
    margin: float | None = Field(strict=True, default=None, ge=0, allow_inf_nan=False)


class MapChanges(BaseModel):
    """A merge patch (RFC 7396) of a map: null brings the default back, what is left out stays."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"description": "By night", "calibration": {"threshold": 0.12}}]},
    )

    description: str | None = Field(default=None, max_length=2000)
    keep: Keep | None = None
    same_place_radius: float | None = Field(strict=True, default=None, ge=0, allow_inf_nan=False)
    same_place_frames: int | None = Field(strict=True, default=None, ge=0, le=2**31)
    index: TierSetting | None = Field(
        default=None,
        description=f"auto, exact, compact (auto from {COMPACT_FROM} places on) or inverted (from {INVERTED_FROM}).",
    )
    calibration: CalibrationChanges | None = None


class SequencePage(BaseModel):
    """Traverses in the order of their names."""

    items: list[SequenceSummary]
    next_cursor: Cursor


class ForgottenSequence(BaseModel):
    """A deleted traverse."""

    name: str
    places: int = Field(description="Places that were forgotten with it.")
