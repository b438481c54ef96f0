"""Answers to queries."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from core.judgement.verdict import Verdict
from service.errors.problems import Problem
from service.http.schemas import IDENTITY_EXAMPLE, Milliseconds
from service.places.schemas import PLACE_EXAMPLE, PlaceView
from service.queries.explanation_schemas import MatchExplanation


class Match(BaseModel):
    """One of the best places."""

    rank: int
    score: float = Field(
        description="J / V, or the cosine of descriptors that are normalized as a whole. If the encoder has a "
        "second stage (`agreement` of its definition), that counts by 1 - `share`, and to the scores of the best "
        "`candidates` by it is added `share` times how far their cells agree with the frame's."
    )
    weight: float | None = Field(
        default=None,
        description="How much what is soft speaks for the place, over 0 and at most 1: the odds of the match are "
        "multiplied by it, and the matches stand in the order that this gives. Null without anything soft.",
    )
    place: PlaceView


class EstimatedPose(BaseModel):
    """Where the frame was taken, from the poses of the best match and of the matches within its `same_place_radius`."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"x": 1.62, "y": 2.0, "heading": 91.5, "spread": 0.6, "heading_spread": 2.1}]}
    )

    x: float | None = Field(default=None, description="Metres in the map's frame, as are y and z.")
    y: float | None = None
    z: float | None = None
    latitude: float | None = Field(default=None, description="Degrees, WGS 84, as is longitude.")
    longitude: float | None = None
    heading: float | None = Field(default=None, description="Degrees, counted as the places' headings are.")
    spread: float = Field(
        description="Standard deviation of the position in metres: of the poses that it is the mean of, and half the "
        "distance from the best match to its nearest neighbour."
    )
    heading_spread: float | None = Field(description="Degrees; null where fewer than two of the places have a heading.")
    places: int = Field(description="How many places it rests on.")

    @model_serializer(mode="wrap")
    def _one_frame(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A pose shows the frame that it is in and nothing of the other."""
        shown: dict[str, Any] = handler(self)
        return {name: value for name, value in shown.items() if value is not None or name == "heading_spread"}


Reason = Literal["no-regions", "empty-map", "no-place-allowed"]


class QueryAnswer(BaseModel):
    """Where a frame was taken, or that it is not known."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "verdict": "recognized",
                    "place": PLACE_EXAMPLE,
                    "probability": 0.99,
                    "pose": {"x": 1.5, "y": 2.0, "heading": 90.0, "spread": 0.9, "heading_spread": None, "places": 1},
                    "score": 0.41,
                    "margin": 0.12,
                    "decision": 0.29,
                    "threshold": 0.09,
                    "reason": None,
                    "matches": [{"rank": 1, "score": 0.41, "place": PLACE_EXAMPLE}],
                    "encoder": IDENTITY_EXAMPLE,
                    "milliseconds": {
                        "wait": 0.1,
                        "decode": 2.9,
                        "forward": 4.6,
                        "regions": 3.1,
                        "vlad": 0.8,
                        "search": 6.2,
                        "total": 19.0,
                    },
                }
            ]
        }
    )

    verdict: Verdict
    place: PlaceView | None = Field(description="Non-null only if recognized.")
    probability: float | None = Field(
        description="That the best match is right, calibrated on frames with known truth; null where there is no "
        "match, or the calibration cannot tell."
    )
    pose: EstimatedPose | None = Field(description="Null unless recognized, and if the place has no pose.")
    score: float | None = Field(description="Score of the best match (see its `score`); null where there is none.")
    margin: float | None = Field(description="Best score minus that of the best rival; null without a rival.")
    decision: float | None = Field(
        description="By how much the best match stands out of the rest of the map: in standard deviations of the other "
        "scores or, if the encoder has a second stage, the geometric mean of its score and its lead."
    )
    threshold: float = Field(description="Least decision value that is believed.")
    reason: Reason | None = Field(default=None, description="Why there is nothing to compare, if so.")
    matches: list[Match]
    explanation: MatchExplanation | None = Field(
        default=None, description="With `explain`: why the best match scores as it does."
    )
    encoder: str
    milliseconds: Milliseconds


class ClosureAnswer(QueryAnswer):
    """Where a frame was taken, and the place that it became if nobody knew it."""

    change: Literal["created", "unchanged"] | None = Field(
        description="created: it was enrolled; unchanged: it had been, by the same request; null: it was not."
    )
    enrolled: PlaceView | None = Field(description="The frame's own place; null if it was not enrolled.")


class BatchAnswer(BaseModel):
    """The answer to one frame of a batch: ``answer`` on success, else ``problem``."""

    file: str = Field(description="Name of the frame's part.")
    status: int
    answer: QueryAnswer | None = None
    problem: Problem | None = None


class BatchAnswers(BaseModel):
    """One answer for each file part, in their order."""

    items: list[BatchAnswer]
    encoder: str
    milliseconds: Milliseconds
