"""The fields of a place beside its frame: in the query string, in form fields, in the JSON of a batch."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from core.clocks import future
from core.names import words
from core.places import Coordinate, Level, PlaceFields, Pose, Sequence, Timestamp, accuracy_of
from service.errors.faults import InvalidRequest
from service.http.bodies import json_size
from service.http.schemas import CameraName, EncoderAssertion, Parameters, validated
from service.http.uploads import parse_metadata
from service.settings import Settings

POSE = ("x", "y", "z", "latitude", "longitude", "heading")


def check_metadata(metadata: dict[str, Any], settings: Settings) -> None:
    """Check that metadata can be stored.

    Raises:
        InvalidRequest: the metadata is too large, or cannot be written as JSON.
    """
    if json_size(metadata, "metadata") > settings.max_metadata_bytes:
        raise InvalidRequest(f"metadata: the value has more than {settings.max_metadata_bytes} bytes.")


def check_taken(taken: datetime | None) -> None:
    """Check that a frame can have been taken at a time.

    Raises:
        InvalidRequest: it is far ahead of this machine's clock.
    """
    if taken is not None and (told := future(taken.timestamp(), time.time())) is not None:
        raise InvalidRequest(f"timestamp: {told}: correct it, or leave it out.")


class PoseParameters(Parameters):
    """A pose, flat."""

    x: Coordinate | None = Field(default=None, description="Metres in the map's frame; with y.", examples=[1.5])
    y: Coordinate | None = Field(default=None, description="Metres in the map's frame; with x.", examples=[2.0])
    z: Coordinate | None = Field(
        default=None,
        description="Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude.",
    )
    latitude: float | None = Field(default=None, ge=-90, le=90, allow_inf_nan=False, description="Degrees, WGS 84.")
    longitude: float | None = Field(default=None, ge=-180, le=180, allow_inf_nan=False, description="Degrees, WGS 84.")
    heading: float | None = Field(
        default=None,
        ge=-360,
        le=360,
        allow_inf_nan=False,
        description="Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude.",
        examples=[90.0],
    )

    def given_pose(self) -> dict[str, float]:
        """The parts of the pose that are given, by name."""
        return {name: value for name in POSE if (value := getattr(self, name)) is not None}


class PlaceDescription(PoseParameters):
    """Pose, time, traverse and storey of a frame, flat."""

    timestamp: Timestamp | None = Field(
        default=None,
        description="When the frame was taken (ISO 8601; UTC without a zone).",
        examples=["2026-11-20T10:00:00Z"],
    )
    sequence: Sequence | None = Field(
        default=None, description="The traverse that the frame belongs to.", examples=["monday"]
    )
    camera: CameraName = None
    level: Level | None = Field(default=None, description="The storey on which the frame was taken.", examples=["2"])


class FlatFields(PlaceDescription):
    """The fields of a place, flat, but for its metadata."""

    accuracy_metres: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        allow_inf_nan=False,
        description="Standard deviation of each coordinate.",
    )
    accuracy_degrees: float | None = Field(
        default=None,
        gt=0,
        le=360,
        allow_inf_nan=False,
        description="Standard deviation of its heading; with accuracy_metres.",
    )

    def fields(self, metadata: dict[str, Any], settings: Settings) -> PlaceFields:
        """The fields of a place with this description.

        Raises:
            InvalidRequest: the pose is incomplete or of both kinds, the time is yet to come, or the metadata cannot be
                stored.
        """
        check_metadata(metadata, settings)
        check_taken(self.timestamp)
        if self.accuracy_degrees is not None and self.accuracy_metres is None:
            raise InvalidRequest("accuracy_degrees: it needs accuracy_metres.")
        pose = self.given_pose()
        return PlaceFields(
            pose=validated(Pose, pose) if pose else None,
            timestamp=self.timestamp,
            sequence=self.sequence,
            camera=self.camera,
            level=self.level,
            pose_accuracy=accuracy_of(self.accuracy_metres, self.accuracy_degrees),
            metadata=metadata,
        )


class EnrolParameters(FlatFields):
    """Beside one frame to enrol."""

    metadata: str | None = Field(default=None, description="A JSON object.", examples=['{"camera": "front"}'])
    encoder: EncoderAssertion = None

    def place_fields(self, settings: Settings) -> PlaceFields:
        """The fields of the place; it raises what ``FlatFields.fields`` raises."""
        metadata = {} if self.metadata is None else parse_metadata(self.metadata)
        return self.fields(metadata, settings)


BatchName = Annotated[Annotated[str, words("a batch", 64)] | None, Field(examples=["monday-17"])]


class BatchParameters(Parameters):
    """Beside many frames to enrol."""

    encoder: EncoderAssertion = None
    background: bool = Field(default=False, description="Answer 202 with a job as soon as all frames are on disk.")
    align: bool = Field(
        default=False,
        description="With background: align the traverses of the form with those that the map has, once all frames "
        "are enrolled, as POST …/align does; the job's result has the reports in `aligned`.",
    )
    most_speed: float | None = Field(
        default=None,
        ge=1,
        le=1e6,
        allow_inf_nan=False,
        description="With background: metres a second of the vehicle at most; 60 if left out. A place is refused with "
        "`implausible-pose` whose pose is reached faster, by the timestamps of its traverse.",
    )
    replace: bool = Field(
        default=True,
        description="Whether a frame replaces the place of another frame that has its id; else it fails alone with 409 "
        "places-taken. The same frame is never one of these.",
    )
    batch: BatchName = Field(
        default=None,
        description="A name for this batch, for example a random one, to which another batch can refer with after.",
    )
    after: BatchName = Field(
        default=None,
        description="The batch of this map after which this one is to be stored. It may still be under way: this one "
        "is encoded meanwhile. If it is not stored in time, the answer is 409 batch-out-of-order, and nothing of "
        "this batch is stored.",
    )

    @model_validator(mode="after")
    def _can_follow(self) -> BatchParameters:
        if self.background and (self.batch, self.after) != (None, None):
            raise ValueError(
                "batch and after cannot be used with background, only in requests that are answered once all is stored"
            )
        if self.align and not self.background:
            raise ValueError("align needs background: it takes longer than a request may wait")
        if self.most_speed is not None and not self.background:
            raise ValueError("most_speed needs background: only there a traverse is judged as a whole")
        if self.batch is not None and self.batch == self.after:
            raise ValueError("a batch cannot come after itself")
        return self


class BatchItem(FlatFields):
    """One place of a batch: its frame is in a part of the form, or is the one that the place already has."""

    id: str = Field(description="Id of the place.", examples=["p7"])
    file: str | None = Field(default=None, description="Name of the file part.", examples=["frame7"])
    sha256: str | None = Field(
        default=None,
        pattern="^[0-9a-f]{64}$",
        description="Instead of a file: the SHA-256 of the frame that the place already has. If it does have it, "
        "only its fields are replaced; otherwise the answer is 409 frame-needed, and the frame has to be sent.",
    )
    metadata: Annotated[dict[str, Any], BeforeValidator(lambda value: {} if value is None else value)] = Field(
        default_factory=dict
    )

    @model_validator(mode="after")
    def _names_its_frame(self) -> BatchItem:
        if (self.file is None) == (self.sha256 is None):
            raise ValueError("give either the name of its part as file, or the digest of its frame as sha256")
        return self
