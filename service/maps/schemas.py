"""JSON of maps, their cameras and their calibration."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.frames.value_ranges import ValueRange
from core.judgement.acceptance import HeldOutChange
from core.judgement.background import HIGHEST_DECISION, LOWEST_DECISION
from core.judgement.calibration import Measurement, Target
from core.judgement.verdict import Calibration, Verdict
from core.maps import (
    AlarmLimit,
    AlarmSetting,
    IndexStatus,
    Keep,
    LearningSetting,
    MapSettings,
    Precision,
    ReviewSetting,
    StorageStatus,
    TierSetting,
)
from core.maps.records import COMPACT_FROM, MOST_REJECTED, LearningMode, RejectedGround
from core.places import PoseAccuracy, Timestamp
from service.http.schemas import IDENTITY_EXAMPLE, CameraName, Cursor
from service.queries.counts import VerdictCounts

MAP_EXAMPLE: dict[str, Any] = {
    "id": "lab",
    "encoder": IDENTITY_EXAMPLE,
    "dimension": 16384,
    "description": "Second floor, by day",
    "keep": "thumbnail",
    "same_place_radius": 5.0,
    "same_place_height": 1.5,
    "pose_accuracy": None,
    "same_place_frames": 3,
    "verification": True,
    "review": None,
    "learning": {
        "mode": "off",
        "least_probability": 0.95,
        "most_looks": 3,
        "most_places": None,
        "new_ground": False,
        "calibration": "propose",
        "rejected_ground": [],
    },
    "alarms": {"worse_places": None, "changed_places": 10, "quiet_stretches": None},
    "calibration": {
        "source": "encoder-default",
        "threshold": 0.09,
        "margin": 0.004,
        "background_mean": 0.07,
        "background_deviation": 0.014,
    },
    "calibration_doubt": None,
    "index": {
        "setting": "auto",
        "tier": "exact",
        "wanted": "exact",
        "state": "ready",
        "rows_indexed": 0,
        "recall": None,
        "bytes_in_memory": 10902753,
    },
    "storage": {
        "precision": "half",
        "bytes_per_place": 68742,
        "descriptors": 7245776,
        "index": 0,
        "database": 4731904,
        "keypoints": {"places": 111, "bytes": 4348980},
    },
    "places": 111,
    "last_day": {"recognized": 120, "ambiguous": 4, "unknown": 9},
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
    keep: Keep = Field(description="The picture that is stored of each frame.")
    same_place_radius: float = Field(
        description="Distance in metres along the ground up to which two enrolled places count as the same place, so "
        "that neither is a rival of the other."
    )
    same_place_height: float = Field(
        description="Metres up or down beyond which they are on different storeys, unless both have a level."
    )
    same_place_frames: int = Field(
        description="The same for places without poses: their distance in frames of one sequence."
    )
    pose_accuracy: PoseAccuracy | None = Field(
        description="How exact the poses of places are that do not state it themselves, as its owner states it; null: "
        "pictures of the map's places say it as far as they can."
    )
    verification: bool = Field(description="Whether keypoints of each frame are stored, by which answers are verified.")
    review: ReviewSetting | None = Field(description="Which frames are stored to be reviewed by people; null: none.")
    learning: LearningSetting = Field(description="How the map learns from the runs of its robots.")
    alarms: AlarmSetting = Field(description="From which numbers on trends of the health report become events.")
    calibration: Calibration | None = Field(
        description="When a match is believed. The source is encoder-default until the map has its own calibration; "
        "null if the encoder is not installed."
    )
    calibration_doubt: str | None = Field(
        description="Why its own calibration is not to be trusted: it rests on frames of one kind alone, of known "
        "places or of strangers, or on too few of them. Null: nothing is known against it."
    )
    index: IndexStatus = Field(description="How the map is searched; to change its `setting`, send `index`.")
    storage: StorageStatus = Field(description="The size of what is stored of the map.")
    places: int
    last_day: VerdictCounts | None = Field(
        description="Answers of the last 24 hours by their verdicts; null if the statistics cannot be read."
    )
    revision: int = Field(description="Number of the last edit of the settings; the ETag contains it.")
    created_at: Timestamp
    updated_at: Timestamp


class QuarantinedMap(BaseModel):
    """A damaged map, which is out of service."""

    id: str
    reason: str


class MapPage(BaseModel):
    """A page of maps in the order of their ids."""

    items: list[MapView]
    next_cursor: Cursor
    quarantined: list[QuarantinedMap] = Field(description="Damaged maps, which are not among the items.")


class NewMap(MapSettings):
    """The settings of a new map."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"id": "lab", "encoder": "m-region-vlad", "description": "Second floor, by day"}]
        },
    )

    id: str = Field(description="[a-z0-9][a-z0-9._-]{0,63}, not 'import'.")
    encoder: str | None = Field(
        default=None,
        max_length=256,
        description="Name or full identity of the encoder; the default encoder if left out.",
    )
    precision: Precision = Field(
        default="half", description="How the descriptors are stored; it cannot be changed later."
    )


class CalibrationChanges(BaseModel):
    """Values of a calibration to set by hand, null restores the encoder's value; or which measured one to store."""

    model_config = ConfigDict(extra="forbid")

    threshold: float | None = Field(
        strict=True,
        default=None,
        allow_inf_nan=False,
        description="Least decision value of a recognized place; every decision value is from -1 to 1.",
        json_schema_extra={"minimum": LOWEST_DECISION, "maximum": HIGHEST_DECISION},
    )
    margin: float | None = Field(strict=True, default=None, ge=0, allow_inf_nan=False)
    measured_at: Timestamp | None = Field(
        default=None,
        description="Store, instead, the calibration that the latest calibrate has found, as after a dry run: the time "
        "at which it was measured, `measured.at` of the calibration. If it was measured again since, this is refused.",
    )
    restore: Calibration | None = Field(
        default=None,
        description="Put back, instead, a calibration that the map had, whole, as it was read: to undo a change.",
    )

    @field_validator("threshold")
    @classmethod
    def _within_reach(cls, threshold: float | None) -> float | None:
        if threshold is not None and not LOWEST_DECISION <= threshold <= HIGHEST_DECISION:
            raise ValueError(
                f"a threshold is from {LOWEST_DECISION:g} to {HIGHEST_DECISION:g}, as every decision value is"
            )
        return threshold

    @model_validator(mode="after")
    def _sets_or_stores(self) -> CalibrationChanges:
        if (self.measured_at is not None or self.restore is not None) and len(self.model_fields_set) > 1:
            raise ValueError("give measured_at alone, or restore alone, or threshold and margin")
        return self


class ReviewChanges(BaseModel):
    """Which frames to keep for review; null restores a default."""

    model_config = ConfigDict(extra="forbid")

    verdicts: list[Verdict] | None = Field(default=None, min_length=1, max_length=3)
    most_frames: int | None = Field(strict=True, default=None, ge=1, le=10_000)
    most_bytes: int | None = Field(strict=True, default=None, ge=1 << 16, le=1 << 36)


class LearningChanges(BaseModel):
    """Changes of how a map learns from runs; null restores a default."""

    model_config = ConfigDict(extra="forbid")

    mode: LearningMode | None = None
    least_probability: float | None = Field(strict=True, default=None, ge=0.5, lt=1)
    most_looks: int | None = Field(strict=True, default=None, ge=2, le=33)
    most_places: int | None = Field(strict=True, default=None, ge=1, le=2**31)
    new_ground: bool | None = Field(strict=True, default=None)
    calibration: LearningMode | None = None
    rejected_ground: list[RejectedGround] | None = Field(
        default=None, max_length=MOST_REJECTED, description="Those that stay rejected; null: none."
    )


class AlarmChanges(BaseModel):
    """Changes of what raises an alarm; null: never."""

    model_config = ConfigDict(extra="forbid")

    worse_places: AlarmLimit = None
    changed_places: AlarmLimit = None
    quiet_stretches: AlarmLimit = None


class MapChanges(BaseModel):
    """A merge patch (RFC 7396) of a map: null restores the default, and what is left out stays as it is."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"description": "By night", "calibration": {"threshold": 0.12}}]},
    )

    description: str | None = Field(default=None, max_length=2000)
    keep: Keep | None = None
    same_place_radius: float | None = Field(strict=True, default=None, ge=0, allow_inf_nan=False)
    same_place_height: float | None = Field(strict=True, default=None, ge=0, allow_inf_nan=False)
    same_place_frames: int | None = Field(strict=True, default=None, ge=0, le=2**31)
    pose_accuracy: PoseAccuracy | None = Field(default=None, description="null: nobody states it.")
    verification: bool | None = Field(strict=True, default=None)
    index: TierSetting | None = Field(
        default=None,
        description=f"auto, exact or compact (auto from {COMPACT_FROM} places on).",
    )
    review: ReviewChanges | None = Field(default=None, description="null: no frames are stored from now on.")
    learning: LearningChanges | None = Field(default=None, description="null: nothing is learnt from now on.")
    alarms: AlarmChanges | None = Field(default=None, description="null: no alarm is raised from now on.")
    calibration: CalibrationChanges | None = None


CAMERA_EXAMPLE: dict[str, Any] = {
    "name": "front",
    "mask": {"polygons": [[[0, 0.85], [1, 0.85], [1, 1], [0, 1]]]},
    "intrinsics": {
        "width": 640,
        "height": 480,
        "fx": 554.3,
        "fy": 554.3,
        "cx": 319.5,
        "cy": 239.5,
        "distortion_model": "plumb_bob",
        "distortion": [-0.28, 0.07, 0.0002, 0.0, 0.0],
    },
    "value_range": None,
    "updated_at": "2026-11-20T10:00:00Z",
}


class CameraDefinition(BaseModel):
    """Which part of a camera's frames is ignored, which direction each pixel looks in, and which values it has."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"mask": CAMERA_EXAMPLE["mask"], "intrinsics": CAMERA_EXAMPLE["intrinsics"]}]},
    )

    mask: Mask | None = Field(default=None, description="The part that is ignored; null if nothing is.")
    intrinsics: Intrinsics | None = Field(
        default=None, description="Of the upright frame, as in ROS's CameraInfo; null if they are not known."
    )
    value_range: ValueRange | None = Field(
        default=None,
        description="The values of frames of 16 bits that become black and white, such as [0, 1023] of a camera of ten "
        "bits; null: the upper 8 bits are used.",
    )


class CameraView(BaseModel):
    """A camera of a map."""

    model_config = ConfigDict(json_schema_extra={"examples": [CAMERA_EXAMPLE]})

    name: str
    mask: Mask | None
    intrinsics: Intrinsics | None
    value_range: ValueRange | None = None
    updated_at: Timestamp


class CameraList(BaseModel):
    """All cameras of a map in the order of their names, on one page."""

    items: list[CameraView]
    next_cursor: None = None


Method = Literal["frames", "sequence", "map", "labels", "runs"]

MOST_FRAMES = 2000

ORDER_EXAMPLE: dict[str, Any] = {
    "method": "sequence",
    "sequence": "tuesday",
    "target": {"rule": "precision", "value": 0.95},
    "dry_run": True,
}


class Label(BaseModel):
    """The true place of one frame of a form."""

    model_config = ConfigDict(extra="forbid")

    file: str = Field(max_length=256, description="Name of the file part that holds the frame.")
    place: str | None = Field(
        max_length=128, description="Id of the place that the frame shows; null if the map lacks that place."
    )
    camera: CameraName = None


class CalibrationOrder(BaseModel):
    """How a map is to be calibrated, and for which target."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [ORDER_EXAMPLE]})

    method: Method = Field(
        description="Which frames query the map. `frames`: the labelled frames of this form. `sequence`: one "
        "traverse of the map, compared with the others. `map`: all frames of the map, each compared with its "
        "neighbours, which is the least reliable method. `labels`: the frames stored for review and labelled. "
        "`runs`: the frames of robots' sessions whose place the whole run knew beyond doubt; the target has to be a "
        "precision."
    )
    target: Target = Field(default=Target(rule="precision", value=0.95), description="The target of the threshold.")
    dry_run: bool = Field(strict=True, default=False, description="Report the calibration without storing it.")
    background: bool = Field(strict=True, default=False, description="Answer 202 with a job; its result is the report.")
    sequence: str | None = Field(default=None, max_length=128, description="The traverse whose frames query the map.")
    pairs: dict[str, str | None] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_FRAMES,
        description="For places of the sequence, the id of a place of another sequence that shows the same, or null if "
        "there is none. Only these places query the map. If left out, poses decide which places are the same.",
    )
    most: int = Field(
        strict=True,
        default=300,
        ge=20,
        le=MOST_FRAMES,
        description="The largest number of frames that query the map; they are chosen evenly.",
    )
    beside: Literal["encoder", "map", "none"] = Field(
        default="encoder",
        description="With the method labels, further frames, since labels are few and of the doubtful frames. "
        "`encoder`: the encoder's calibration, whose curve is moved as far as the labels demand; the target is not "
        "used then. `map`: the map's own frames, which query it as well. `none`: nothing.",
    )
    labels: list[Label] | None = Field(
        default=None, min_length=1, max_length=MOST_FRAMES, description="One label for each frame of the form."
    )

    @model_validator(mode="after")
    def _check_method(self) -> CalibrationOrder:
        if (self.sequence is None) == (self.method == "sequence"):
            raise ValueError("sequence is needed by the method sequence, and only by it")
        if self.pairs is not None and self.method != "sequence":
            raise ValueError("pairs can be given only with the method sequence")
        if (self.labels is None) == (self.method == "frames"):
            raise ValueError("labels are needed by the method frames, and only by it")
        if self.background and self.method == "frames":
            raise ValueError("background cannot be used with the method frames")
        return self


class CalibrationReport(BaseModel):
    """A calibration, the measurement that it rests on, and what it would change."""

    map: str
    encoder: str
    method: Method
    target: Target
    stored: bool = Field(
        description="Whether it was stored as the map's own calibration; false after a dry run, and where it changes "
        "nothing of the one in force."
    )
    calibration: Calibration
    previous: Calibration = Field(description="The calibration that was in force before.")
    measurement: Measurement
    change: HeldOutChange | None = Field(
        default=None,
        description="What it changes for answers that had no part in it; a calibration that makes them worse is not "
        "stored. Null where the calibration in force states no probabilities.",
    )
    warnings: list[str]
