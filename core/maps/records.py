"""The values that go into a map and come out of it, and merge patches (RFC 7396) of places and of a map's record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, ValidationError

from core.errors import InvalidField
from core.geometry.keypoints import Keypoints
from core.judgement.verdict import Calibration, Verdict
from core.names import texts
from core.places import SAME_STOREY, PlaceFields, Pose, PoseAccuracy, Timestamp, level_in, place_and_look

Change = Literal["created", "unchanged", "updated", "replaced"]
Keep = Literal["none", "thumbnail", "image"]
Precision = Literal["half", "compressed"]

TierSetting = Literal["auto", "exact", "compact"]

COMPACT_FROM = 256
"""From this number of places on codes are used; with fewer all are compared in less than a millisecond."""


class ReviewSetting(BaseModel):
    """Which frames a map keeps so that people can say later what they show, and how many at most."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    verdicts: Annotated[tuple[Verdict, ...], Field(min_length=1, max_length=3)] = Field(
        default=("ambiguous", "unknown"), description="Frames that are answered with one of these are stored."
    )
    most_frames: int = Field(strict=True, default=500, ge=1, le=10_000, description="Most frames; the oldest go first.")
    most_bytes: int = Field(
        strict=True,
        default=256 << 20,
        ge=1 << 16,
        le=1 << 36,
        description="Most bytes of their files together; the oldest go first.",
    )

    def allows(self, count: int, size: int) -> bool:
        """Whether ``count`` frames of ``size`` bytes together may be stored."""
        return count <= self.most_frames and size <= self.most_bytes


LearningMode = Literal["off", "propose", "auto"]
"""Ways to learn from runs: nothing is learnt; looks wait for review, and a person accepts them; or the map takes those
on which independent evidence agrees, and the others wait for a person."""


MOST_REJECTED, MOST_POSES = 16, 64
"""Stretches whose rejection a map remembers, the latest ones; and poses that outline each."""


OutlinePose = Annotated[Pose, PlainSerializer(lambda pose: pose.model_dump(exclude_none=True))]
"""A pose without the coordinates that it does not have."""


class RejectedGround(BaseModel):
    """A stretch of new ground that a person has rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stretch: Annotated[str, texts("a stretch")] = Field(description="Its id.")
    run: Annotated[str, texts("a run")] = Field(description="The run that proposed it.")
    at: Timestamp = Field(description="When it was rejected.")
    poses: Annotated[tuple[OutlinePose, ...], Field(min_length=1, max_length=MOST_POSES)] = Field(
        description="Where it is, in the order of the run."
    )


class LearningSetting(BaseModel):
    """The setting by which a map learns from the runs of its robots."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: LearningMode = Field(
        default="off",
        description="propose: looks are stored for review, and a person accepts them. auto: the map also takes those "
        "on which two runs, or keypoints of the frames beside them, agree, and withdraws looks that later runs "
        "contradict. off: nothing is learnt.",
    )
    least_probability: float = Field(
        strict=True,
        default=0.95,
        ge=0.5,
        lt=1,
        description="How sure the rest of a run must be of a frame's place for the frame to be proposed.",
    )
    most_looks: Annotated[int, Field(strict=True, ge=2, le=33)] = Field(
        default=3,
        description="Looks that a place has at most by what it learns, its first and those that people added included.",
    )
    most_places: Annotated[int, Field(strict=True, ge=1, le=2**31)] | None = Field(
        default=None,
        description="Places with learnt looks, and places of new ground, that the map has at most together: then it "
        "takes no look for a further place by itself, and no stretch; null: no limit.",
    )
    new_ground: bool = Field(
        strict=True,
        default=False,
        description="Whether stretches of runs that leave the map and come back are stored for review, too. A person "
        "accepts them, whatever the mode; with the mode off there are none.",
    )
    calibration: LearningMode = Field(
        default="propose",
        description="Whether the map calibrates itself: by a traverse, as soon as it is aligned with others, and by "
        "frames whose place a run knows beyond doubt (with the mode off there are none). propose: what they would "
        "change is measured, as by a dry run of `calibrate`. auto: it is stored, by runs once those of two robots, "
        "or two half a day apart, tell it, unless a person has calibrated the map. off: neither.",
    )
    rejected_ground: Annotated[tuple[RejectedGround, ...], Field(max_length=MOST_REJECTED)] = Field(
        default=(),
        description="Stretches that a person has rejected: no run proposes this ground again. One that is taken out of "
        "the list may be proposed again.",
    )


AlarmName = Literal["worse_places", "changed_places", "quiet_stretches"]
"""A trend of a map that may raise an alarm."""

AlarmLimit = Annotated[int, Field(strict=True, ge=1, le=1_000_000)] | None


class AlarmSetting(BaseModel):
    """From which numbers on the trends of a map raise an alarm; null: never."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    worse_places: AlarmLimit = Field(default=None, description="Places that get worse.")
    changed_places: AlarmLimit = Field(
        default=None, description="Places that have changed: runs pass them, while single frames fail."
    )
    quiet_stretches: AlarmLimit = Field(default=None, description="Stretches that nobody drives any more.")


class MapSettings(BaseModel):
    """The settings of a map that its owner may choose, when it is made and later."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    description: str = Field(default="", max_length=2000)
    keep: Keep = Field(
        default="thumbnail",
        description="The picture that is stored of each frame. A change applies to frames enrolled from then on.",
    )
    same_place_radius: float = Field(
        strict=True,
        default=5.0,
        ge=0,
        allow_inf_nan=False,
        description="Places within this distance in metres along the ground are the same place.",
    )
    same_place_height: float = Field(
        strict=True,
        default=SAME_STOREY,
        ge=0,
        allow_inf_nan=False,
        description="Places whose heights differ by more metres are on different storeys, and never the same place; "
        "where both have a level, that says it instead.",
    )
    same_place_frames: Annotated[int, Field(strict=True, ge=0, le=2**31)] = Field(
        default=3, description="Without poses: places this many frames apart in their sequence are the same place."
    )
    pose_accuracy: PoseAccuracy | None = Field(
        default=None,
        description="How exact the poses of places are that do not state it themselves; null: pictures of the map's "
        "places say it as far as they can.",
    )
    verification: bool = Field(
        default=True,
        strict=True,
        description="Whether keypoints of each frame are stored, by which answers are verified. A change applies to "
        "frames enrolled from then on.",
    )
    index: TierSetting = Field(
        default="auto",
        description="How the map is searched: every place compared (exact), by codes (compact), or by "
        f"what suits its size (auto): compact from {COMPACT_FROM} places.",
    )
    review: ReviewSetting | None = Field(
        default=None, description="Which frames are stored to be reviewed by people; null: none."
    )
    learning: LearningSetting = Field(
        default=LearningSetting(), description="How the map learns from the runs of its robots."
    )
    alarms: AlarmSetting = Field(
        default=AlarmSetting(), description="From which numbers on trends of the health report become events."
    )


class MapRecord(MapSettings):
    """A map as it is listed: its settings, its encoder, and its history in brief."""

    id: str
    encoder: str = Field(description="Identity of the one encoder whose descriptors the map holds.")
    dimension: int = Field(gt=0, description="Values of one descriptor.")
    local_cells: int = Field(default=0, ge=0, description="Local descriptors of one frame; 0: there are none.")
    local_values: int = Field(default=0, ge=0, description="Values of one local descriptor.")
    precision: Precision = Field(description="How its descriptors are stored; chosen when it is made.")
    calibration: Calibration | None = Field(default=None, description="The map's own; none: that of its encoder.")
    revision: int = Field(ge=1, description="Grows by one with every edit of this record.")
    created_at: Timestamp
    updated_at: Timestamp

    @classmethod
    def new(
        cls,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        local_shape: tuple[int, int],
        precision: Precision,
        settings: MapSettings | None,
    ) -> MapRecord:
        """The record of a map that is made now.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).
            settings: that its owner chose; None: the default ones.
        """
        now = datetime.now(UTC)
        return cls(
            id=map_id,
            encoder=encoder_identity,
            dimension=dimension,
            local_cells=local_shape[0],
            local_values=local_shape[1],
            precision=precision,
            revision=1,
            created_at=now,
            updated_at=now,
            **(settings or MapSettings()).model_dump(),
        )

    @property
    def local_shape(self) -> tuple[int, int]:
        """(C, L), the shape of a frame's local descriptors; (0, 0) where the encoder has no second stage."""
        return self.local_cells, self.local_values

    def settings(self) -> MapSettings:
        """The settings that its owner chose."""
        return MapSettings.model_validate(self.model_dump(include=set(MapSettings.model_fields)))


class SequenceSummary(BaseModel):
    """One traverse of a map; the times are those of its first and last frames that have one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    places: int = Field(ge=1)
    first_at: Timestamp | None
    last_at: Timestamp | None


MOST_LOOKS = 32
"""Looks that a place has at most besides its first."""


@dataclass(frozen=True, eq=False)
class Enrolment:
    """One frame to be stored as a place, or as a look of a place.

    id: of the place; or the address of the look (:func:`core.places.look_address`), of whose fields camera and
        timestamp are those of its frame, and the others are its place's, whatever they say here.

    descriptor, local: float32 [D] and int8 [C, L], made by the map's encoder; local is [0, 0] without a second stage.
    regions: how many regions of interest the frame has.
    digest: SHA-256 of the image's bytes, 32 bytes.
    thumbnail, image: a small JPEG of the frame, and the bytes as received; the map stores what ``keep`` says.
    keypoints: of the frame; stored if the map's setting ``verification`` says so.  None: they were not looked for.
    run: the run from which a look or a place was learnt; None: it was not.
    least: the score of two stages from which a match with the frame is believed; None: from any.
    """

    id: str
    fields: PlaceFields
    descriptor: NDArray[np.float32]
    regions: int
    digest: bytes
    local: NDArray[np.int8] = field(default_factory=lambda: np.empty((0, 0), np.int8))
    thumbnail: bytes | None = None
    image: bytes | None = None
    keypoints: Keypoints | None = None
    run: str | None = None
    least: float | None = None


@dataclass(frozen=True)
class SameFrame:
    """New fields for a place that still shows the frame with this digest; the frame need not be encoded again."""

    id: str
    fields: PlaceFields
    digest: bytes


@dataclass(frozen=True)
class PicturedPlace:
    """A place with a stored picture, from which its keypoints can be computed.

    number: grows in the order of enrolment.
    digest: SHA-256 of its image and of its camera's mask, 32 bytes.
    picture: the kind that is stored; keypoints of a thumbnail are those of a smaller picture, as their size says.
    """

    number: int
    id: str
    digest: bytes
    camera: str | None
    picture: Literal["thumbnail", "image"]


@dataclass(frozen=True)
class History:
    """The state of a place that is copied from another map besides its frame and fields.

    picture: the kind of its stored picture.
    ordinal: its position in its sequence in the new map; None puts it at the end.
    behind: frames that are enrolled into its sequence later are at this position or behind it; this keeps the positions
        before it for frames that are copied later.
    """

    picture: Keep
    ordinal: int | None
    created_at: datetime
    updated_at: datetime
    behind: int = 0


@dataclass(frozen=True)
class Outline:
    """A place or a look in brief: enough to see whether two maps hold the same one in the same state.

    id: of a look its address.

    number: grows in the order of enrolment.
    row: of its descriptor.
    digest: SHA-256 of its image, 32 bytes.
    picture: the kind of its stored picture.
    ordinal: its position in its sequence.
    run: the run from which a look was learnt.
    least: the score of two stages from which a match with a look is believed; None: from any.
    """

    number: int
    id: str
    row: int
    digest: bytes
    picture: Keep
    camera: str | None
    sequence: str | None
    ordinal: int
    updated_at: str
    run: str | None = None
    least: float | None = None

    @property
    def is_look(self) -> bool:
        """Whether it is a look of a place."""
        return place_and_look(self.id)[1] is not None

    def same_as(self, other: Outline) -> bool:
        """Whether both are the same place in the same state; they may be of different maps."""
        return self.same_frame(other) and (self.sequence, self.ordinal, self.updated_at) == (
            other.sequence,
            other.ordinal,
            other.updated_at,
        )

    def same_frame(self, other: Outline) -> bool:
        """Whether both were encoded from the same bytes under the same camera's mask."""
        return (self.id, self.digest, self.camera) == (other.id, other.digest, other.camera)


class VerifyReport(BaseModel):
    """The result of a full reading of a map."""

    ok: bool = Field(description="Nothing of the map is damaged; a cache may still have to be rebuilt.")
    places: int = Field(ge=0)
    rows: int = Field(ge=0, description="Descriptors stored, those of forgotten places included.")
    checked_bytes: int = Field(ge=0, description="Bytes of descriptors, pictures and codes that were read again.")
    problems: list[str] = Field(description="Each says what is damaged.")
    stale_caches: list[str] = Field(
        description="Codes that are damaged: they are computed again when the map is read, until its index is rebuilt."
    )


MOST_FAULTS = 10
"""Invalid values that an error message describes; further ones are only counted."""

MOST_LISTED = 1000
"""With more invalid values a message only counts them, because pydantic can only describe all of them at once."""


def merge_patch(target: Any, patch: Any) -> Any:
    """Apply a JSON merge patch (RFC 7396): objects are merged by member, null removes a member, all else replaces.

    Neither argument is changed.
    """
    if not isinstance(patch, Mapping):
        return patch
    merged = dict(target) if isinstance(target, Mapping) else {}
    for name, value in patch.items():
        if value is None:
            merged.pop(name, None)
        else:
            merged[name] = merge_patch(merged.get(name), value)
    return merged


def validation_message(error: ValueError) -> str:
    """The first invalid values of many, on one line."""
    if not isinstance(error, ValidationError):
        return str(error)
    if (count := error.error_count()) > MOST_LISTED:
        return f"{count} values are invalid"
    parts = []
    for fault in error.errors(include_url=False, include_context=False, include_input=False)[:MOST_FAULTS]:
        where = ".".join(str(step) for step in fault["loc"])
        parts.append(f"{where}: {fault['msg']}" if where else fault["msg"])
    if count > MOST_FAULTS:
        parts.append(f"and {count - MOST_FAULTS} more")
    return "; ".join(parts)


def patched_fields(fields: PlaceFields, changes: Mapping[str, Any]) -> PlaceFields:
    """``fields`` after a merge patch.

    Raises:
        InvalidField: the result is not valid for a place, or the patch is no object.
    """
    if not isinstance(changes, Mapping):
        raise InvalidField("A patch is a JSON object.")
    if "camera" in changes:
        raise InvalidField("The camera of a place cannot be changed: send its frame again.")
    document = fields.model_dump(include=set(PlaceFields.model_fields), exclude={"pose"})
    if fields.level == level_in(fields.metadata):  # it follows the metadata, as long as nothing else is stated
        document["level"] = None
    if fields.pose is not None:
        document["pose"] = fields.pose.model_dump(exclude_none=True)
    stored = {} if "sequence" in changes else {"sequence": document.pop("sequence")}  # which may be a name of old
    try:
        return PlaceFields.model_validate(merge_patch(document, changes)).model_copy(update=stored)
    except ValidationError as error:
        raise InvalidField(f"The place cannot be changed like this: {validation_message(error)}.") from error
    except RecursionError as error:
        raise InvalidField("The patch is nested too deeply.") from error


def patched_record(record: MapRecord, changes: Mapping[str, Any]) -> MapRecord:
    """``record`` with other settings or another calibration (None: use that of its encoder).

    Each value given replaces the present one; settings cannot be removed.

    Raises:
        InvalidField: a field is unknown or fixed, or its value is not allowed.
    """
    if not isinstance(changes, Mapping):
        raise InvalidField("The changes of a map are a JSON object.")
    if fixed := set(changes) - set(MapSettings.model_fields) - {"calibration"}:
        raise InvalidField(f"These cannot be changed: {', '.join(sorted(map(str, fixed)))}.")
    try:
        return MapRecord.model_validate({**record.model_dump(), **changes})
    except ValidationError as error:
        raise InvalidField(f"The map cannot be changed like this: {validation_message(error)}.") from error
