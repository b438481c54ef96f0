"""Sessions, beliefs and the parameters of a frame as JSON."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.belief import Odometry, RunOptions, Sight, Stride
from core.judgement.verdict import Verdict
from core.places import Sequence, Timestamp
from service.http.schemas import CameraName, Cursor, EncoderAssertion, Matches, Milliseconds, Parameters, Verification
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
    """The options of a session."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, json_schema_extra={"examples": [{"filter": "bayes", "speed_limit": 1.5}]}
    )

    filter: Literal["bayes", "path"] = Field(
        default="bayes",
        description="bayes: a hidden Markov model over the places. path: the best straight path through the last "
        "frames, as in SeqSLAM; it uses neither odometry nor a speed limit.",
    )
    advance: float = Field(
        strict=True,
        default=1.0,
        ge=0,
        le=100,
        description="By how many frames of the map's traverse the robot usually moves on from one frame to the next; "
        "used where neither odometry nor a speed limit is given.",
    )
    backwards: bool = Field(
        strict=True, default=False, description="The robot may move against the traverse as well as along it."
    )
    speed_limit: float | None = Field(
        strict=True,
        default=None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Metres per second. Every frame then needs a timestamp, and the places need poses.",
    )
    sequences: list[Sequence] | None = Field(
        default=None, min_length=1, max_length=100, description="Only the places of these traverses."
    )
    lag: int = Field(
        strict=True,
        default=0,
        ge=0,
        le=20,
        description="Also estimate where the robot was so many frames ago, given all frames since.",
    )
    path_frames: int = Field(strict=True, default=10, ge=2, le=50, description="Frames of a path; for the filter path.")
    camera: CameraName = None
    verify: Verification = "auto"
    expires_after: float | None = Field(
        strict=True,
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="Seconds without a frame after which the session ends; the service's setting is the default and "
        "the maximum.",
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
    """The parameters of a frame of a session."""

    frame: int | None = Field(
        default=None,
        ge=0,
        le=2**53,
        description="The robot's own number of the frame; numbers grow. A missing number is a frame that did not "
        "arrive; the last number again is the same frame sent again, and gets the same answer.",
    )
    timestamp: Timestamp | None = Field(
        default=None, description="When the frame was taken; never before the last one."
    )
    forward: float | None = Field(
        default=None,
        ge=-1e5,
        le=1e5,
        allow_inf_nan=False,
        description="Odometry: metres forward since the frame before, in the direction that the robot faced then.",
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
    probability: float = Field(description="The probability of the place and its neighbours that are the same place.")
    place: PlaceView


class EarlierBelief(BaseModel):
    """Where the robot was some frames ago, given all frames since."""

    frames_ago: int
    verdict: Verdict
    candidates: list[BelievedPlace]


class BeliefView(BaseModel):
    """The belief about where a robot is."""

    verdict: Verdict = Field(description="recognized: one place, with its neighbours, is at least as probable as not.")
    place: PlaceView | None = Field(description="Non-null only if recognized.")
    probability: float | None = Field(description="The probability of the best candidate; null if there is none.")
    unknown: float = Field(description="The probability that the robot is at a place that the map does not have.")
    lost: bool = Field(description="The robot was recognized in this session, but not in the last five frames or more.")
    candidates: list[BelievedPlace] = Field(description="Distinct places, best first, with any verdict.")


class SessionAnswer(BeliefView):
    """The belief after a frame, and the answer to the frame alone."""

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
                    "view": None,
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
    frames: int = Field(description="How many frames the session has processed.")
    earlier: EarlierBelief | None = Field(description="With a lag, once there are enough frames.")
    motion: Motion = Field(description="How the robot's motion since the last frame was known.")
    view: Sight | None = Field(
        default=None,
        description="Why the frame does not count. covered: it shows hardly anything, as behind a covered lens. "
        "constant: it shows the same as the last frame that counted; without odometry the robot is taken to stand. "
        "After three covered frames the verdict is unknown, as after three constant ones that do not fit the map. "
        "Null: the frame counts.",
    )
    repeated: bool = Field(default=False, description="The frame was sent again, and counts once.")
    restored: bool = Field(description="The session was restored after a restart of the service.")
    frames_lost: int | None = Field(
        description="How many numbered frames were lost by a restart; null while this is not known."
    )
    saved: bool = Field(description="The frame is on disk: a restart of the service would not lose it.")
    single: QueryAnswer = Field(description="The answer to the frame alone.")
    milliseconds: Milliseconds


class SessionView(NewSession):
    """A session as it is listed."""

    model_config = ConfigDict(extra="ignore", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    id: str
    map: str
    created_at: Timestamp
    expires_at: Timestamp
    frames: int = Field(description="How many frames the session has processed.")
    last_frame: int | None = Field(description="The robot's number of the last frame.")
    restored: bool
    frames_lost: int | None


class SessionReport(SessionView):
    """A session and its present belief."""

    model_config = ConfigDict(extra="ignore", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    belief: BeliefView


class SessionPage(BaseModel):
    """Sessions of a map in the order of their ids."""

    items: list[SessionView]
    next_cursor: Cursor
