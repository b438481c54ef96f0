"""Answers of several maps to one moment's frames."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from core.judgement.verdict import Verdict
from service.errors.problems import Problem
from service.http.schemas import Milliseconds
from service.places.schemas import PLACE_EXAMPLE, PlaceView
from service.queries.schemas import EstimatedPose, Reason


class MapMatch(BaseModel):
    """One of the best places of all maps."""

    rank: int
    map: str = Field(description="The map of the place.")
    probability: float | None = Field(
        description="That the match is right, each map's by its own calibration and before the maps are weighed "
        "against each other; the matches stand in its order. Null where the map's calibration cannot tell: such "
        "matches are ranked by how far their decision value is beyond the threshold."
    )
    score: float = Field(description="In units of the map's encoder; not to be compared between maps.")
    weight: float | None = Field(default=None, description="As in the answer of one map.")
    place: PlaceView


class MapAnswer(BaseModel):
    """What became of one map: its own verdict, or the problem that kept it from answering."""

    map: str
    status: int = Field(description="The status that a query to this map alone would have had.")
    verdict: Verdict | None = Field(default=None, description="The map's own, without regard to the others.")
    probability: float | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float | None = None
    reason: Reason | None = Field(default=None, description="Why there is nothing to compare, if so.")
    encoder: str | None = None
    problem: Problem | None = None


class FrameReport(BaseModel):
    """What became of one frame."""

    frame: str = Field(description="Name of the form's part; `image` for a raw body.")
    camera: str | None = Field(description="Whose mask was applied.")
    status: int = Field(description="200, or the status of its problem.")
    regions: int | None = Field(
        default=None, description="Regions of interest found in it; 0: it is blank, and says nothing."
    )
    problem: Problem | None = None


class SeveralAnswer(BaseModel):
    """Where the frames were taken, and in which map, or that it is not known."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "verdict": "recognized",
                    "map": "lab",
                    "place": PLACE_EXAMPLE,
                    "probability": 0.98,
                    "pose": {"x": 1.5, "y": 2.0, "heading": 90.0, "spread": 0.9, "heading_spread": None, "places": 1},
                    "matches": [{"rank": 1, "map": "lab", "probability": 0.99, "score": 0.41, "place": PLACE_EXAMPLE}],
                    "maps": [{"map": "lab", "status": 200, "verdict": "recognized", "probability": 0.99}],
                    "frames": [{"frame": "image", "camera": None, "status": 200, "regions": 600}],
                    "milliseconds": {"total": 31.0},
                }
            ]
        }
    )

    verdict: Verdict
    map: str | None = Field(description="The map of the place; non-null only if recognized.")
    place: PlaceView | None = Field(description="Non-null only if recognized.")
    probability: float | None = Field(
        description="That the best match is right, weighed against the other maps' best, for at most one can be."
    )
    pose: EstimatedPose | None = Field(description="In the frame of the map; null unless recognized.")
    matches: list[MapMatch]
    maps: list[MapAnswer] = Field(description="In the order in which they were named, or by id.")
    frames: list[FrameReport]
    milliseconds: Milliseconds
