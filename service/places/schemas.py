"""Places and traverses as JSON."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer

from core.maps import Change, Keep, SequenceSummary
from core.places import Level, Place, Pose, PoseAccuracy, Sequence, Timestamp
from service.errors.problems import Problem
from service.http.schemas import IDENTITY_EXAMPLE, Cursor, Milliseconds

PLACE_EXAMPLE: dict[str, Any] = {
    "id": "p7",
    "pose": {"x": 1.5, "y": 2.0, "heading": 90.0},
    "pose_of": None,
    "timestamp": "2026-11-20T10:00:00Z",
    "sequence": "monday",
    "camera": None,
    "level": "2",
    "pose_accuracy": {"metres": 0.2, "degrees": None},
    "metadata": {"camera": "front"},
    "regions": 600,
    "picture": "thumbnail",
    "created_at": "2026-11-20T10:00:01.250000Z",
    "updated_at": "2026-11-20T10:00:01.250000Z",
}

# A pose has either metric or geographic coordinates; those of the other kind are left out.
ShownPose = Annotated[Pose, PlainSerializer(lambda pose: pose.model_dump(exclude_none=True))]


class PlaceView(BaseModel):
    """One enrolled place."""

    model_config = ConfigDict(json_schema_extra={"examples": [PLACE_EXAMPLE]})

    id: str
    pose: ShownPose | None
    pose_of: str | None = Field(description="The place whose pose it got from an alignment; null: the pose is its own.")
    timestamp: Timestamp | None = Field(description="When the frame was taken.")
    sequence: str | None = Field(description="The traverse that it belongs to.")
    camera: str | None = Field(description="The camera whose mask was applied to the frame.")
    level: str | None = Field(default=None, description="The storey on which it is; null: not known.")
    pose_accuracy: PoseAccuracy | None = Field(
        default=None, description="Standard deviations of its pose; null: not stated."
    )
    metadata: dict[str, Any]
    regions: int = Field(description="Regions of interest found in the frame.")
    picture: Keep = Field(description="The picture that is stored of the frame.")
    look: str | None = Field(
        default=None,
        exclude_if=lambda name: name is None,
        description="In a match: the look whose frame it is, with its camera, regions and picture; left out for the "
        "frame with which the place was enrolled.",
    )
    looks: int = Field(
        default=0, exclude_if=lambda count: count == 0, description="How many looks it has besides its first."
    )
    created_at: Timestamp
    updated_at: Timestamp

    @classmethod
    def of(cls, place: Place) -> PlaceView:
        """The JSON view of a place."""
        return cls.model_construct(**place.__dict__)


class EnrolledPlace(PlaceView):
    """A place after a PUT."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                PLACE_EXAMPLE
                | {
                    "change": "created",
                    "encoder": IDENTITY_EXAMPLE,
                    "milliseconds": {"wait": 0.1, "decode": 2.9, "forward": 4.6, "regions": 3.1, "vlad": 0.8},
                }
            ]
        }
    )

    change: Change = Field(description="updated: new fields; replaced: a new picture; unchanged: neither.")
    encoder: str = Field(description="Identity of the map's encoder.")
    milliseconds: Milliseconds


class PlacePage(BaseModel):
    """Places in the order of their ids."""

    items: list[PlaceView]
    next_cursor: Cursor


class PoseChanges(BaseModel):
    """Part of a pose; null removes a coordinate."""

    model_config = ConfigDict(extra="forbid")

    x: float | None = None
    y: float | None = None
    z: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    heading: float | None = None


class PlaceChanges(BaseModel):
    """A merge patch (RFC 7396) of a place: null clears a field, and fields that are left out stay."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"pose": {"heading": 180}, "sequence": None, "metadata": {"door": "open"}}]},
    )

    pose: PoseChanges | None = None
    timestamp: Timestamp | None = None
    sequence: Sequence | None = None
    level: Level | None = Field(default=None, description="Null: the one that the metadata states, if any.")
    pose_accuracy: PoseAccuracy | None = None
    metadata: dict[str, Any] | None = None


class BatchResult(BaseModel):
    """The result for one place of a batch: ``place`` on success, else ``problem``."""

    id: str | None = Field(description="The id as it was given; null if it was not a text.")
    status: int = Field(description="The status that a PUT of the place would have had.")
    change: Change | None = None
    place: PlaceView | None = None
    problem: Problem | None = None


class BatchResults(BaseModel):
    """One result for each entry of ``places``, in its order."""

    items: list[BatchResult]
    encoder: str


class SequencePage(BaseModel):
    """Traverses in the order of their names."""

    items: list[SequenceSummary]
    next_cursor: Cursor


class DeletedSequence(BaseModel):
    """A deleted traverse."""

    name: str
    places: int = Field(description="How many places were deleted with it.")
