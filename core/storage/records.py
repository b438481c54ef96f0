"""What goes into a map and what comes out of it, as plain typed values."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from core.judgement.verdict import Calibration
from core.places import PlaceFields, Timestamp
from core.storage.files.row_formats import Precision
from core.storage.search.tiers import COMPACT_FROM, INVERTED_FROM, TierSetting

Change = Literal["created", "unchanged", "updated", "replaced"]
Keep = Literal["none", "thumbnail", "image"]


class MapSettings(BaseModel):
    """What the owner of a map may choose, when it is made and later."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    description: str = Field(default="", max_length=2000)
    keep: Keep = Field(
        default="thumbnail",
        description="What is kept of each frame. A change applies to frames enrolled from then on.",
    )
    same_place_radius: float = Field(
        strict=True,
        default=5.0,
        ge=0,
        allow_inf_nan=False,
        description="Places within so many metres are the same place.",
    )
    same_place_frames: Annotated[int, Field(strict=True, ge=0, le=2**31)] = Field(
        default=3, description="Without poses: places so many frames apart in their sequence are the same place."
    )
    index: TierSetting = Field(
        default="auto",
        description="How the map is searched: every place compared (exact), by codes (compact), by lists of codes "
        f"(inverted), or by what suits its size (auto): compact from {COMPACT_FROM} places, inverted from "
        f"{INVERTED_FROM}.",
    )


class MapRecord(MapSettings):
    """A map as it is listed: its settings, what it is bound to, and its history in brief."""

    id: str
    encoder: str = Field(description="Identity of the one encoder whose descriptors the map holds.")
    dimension: int = Field(gt=0, description="Values of one descriptor.")
    local_cells: int = Field(default=0, ge=0, description="Local descriptors of one frame; 0: there are none.")
    local_values: int = Field(default=0, ge=0, description="Values of one local descriptor.")
    precision: Precision = Field(default="full", description="How its descriptors are kept; chosen when it is made.")
    calibration: Calibration | None = Field(default=None, description="The map's own; none: that of its encoder.")
    revision: int = Field(ge=1, description="Grows by one with every edit of this record.")
    created_at: Timestamp
    updated_at: Timestamp

    @property
    def local_shape(self) -> tuple[int, int]:
        """(C, L), the shape of a frame's local descriptors; (0, 0) where the encoder has no second stage."""
        return self.local_cells, self.local_values

    def settings(self) -> MapSettings:
        """The part that its owner chose."""
        return MapSettings.model_validate(self.model_dump(include=set(MapSettings.model_fields)))


class SequenceSummary(BaseModel):
    """One traverse of a map; the times are those of its first and last frames that have one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    places: int = Field(ge=1)
    first_at: Timestamp | None
    last_at: Timestamp | None


@dataclass(frozen=True, eq=False)
class Enrolment:
    """One frame to be remembered.

    descriptor, local: float32 [D] and int8 [C, L] of the map's encoder; [0, 0] where it has no second stage.
    digest: SHA-256 of the image's bytes, 32 bytes.
    thumbnail, image: JPEG made from the frame, and the bytes as received; the map keeps what it is set to keep.
    """

    id: str
    fields: PlaceFields
    descriptor: NDArray[np.float32]
    regions: int
    digest: bytes
    local: NDArray[np.int8] = field(default_factory=lambda: np.empty((0, 0), np.int8))
    thumbnail: bytes | None = None
    image: bytes | None = None


@dataclass(frozen=True)
class SameFrame:
    """Other fields for a place, if it still shows the frame of this digest; its descriptor need not be sent again."""

    id: str
    fields: PlaceFields
    digest: bytes


@dataclass(frozen=True)
class History:
    """What a place brings along from another map besides its frame and fields.

    picture: what is kept of its frame there.
    ordinal: its order in its sequence here; None puts it at the end.
    """

    picture: Keep
    ordinal: int | None
    created_at: datetime
    updated_at: datetime


class VerifyReport(BaseModel):
    """What a full reading of a map found."""

    ok: bool = Field(description="Nothing of the map is damaged; a cache may still have to be rebuilt.")
    places: int = Field(ge=0)
    rows: int = Field(ge=0, description="Descriptors stored, those of forgotten places included.")
    checked_bytes: int = Field(ge=0, description="Bytes of descriptors, pictures and caches that were read again.")
    problems: list[str] = Field(description="Each names a file and what is damaged in it.")
    stale_caches: list[str] = Field(description="Index files that are missing or damaged; rebuilt at the next start.")
