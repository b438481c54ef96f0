"""Sessions, beliefs and the parameters of a frame as JSON."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from core.belief import ContradictionKind, Odometry, OdometryPose, RunOptions, Sight, Stride
from core.belief.storeys import Storey
from core.clocks import Stamp
from core.judgement.verdict import Verdict
from core.numerals import check_numeral
from core.places import Coordinate, Level, Sequence, Timestamp, level_code
from service.http.schemas import CameraName, Cursor, EncoderAssertion, Matches, Milliseconds, Parameters, Verification
from service.places.schemas import PLACE_EXAMPLE, PlaceView
from service.queries.schemas import ChangeView, QueryAnswer

SESSION_EXAMPLE: dict[str, Any] = {
    "id": "s-4f2a9c01d37be586",
    "map": "lab",
    "advance": None,
    "backwards": False,
    "speed_limit": 1.5,
    "sequences": None,
    "lag": 0,
    "camera": None,
    "expires_after": 900.0,
    "created_at": "2026-11-20T10:00:00Z",
    "expires_at": "2026-11-20T10:15:42Z",
    "frames": 27,
    "last_frame": 27,
    "last_frame_at": "2026-11-20T10:00:42Z",
    "key": "fleet-7",
    "restored": False,
    "frames_lost": None,
    "contradiction": None,
    "contradiction_note": None,
    "teaches_nothing": None,
}


LARGEST_COVARIANCE = 1e12
"""The most that an entry of a covariance of odometry may be, in metres and radians."""

RETIRED = ("filter", "path_frames")
"""Options of sessions before there was one filter."""

Motion = Literal["first", "sequence", "speed-limit", "odometry", "contradicted"]

CONTRADICTION = (
    "What odometry looks like beside frames that are recognized by themselves, while these contradict it: frozen, of "
    "another scale, turned, in other units, or inconsistent; null: nothing speaks against it."
)
CONTRADICTION_NOTE = "A sentence for a person on what is wrong with odometry; null while nothing is."


class NewSession(BaseModel):
    """The options of a session."""

    model_config = ConfigDict(extra="forbid", frozen=True, json_schema_extra={"examples": [{"speed_limit": 1.5}]})

    advance: float | None = Field(
        strict=True,
        default=None,
        ge=0,
        le=100,
        description="By how many frames of the map's traverse the robot usually moves on from one frame to the next; "
        "used where neither odometry nor a speed limit is given. By default it is not known: the session learns how "
        "fast the robot goes, up to ten frames, and whether it stands or goes in reverse.",
    )
    backwards: bool = Field(
        strict=True,
        default=False,
        description="With advance: the robot may move against the traverse as well as along it; without, it may "
        "anyway.",
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
        description="Also estimate where the robot was this number of frames ago, given all frames since.",
    )
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

    @model_validator(mode="before")
    @classmethod
    def _one_filter(cls, options: object) -> object:
        for name in RETIRED:
            if isinstance(options, dict) and name in options:
                raise ValueError(f"there is no option {name} any more: every session follows its robot by one filter")
        return options

    def run_options(self) -> RunOptions:
        """The options of :class:`core.belief.Run`."""
        return RunOptions(None if self.advance is None else Stride(self.advance, self.backwards), self.lag)


class FrameParameters(Parameters):
    """The parameters of a frame of a session."""

    frame: int | None = Field(
        default=None,
        ge=0,
        le=2**53,
        description="The robot's own number of the frame; numbers grow. A missing number is a frame that did not "
        "arrive; the last number again is the same frame sent again, and gets the same answer. A smaller one is "
        "refused, unless it is smaller by more than 1000, or the timestamp says that the robot counts anew.",
    )
    timestamp: Timestamp | None = Field(
        default=None,
        description="When the frame was taken. One up to a second before the last one is refused; where it goes back "
        "by more, or leaps ahead by more than a day, the robot's clock was set, and the run goes on by it.",
    )
    forward: float | None = Field(
        default=None,
        ge=-1e5,
        le=1e5,
        allow_inf_nan=False,
        description="Odometry: metres forward since the last frame that the service took in, in the direction that the "
        "robot faced then.",
    )
    left: float | None = Field(
        default=None, ge=-1e5, le=1e5, allow_inf_nan=False, description="Odometry: metres to the left; with forward."
    )
    turn: float | None = Field(
        default=None,
        ge=-36000,
        le=36000,
        allow_inf_nan=False,
        description="Odometry: degrees turned counter-clockwise since the last frame that the service took in; with "
        "forward.",
    )
    deviation: float | None = Field(
        default=None, ge=0, le=1e4, allow_inf_nan=False, description="Standard deviation of forward and left, metres."
    )
    turn_deviation: float | None = Field(
        default=None, ge=0, le=360, allow_inf_nan=False, description="Standard deviation of turn, degrees."
    )
    odometry_x: float | None = Field(
        default=None,
        ge=-1e8,
        le=1e8,
        allow_inf_nan=False,
        description="Where odometry says that the robot is, in metres in odometry's own frame; instead of forward. "
        "The service takes the motion since the last frame that it took in from it, so that none is lost or counted "
        "twice.",
    )
    odometry_y: float | None = Field(
        default=None, ge=-1e8, le=1e8, allow_inf_nan=False, description="Metres in odometry's frame; with odometry_x."
    )
    odometry_heading: float | None = Field(
        default=None,
        ge=-360,
        le=360,
        allow_inf_nan=False,
        description="Degrees counter-clockwise from +x of odometry's frame to where the camera looks, -360 to 360; "
        "with odometry_x.",
    )
    odometry_covariance: str | None = Field(
        default=None,
        max_length=512,
        description="The covariance of odometry_x, odometry_y and odometry_heading: nine numbers row by row, separated "
        "by commas, in metres and radians as in ROS; its growth is that of the motion.",
    )
    odometry_origin: str | None = Field(
        default=None,
        max_length=128,
        description="A name for where odometry began. If the frame before had another one, the motion between the two "
        "is not known.",
    )
    level: Level | None = Field(
        default=None,
        description="The storey on which the robot is, as far as it knows: a prior, which holds until another one is "
        "stated. Where another is, the robot has come there by a lift.",
    )
    height: Coordinate | None = Field(
        default=None,
        description="Metres, by a barometer for example: where it leaps by more than the map's same_place_height, the "
        "robot is on another storey; nothing else of it counts.",
    )
    k: Matches = 5
    encoder: EncoderAssertion = None

    @model_validator(mode="after")
    def _odometry_is_whole(self) -> FrameParameters:
        for first, needed, others in (
            ("forward", (), ("left", "turn", "deviation", "turn_deviation")),
            ("odometry_x", ("odometry_y", "odometry_heading"), ("odometry_covariance", "odometry_origin")),
        ):
            given = [name for name in (*needed, *others) if getattr(self, name) is not None]
            if getattr(self, first) is None and given:
                raise ValueError(f"{given[0]} needs {first} beside it")
            if getattr(self, first) is not None and (absent := [name for name in needed if name not in given]):
                raise ValueError(f"{first} needs {absent[0]} beside it")
        if self.forward is not None and self.odometry_x is not None:
            raise ValueError("forward and odometry_x give the motion in two ways; give one of them")
        return self

    @field_validator("odometry_covariance")
    @classmethod
    def _covariance_is_one(cls, text: str | None) -> str | None:
        if text is not None and _covariance(text) is None:
            raise ValueError("the value is not nine numbers of a symmetric matrix without negative variances")
        return text

    def stamp(self) -> Stamp:
        """When the frame was taken, and its number."""
        return Stamp(None if self.timestamp is None else self.timestamp.timestamp(), self.frame)

    def storey(self) -> Storey:
        """What the frame states of the robot's storey."""
        return Storey(level_code(self.level), self.height)

    def odometry(self) -> Odometry | None:
        """The odometry of the frame; None if it has none."""
        if self.forward is None:
            return None
        turn, spread = math.radians(self.turn or 0.0), math.radians(self.turn_deviation or 0.0)
        return Odometry(self.forward, self.left or 0.0, turn, (self.deviation or 0.0) ** 2, spread**2)

    def odometry_pose(self) -> OdometryPose | None:
        """Where odometry says that the robot is; None if the frame does not say."""
        x, y, heading, text = self.odometry_x, self.odometry_y, self.odometry_heading, self.odometry_covariance
        if x is None or y is None or heading is None:
            return None
        covariance = None if text is None else _covariance(text)
        return OdometryPose(x, y, math.radians(heading), covariance, self.odometry_origin)


def _covariance(text: str) -> tuple[float, ...] | None:
    """The nine numbers of a covariance, row by row; None if they are none."""
    try:
        numbers = tuple(float(str(check_numeral(part.strip().removeprefix("+")))) for part in text.split(","))
    except ValueError:
        return None
    if len(numbers) != 9 or not all(abs(number) <= LARGEST_COVARIANCE for number in numbers):
        return None
    mirrored = ((1, 3), (2, 6), (5, 7))
    alike = all(math.isclose(numbers[one], numbers[other], rel_tol=1e-6, abs_tol=1e-9) for one, other in mirrored)
    return numbers if alike and min(numbers[0], numbers[4], numbers[8]) >= 0 else None


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

    verdict: Verdict = Field(
        description="recognized: one place, with its neighbours, is at least as probable as not, and twice as probable "
        "as any other."
    )
    place: PlaceView | None = Field(description="Non-null only if recognized.")
    probability: float | None = Field(
        description="The probability of the best candidate, by the run, or by this frame alone if that is surer; null "
        "if there is none."
    )
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
                    "change": {"verdict": "changed", "known": 0.12, "changed": 0.87, "new": 0.01},
                    "earlier": None,
                    "motion": "odometry",
                    "contradiction": None,
                    "contradiction_note": None,
                    "note": None,
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
    change: ChangeView | None = Field(
        default=None,
        description="Whether the frame shows the map as it is, by the run: the robot may be sure of a place that the "
        "frame alone does not show as any look of it does. Null for a covered frame, and where that of `single` is.",
    )
    earlier: EarlierBelief | None = Field(description="With a lag, once there are enough frames.")
    motion: Motion = Field(
        description="How the motion since the last frame was known. contradicted: odometry contradicts what "
        "frames show, so that it does not count."
    )
    contradiction: ContradictionKind | None = Field(default=None, description=CONTRADICTION)
    contradiction_note: str | None = Field(default=None, description=CONTRADICTION_NOTE)
    note: str | None = Field(
        default=None,
        description="That the robot's clock or its counter of frames has jumped, so that the motion is not known and "
        "the belief is wide; or that the frame's timestamp is more than a day ahead of the service's clock, so that it "
        "counts within the run alone. In words; null where time goes on as it should.",
    )
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
    last_frame_at: Timestamp | None = Field(description="When the last frame came; null before the first.")
    key: str | None = Field(
        description="The name of the key that began the session; null without one. Only for keys of the role enrol."
    )
    restored: bool
    frames_lost: int | None
    contradiction: ContradictionKind | None = Field(
        default=None, description=CONTRADICTION + " Null also where a service has not read the session yet."
    )
    contradiction_note: str | None = Field(default=None, description=CONTRADICTION_NOTE)
    teaches_nothing: str | None = Field(
        default=None,
        description="Why the run teaches its map nothing so far, although the map learns: no frame has odometry's pose "
        "that frames do not contradict. In words; null: it may teach, or the map does not learn from it.",
    )


class SessionReport(SessionView):
    """A session and its present belief."""

    model_config = ConfigDict(extra="ignore", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    belief: BeliefView


class SessionPage(BaseModel):
    """Sessions of a map in the order of their ids."""

    items: list[SessionView]
    next_cursor: Cursor
