"""The lines of an export file, each for a sequence, a camera or a place: reading and checking them."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from core.errors import InvalidArchive, InvalidIdentifier
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.frames.value_ranges import ValueRange
from core.geometry.keypoints import MOST_STORED
from core.judgement.verdict import Verdict
from core.maps.archives.manifest import expect_names, strict_json
from core.maps.records import validation_message
from core.names import LONGEST, TEXT, composed
from core.places import LOOK, PLACE_ID, Camera, Level, PlaceFields, Pose, PoseAccuracy, Timestamp, check_sequence

MOST_METADATA_BYTES = 1 << 20
"""Of one place, as compact JSON; no service can be set to accept more."""

MOST_LINE_BYTES = MOST_METADATA_BYTES + (64 << 10)

MOST_PICTURE_BYTES = 1_000_000_000
"""The largest value that SQLite accepts."""

LARGEST = 2**62
"""The largest number in a line; SQLite can hold larger ones, so counting further is possible."""

Number = Annotated[int, Field(ge=0, le=LARGEST, strict=True)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def _as_written(name: str) -> str:
    """The name of a sequence as the file has it, which may be from before texts had one form: it has two such apart."""
    try:
        check_sequence(name)
    except InvalidIdentifier as error:
        raise ValueError(str(error)) from error
    return name


def _composed_if_possible(metadata: Any) -> Any:
    """Metadata in the one form of texts, or as it is where two of its names would be one."""
    try:
        return composed(metadata)
    except ValueError:
        return metadata


WrittenSequence = Annotated[str, AfterValidator(_as_written)]


class _Line(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SequenceLine(_Line):
    """A sequence.  name: None for the places that belong to none."""

    name: WrittenSequence | None
    next_ordinal: Number


class CameraLine(_Line):
    """A camera, the ignored parts of its frames, its intrinsics and the range of its values."""

    name: Camera
    mask: Mask | None
    intrinsics: Intrinsics | None
    value_range: ValueRange | None = None
    updated_at: Timestamp


Word = Annotated[str, Field(max_length=4096)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Whole = Annotated[int, Field(ge=-LARGEST, le=LARGEST, strict=True)]


class MatchLine(_Line):
    """A match of an answer."""

    place: Word
    score: Finite


class AnswerLine(_Line):
    """How a frame was answered that is stored for review; of proposals and new ground nothing is said."""

    verdict: Verdict
    reason: Word | None = None
    probability: Finite | None = None
    score: Finite | None = None
    decision: Finite | None = None
    threshold: Finite | None = None
    best: Word | None = None
    matches: Annotated[list[MatchLine], Field(max_length=100)] = []
    revision: Whole | None = None
    camera: Word | None = None
    session: Word | None = None
    frame: Whole | None = None
    file: Word | None = None
    operation: Word | None = None
    request_id: Word | None = None
    key: Word | None = None
    taken: Timestamp | None = None


class ShownLine(_Line):
    """What a labelled frame shows: a place, perhaps as a look of it, a new place, or none."""

    place: Annotated[str, Field(pattern=f"^{PLACE_ID}$")] | None = None
    look: Annotated[str, Field(pattern=f"^{LOOK}$")] | None = None
    new: Annotated[str, Field(pattern=f"^{PLACE_ID}$")] | None = None
    stranger: bool = False

    @model_validator(mode="after")
    def _says_one_thing(self) -> Self:
        if [self.place is not None, self.new is not None, self.stranger].count(True) != 1:
            raise ValueError("a label says exactly one of place, new and stranger")
        return self


class LabelLine(_Line):
    """A labelled frame of the review: its file is the next one among those of labelled frames.

    at: the time of the query.
    bytes, sha256: of the file.
    labelled_at, labelled_by: when the label was given, and by which key.
    """

    at: Timestamp
    bytes: Annotated[int, Field(ge=1, le=MOST_PICTURE_BYTES, strict=True)]
    sha256: Digest
    answer: AnswerLine
    label: ShownLine
    labelled_at: Timestamp
    labelled_by: Word | None


class Picture(_Line):
    """The stored picture of a place's frame: its bytes are the next ones in the pictures of its group."""

    kind: Literal["thumbnail", "image"]
    bytes: Annotated[int, Field(ge=0, le=MOST_PICTURE_BYTES, strict=True)]
    sha256: Digest


class PlaceLine(_Line):
    """A place, or a look of a place in a line before.

    id: of a look its address (:func:`core.places.look_address`).

    track, station: the sequence and the ordinal at which another traverse shows the same; None: its own.  A sequence
        that is gone has no name any more, but a number, which distinguishes the places on its track from others.
    pose_of: the place whose pose it got from an alignment.
    digest: SHA-256 of the image with which it was enrolled and of its camera's mask.
    keypoints: the number of those of its frame; their record is the next one in its group.  None: none are stored.
    seen: when the frame of a look was taken.
    run, least: the run from which a look or a place was learnt, and the score of two stages from which a match with it
        is believed.
    """

    id: Annotated[str, Field(pattern=f"^{PLACE_ID}(/{LOOK})?$")]
    pose: Pose | None
    pose_of: Annotated[str, Field(pattern=f"^{PLACE_ID}$")] | None
    timestamp: Timestamp | None
    sequence: WrittenSequence | None
    ordinal: Number
    track: WrittenSequence | Number | None
    station: Annotated[int, Field(ge=-LARGEST, le=LARGEST, strict=True)] | None
    camera: Camera | None
    metadata: Annotated[dict[str, Any], BeforeValidator(_composed_if_possible)]
    regions: Number
    digest: Digest
    picture: Picture | None
    keypoints: Annotated[int, Field(ge=0, le=MOST_STORED, strict=True)] | None
    created_at: Timestamp
    updated_at: Timestamp
    seen: Timestamp | None = None
    run: Annotated[str, Field(max_length=LONGEST, pattern=f"^{TEXT}$")] | None = None
    least: Annotated[float, Field(allow_inf_nan=False)] | None = None
    level: Level | None = None
    pose_accuracy: PoseAccuracy | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.track is None) != (self.station is None):
            raise ValueError("a track needs a station, and a station a track")
        if "/" not in self.id and self.seen is not None:
            raise ValueError("only a look has seen")
        if self.pose_of is not None and self.pose is None:
            raise ValueError("a place without a pose has no pose of another")
        return self

    def fields(self) -> PlaceFields:
        """The fields that the owner of the map gave the place."""
        return PlaceFields(
            pose=self.pose,
            timestamp=self.timestamp,
            sequence=self.sequence,
            camera=self.camera,
            level=self.level,
            pose_accuracy=self.pose_accuracy,
            metadata=self.metadata,
        )


Kind = TypeVar("Kind", bound=_Line)

_WITHIN: dict[str, type[BaseModel]] = {
    "pose": Pose,
    "pose_accuracy": PoseAccuracy,
    "picture": Picture,
    "mask": Mask,
    "intrinsics": Intrinsics,
    "answer": AnswerLine,
    "label": ShownLine,
}


def read_line(text: bytes, kind: type[Kind], where: str) -> Kind:
    """One line of a part.

    Raises:
        InvalidArchive: it is not a valid line of this kind.
    """
    value = strict_json(text, where)
    expect_names(value, kind, where)
    for name, inner in _WITHIN.items() if isinstance(value, dict) else ():
        expect_names(value.get(name), inner, f"{where}: {name}")
    try:
        made = kind.model_validate(value)
        if len(text) > MOST_METADATA_BYTES and _size(value.get("metadata")) > MOST_METADATA_BYTES:
            raise InvalidArchive(f"{where}: the metadata has more than {MOST_METADATA_BYTES} bytes.")
        if b"\\u" in text:  # only an escape can hold a lone surrogate, which SQLite cannot store
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise InvalidArchive(f"{where} holds half a character (a lone surrogate).") from None
    except (ValidationError, RecursionError) as error:
        why = validation_message(error) if isinstance(error, ValueError) else "nested too deeply"
        raise InvalidArchive(f"{where}: {why[:400]}.") from None
    return made


def _size(value: Any) -> int:
    return len(json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode())


def written_line(value: dict[str, Any]) -> bytes:
    """A line as it is written."""
    return (json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False) + "\n").encode()
