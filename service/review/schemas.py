"""JSON of frames stored for review and of their labels."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from core.judgement.verdict import Verdict
from core.maps import ReviewFrame
from core.places import Timestamp
from service.http.schemas import Cursor
from service.places.parameters import FlatFields
from service.places.schemas import PlaceView


class ReviewLabel(BaseModel):
    """People's label of a frame; one of place, new and stranger is set."""

    place: str | None = Field(default=None, description="The place that it shows.")
    look: str | None = Field(
        default=None,
        exclude_if=lambda name: name is None,
        description="The look of this place as which it was added; left out if it was not, or is gone again.",
    )
    new: str | None = Field(default=None, description="The place as which it was enrolled.")
    stranger: bool = Field(default=False, description="It shows no place of the map.")


class ReviewFrameView(BaseModel):
    """A frame that is stored for review."""

    id: int
    at: Timestamp = Field(description="The time of the query.")
    sha256: str
    bytes: int
    answer: dict[str, Any] = Field(
        description="How it was answered: `verdict`, `reason`, `probability`, `score`, `decision`, `threshold`, "
        "`best` (id of the best match), `matches` (`place` and `score` of the first five), `revision`; and whose it "
        "was: `camera`, `session`, `frame`, `file`, `operation`, `request_id`, `key`; `taken`, when the robot took "
        "it, if it said so. `proposal`, if a run proposes "
        "the frame as a look: among others `place`, `certainty`, `why`, `run`, `geometry`, `least_score`, `taken`. "
        "`stretch`, if it is of a stretch of new ground."
    )
    label: ReviewLabel | None
    labelled_at: Timestamp | None
    labelled_by: str | None = Field(description="The name of the key with which the label was given.")

    @classmethod
    def of(cls, frame: ReviewFrame) -> ReviewFrameView:
        """The JSON view of a stored frame."""
        label = frame.label
        return cls(
            id=frame.number,
            at=frame.at,
            sha256=frame.digest.hex(),
            bytes=frame.size,
            answer=dict(frame.answer),
            label=None if label is None else ReviewLabel.model_validate(label["label"]),
            labelled_at=None if label is None else label["at"],
            labelled_by=None if label is None else label["by"],
        )


class ReviewPage(BaseModel):
    """Frames stored for review, the newest first."""

    items: list[ReviewFrameView]
    next_cursor: Cursor
    frames: int = Field(description="How many frames are stored.")
    bytes: int = Field(description="The bytes of their files together.")


class NewPlace(FlatFields):
    """The place as which a frame is enrolled."""

    id: str = Field(description="Id of the place.", examples=["p9"])
    metadata: Annotated[dict[str, Any], BeforeValidator(lambda value: {} if value is None else value)] = Field(
        default_factory=dict
    )


class LabelOrder(BaseModel):
    """A label, that it is taken back, or that the frame is thrown away: exactly one of these."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"place": "p7"}, {"place": "p7", "look": True}, {"stranger": True}]},
    )

    place: str | None = Field(default=None, max_length=128, description="It shows this place of the map.")
    look: bool = Field(
        default=False, strict=True, description="With place: it is also added to the looks of the place."
    )
    new: NewPlace | None = Field(default=None, description="It shows a new place, as which it is enrolled.")
    stranger: bool = Field(default=False, strict=True, description="It shows no place of this map.")
    clear: bool = Field(default=False, strict=True, description="Its label is taken back.")
    discard: bool = Field(default=False, strict=True, description="It is thrown away.")

    @model_validator(mode="after")
    def _says_one_thing(self) -> LabelOrder:
        said = [self.place is not None, self.new is not None, self.stranger, self.clear, self.discard]
        if said.count(True) != 1:
            raise ValueError("give exactly one of place, new, stranger, clear and discard")
        if self.look and self.place is None:
            raise ValueError("a look needs the place that it is of")
        return self


class Labelled(BaseModel):
    """The result of a label."""

    id: int
    discarded: bool
    frame: ReviewFrameView | None = Field(description="The frame with its label; null if it was thrown away.")
    enrolled: PlaceView | None = Field(description="The place as which it was enrolled.")


class ExportedLabel(BaseModel):
    """A frame whose place is known."""

    id: int
    at: Timestamp = Field(description="The time of the query.")
    sha256: str
    camera: str | None
    verdict: Verdict = Field(description="How it was answered.")
    place: str | None = Field(description="The place that it shows; null if the map has none.")
    enrolled: bool = Field(description="Whether it was enrolled as this place.")
    labelled_at: Timestamp
    labelled_by: str | None


class LabelList(BaseModel):
    """All labels, the oldest frame first, on one page."""

    items: list[ExportedLabel]
    next_cursor: None = None
