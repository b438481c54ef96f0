"""Sessions, beliefs and the parameters of a frame as JSON."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.belief import Odometry, RunOptions, Stride
from core.judgement.verdict import Verdict
from core.places import Sequence, Timestamp
from service.http.fields import Cursor, Milliseconds
from service.http.parameters import CameraName, EncoderAssertion, Matches, Parameters
from service.places.schemas import PLACE_EXAMPLE, PlaceView
from service.queries.schemas import QueryAnswer

SESSION_EXAMPLE: dict[str, Any] = {
    "id": "s-4f2a9c01d37be586",
    "map": "lab",
    "filter": "bayes",
    "advance": 1.0,
    "backwards": False,
    "speed_limit": 1.5,
    "sequences": None,
    "lag": 0,
    "path_frames": 10,
    "camera": None,
    "expires_after": 900.0,
    "created_at": "2026-11-20T10:00:00Z",
    "expires_at": "2026-11-20T10:15:42Z",
    "frames": 27,
    "last_frame": 27,
    "restored": False,
    "frames_lost": None,
}


Motion = Literal["first", "sequence", "speed-limit", "odometry"]


class NewSession(BaseModel):
    """How a run is to be followed."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, json_schema_extra={"examples": [{"filter": "bayes", "speed_limit": 1.5}]}
    )

    filter: Literal["bayes", "path"] = Field(
        default="bayes",
        description="bayes: a hidden Markov model over the places. path: the best straight path through the last "
        "frames, as SeqSLAM searches for; it knows neither odometry nor a speed limit.",
    )
    advance: float = Field(
        strict=True,
        default=1.0,
        ge=0,
        le=100,
        description="Frames of the map's traverse that usually go by from one frame to the next, where neither "
        "odometry nor a speed limit tells more.",
    )
    backwards: bool = Field(
        strict=True, default=False, description="The robot may go against the traverse as readily as with it."
    )
    speed_limit: float | None = Field(
        strict=True,
        default=None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Metres a second; then every frame needs a timestamp. Needs places with poses.",
    )
    sequences: list[Sequence] | None = Field(
        default=None, min_length=1, max_length=100, description="Only the places of these traverses."
    )
    lag: int = Field(
        strict=True,
        default=0,
        ge=0,
        le=20,
        description="Tell once more where the robot was so many frames ago, given all since.",
    )
    path_frames: int = Field(strict=True, default=10, ge=2, le=50, description="Frames of a path; for the filter path.")
    camera: CameraName = None
    expires_after: float | None = Field(
        strict=True,
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="Seconds without a frame after which it ends; at most, and by default, what the service is set to.",
    )

    @model_validator(mode="after")
    def _options_go_together(self) -> NewSession:
        if self.filter == "path" and (self.speed_limit is not None or self.lag):
            raise ValueError("the filter path takes neither a speed limit nor a lag")
        return self

    def run_options(self) -> RunOptions:
        """The options of :class:`core.belief.Run`."""
        return RunOptions(self.filter, Stride(self.advance, self.backwards), self.lag, self.path_frames)


class FrameParameters(Parameters):
    """Beside a frame of a session."""

    frame: int | None = Field(
        default=None,
        ge=0,
        le=2**53,
        description="The robot's own number of the frame, growing. A number missed is a frame that did not arrive; the "
        "last number again is the same frame sent again, and gets the same answer.",
    )
    timestamp: Timestamp | None = Field(
        default=None, description="When the frame was taken; never before the last one."
    )
    forward: float | None = Field(
        default=None,
        ge=-1e5,
        le=1e5,
        allow_inf_nan=False,
        description="Odometry: metres forward since the frame before, in the direction faced then.",
    )
    left: float | None = Field(
        default=None, ge=-1e5, le=1e5, allow_inf_nan=False, description="Odometry: metres to the left; with forward."
    )
    turn: float | None = Field(
        default=None,
        ge=-36000,
        le=36000,
        allow_inf_nan=False,
        description="Odometry: degrees turned counter-clockwise since the frame before; with forward.",
    )
    deviation: float | None = Field(
        default=None, ge=0, le=1e4, allow_inf_nan=False, description="Standard deviation of forward and left, metres."
    )
    turn_deviation: float | None = Field(
        default=None, ge=0, le=360, allow_inf_nan=False, description="Standard deviation of turn, degrees."
    )
    k: Matches = 5
    encoder: EncoderAssertion = None

    @model_validator(mode="after")
    def _odometry_is_whole(self) -> FrameParameters:
        beside = [name for name in ("left", "turn", "deviation", "turn_deviation") if getattr(self, name) is not None]
        if self.forward is None and beside:
            raise ValueError(f"{beside[0]} needs forward beside it")
        return self

    def odometry(self) -> Odometry | None:
        """The odometry of the frame; None if it has none."""
        if self.forward is None:
            return None
        turn, spread = math.radians(self.turn or 0.0), math.radians(self.turn_deviation or 0.0)
        return Odometry(self.forward, self.left or 0.0, turn, (self.deviation or 0.0) ** 2, spread**2)


class BelievedPlace(BaseModel):
    """One place where the robot may be."""

    rank: int
    probability: float = Field(description="Of it and of the places that are the same place.")
    place: PlaceView


class EarlierBelief(BaseModel):
    """Where the robot was some frames ago, given all frames since."""

    frames_ago: int
    verdict: Verdict
    candidates: list[BelievedPlace]


class BeliefView(BaseModel):
    """What is believed of where a robot is."""

    verdict: Verdict = Field(description="recognized: one place, with its neighbours, is at least as probable as not.")
    place: PlaceView | None = Field(description="Non-null only if recognized.")
    probability: float | None = Field(description="Of the best candidate; null if there is none.")
    unknown: float = Field(description="Probability that the robot sees what the map does not show.")
    lost: bool = Field(description="It was recognized in this run, and has not been for five frames or more.")
    candidates: list[BelievedPlace] = Field(description="Distinct places, best first, whatever the verdict.")


class SessionAnswer(BeliefView):
    """What is believed once a frame is seen, and what the frame says alone."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "session": "s-4f2a9c01d37be586",
                    "frame": 27,
                    "frames": 27,
                    "verdict": "recognized",
                    "place": PLACE_EXAMPLE,
                    "probability": 0.97,
                    "unknown": 0.01,
                    "lost": False,
                    "candidates": [{"rank": 1, "probability": 0.97, "place": PLACE_EXAMPLE}],
                    "earlier": None,
                    "motion": "odometry",
                    "repeated": False,
                    "restored": False,
                    "frames_lost": None,
                    "saved": True,
                    "single": {"verdict": "ambiguous", "place": None, "matches": []},
                    "milliseconds": {"belief": 0.6, "total": 19.4},
                }
            ]
        }
    )

    session: str
    frame: int | None = Field(description="The robot's number of the frame.")
    frames: int = Field(description="Frames taken in so far.")
    earlier: EarlierBelief | None = Field(description="With a lag, once there are frames enough.")
    motion: Motion = Field(description="By what the belief was moved on to this frame.")
    repeated: bool = Field(default=False, description="The frame was sent again; it was counted once.")
    restored: bool = Field(description="The session was taken up again after the service had been restarted.")
    frames_lost: int | None = Field(
        description="Frames that the robot had numbered and a restart lost; null while that is not known."
    )
    saved: bool = Field(description="A restart of the service would not lose this frame.")
    single: QueryAnswer = Field(description="The answer to the frame alone.")
    milliseconds: Milliseconds


class SessionView(NewSession):
    """A session as it is listed."""

    model_config = ConfigDict(extra="ignore", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    id: str
    map: str
    created_at: Timestamp
    expires_at: Timestamp
    frames: int = Field(description="Frames taken in so far.")
    last_frame: int | None = Field(description="The robot's number of the last one.")
    restored: bool
    frames_lost: int | None


class SessionReport(SessionView):
    """A session and what is believed now."""

    model_config = ConfigDict(extra="ignore", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    belief: BeliefView


class SessionPage(BaseModel):
    """Sessions of a map in the order of their ids."""

    items: list[SessionView]
    next_cursor: Cursor
