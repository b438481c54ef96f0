"""Answers to queries."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from core.verdict import Verdict
from service.problems import Problem
from service.schemas.fields import IDENTITY_EXAMPLE, Milliseconds
from service.schemas.places import PLACE_EXAMPLE, PlaceView


class Match(BaseModel):
    """One of the best places."""

    rank: int
    score: float = Field(
        description="J / V, or the cosine of descriptors that are normalized as a whole. If the encoder has a "
        "second stage (`agreement` of its definition), that counts by 1 - `share`, and to the scores of the best "
        "`candidates` by it is added `share` times how far their cells agree with the frame's."
    )
    place: PlaceView


class QueryAnswer(BaseModel):
    """Where a frame was taken, or that it is not known."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "verdict": "recognized",
                    "place": PLACE_EXAMPLE,
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
    score: float | None = Field(description="Score of the best match (see its `score`); null in an empty map.")
    margin: float | None = Field(description="Best score minus that of the best rival; null without a rival.")
    decision: float | None = Field(
        description="By how much the best match stands out of the rest of the map: in standard deviations of the other "
        "scores or, if the encoder has a second stage, the geometric mean of its score and its lead."
    )
    threshold: float = Field(description="Least decision value that is believed.")
    reason: Literal["no-regions", "empty-map"] | None = Field(
        default=None, description="Why there is nothing to compare, if so."
    )
    matches: list[Match]
    encoder: str
    milliseconds: Milliseconds


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
