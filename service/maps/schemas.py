"""Maps and their traverses."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.frames.masks import Mask
from core.judgement.calibration import Measurement, Target
from core.judgement.verdict import Calibration
from core.places import Timestamp
from core.storage import IndexStatus, Keep, MapSettings, NewPrecision, StorageStatus, TierSetting
from core.storage.search.tiers import COMPACT_FROM, INVERTED_FROM
from service.http.schemas import IDENTITY_EXAMPLE, CameraName, Cursor

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


CAMERA_EXAMPLE: dict[str, Any] = {
    "name": "front",
    "mask": {"polygons": [[[0, 0.85], [1, 0.85], [1, 1], [0, 1]]]},
    "updated_at": "2026-11-20T10:00:00Z",
}


class CameraDefinition(BaseModel):
    """What to ignore in the frames of a camera."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"mask": CAMERA_EXAMPLE["mask"]}]})

    mask: Mask | None = Field(default=None, description="null: nothing is ignored.")


class CameraView(BaseModel):
    """One camera of a map."""

    model_config = ConfigDict(json_schema_extra={"examples": [CAMERA_EXAMPLE]})

    name: str
    mask: Mask | None
    updated_at: Timestamp


class CameraList(BaseModel):
    """All cameras of a map, by name; they are few, so there is one page."""

    items: list[CameraView]
    next_cursor: None = None


Method = Literal["frames", "sequence", "map"]

MOST_FRAMES = 2000

ORDER_EXAMPLE: dict[str, Any] = {
    "method": "sequence",
    "sequence": "tuesday",
    "target": {"rule": "precision", "value": 0.95},
    "dry_run": True,
}


class Label(BaseModel):
    """The true place of one frame of the form."""

    model_config = ConfigDict(extra="forbid")

    file: str = Field(max_length=256, description="Name of the frame's part.")
    place: str | None = Field(max_length=128, description="Id of the place that it shows; null: the map has it not.")
    camera: CameraName = None


class CalibrationOrder(BaseModel):
    """By what a map is to be calibrated, and what for."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [ORDER_EXAMPLE]})

    method: Method = Field(
        description="`frames`: the labelled frames of this form. `sequence`: one traverse of the map, asked of the "
        "others. `map`: the map's own frames, each asked of its neighbours; better than nothing."
    )
    target: Target = Field(default=Target(rule="precision", value=0.95), description="What the threshold is to reach.")
    dry_run: bool = Field(strict=True, default=False, description="Measure and tell, store nothing.")
    background: bool = Field(
        strict=True, default=False, description="Answer 202 with a job, whose result is the report."
    )
    sequence: str | None = Field(default=None, max_length=128, description="The traverse that is asked.")
    pairs: dict[str, str | None] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_FRAMES,
        description="Of places of the sequence to the places among the others that show the same, null for one that "
        "they lack; only these are asked. Left out: the poses tell.",
    )
    most: int = Field(strict=True, default=300, ge=20, le=MOST_FRAMES, description="Frames to ask, spread evenly.")
    labels: list[Label] | None = Field(
        default=None, min_length=1, max_length=MOST_FRAMES, description="One for each frame of the form."
    )

    @model_validator(mode="after")
    def _what_belongs_to_the_method(self) -> CalibrationOrder:
        if (self.sequence is None) == (self.method == "sequence"):
            raise ValueError("sequence belongs to the method sequence, and to it only")
        if self.pairs is not None and self.method != "sequence":
            raise ValueError("pairs belong to the method sequence")
        if (self.labels is None) == (self.method == "frames"):
            raise ValueError("labels belong to the method frames, and to it only")
        if self.background and self.method == "frames":
            raise ValueError("frames are calibrated by at once; background belongs to the other methods")
        return self


class CalibrationReport(BaseModel):
    """A calibration, what was measured in making it, and what to know of it."""

    map: str
    encoder: str
    method: Method
    target: Target
    stored: bool = Field(description="It is the map's own from now on; false for a dry run.")
    calibration: Calibration
    previous: Calibration = Field(description="The one that judged so far.")
    measurement: Measurement
    warnings: list[str]
