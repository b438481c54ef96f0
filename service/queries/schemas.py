"""Answers to queries as JSON."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    SerializerFunctionWrapHandler,
    model_serializer,
)
from pydantic.json_schema import JsonSchemaValue

from core.judgement.change import ChangeVerdict, WorldChange
from core.judgement.position import PoseSource
from core.judgement.verdict import Verdict
from core.recognition.verification import VerificationState
from service.errors.problems import Problem
from service.http.schemas import IDENTITY_EXAMPLE, Milliseconds
from service.places.schemas import PLACE_EXAMPLE, PlaceView


class RelativeBox(BaseModel):
    """A box in shares of the upright frame's width and height."""

    left: float
    top: float
    right: float
    bottom: float


class ExplainedRegion(BaseModel):
    """A region of interest and its share in the score."""

    layer: str
    word: int = Field(description="The word of the vocabulary that it was assigned to.")
    box: RelativeBox
    loss: float = Field(description="By how much the score would be lower without the region.")


class RegionPair(BaseModel):
    """Two regions of one word that are each other's nearest neighbours: their positions in the two lists."""

    query: int
    match: int


class CellPair(BaseModel):
    """Two cells that are each other's best match: row and column of each in `grid`."""

    query: tuple[int, int]
    match: tuple[int, int]
    gain: float = Field(description="The pair's contribution to the score.")


class KeypointPair(BaseModel):
    """Two keypoints that match and fit one rigid scene: (x, y) of each in shares of its frame's width and height."""

    query: tuple[float, float]
    match: tuple[float, float]


class ExplanationView(BaseModel):
    """The parts of a score, which is the sum of `words` and of the gains of all `cells`."""

    score: float
    words: list[float] = Field(description="The share of each word of the vocabulary (j_u, as it counts in the score).")
    query_regions: list[ExplainedRegion] = Field(description="The regions with the largest loss, largest first.")
    match_regions: list[ExplainedRegion] | None = Field(
        description="The same for the other frame; null if the map stores no picture of it."
    )
    regions: list[RegionPair] = Field(description="The matching regions among those listed.")
    cells: list[CellPair] = Field(description="The matching cells; empty without a second stage.")
    grid: tuple[int, int] = Field(description="Rows and columns of the cells; (0, 0) without a second stage.")


class MatchExplanation(ExplanationView):
    """Why a query's best match scores as it does."""

    place: str = Field(description="Id of the best match.")
    inliers: list[KeypointPair] = Field(
        default_factory=list, description="The results of geometric verification; empty if the match was not verified."
    )
    match_picture: str = Field(
        description="The picture from which the regions of the match were extracted again: image, thumbnail (which is "
        "smaller than the enrolled frame, so they may differ a little), or none."
    )
    picture: str | None = Field(
        description="Path of a PNG with both frames side by side and lines between the inliers or, where there are "
        "fewer than eight, between the cells; valid for some minutes; null if the map stores no "
        "picture of the match."
    )


class ScoreParts(BaseModel):
    """The parts of a match's score: it is the sum of `similarity`, `agreement` and, if not null, `geometry`."""

    similarity: float = Field(
        description="J / V, or the cosine of descriptors that are normalized as a whole; weighted by 1 - `share` if "
        "the encoder has a second stage (`agreement` in its definition)."
    )
    agreement: float = Field(
        description="`share` times the agreement of cells; 0 for a place that the second stage has not examined."
    )
    geometry: float | None = Field(
        default=None,
        description="If more than the best match was verified: 0.75 times the share of inliers (`inliers` / "
        "`keypoints`) and, for an encoder with a second stage, `similarity` less half of `agreement`, for geometry "
        "says better what cells say; 0 if the best match alone was verified. Null if none was.",
    )
    inliers: int | None = Field(
        description="Keypoints of both frames that match and fit one rigid scene; null if the match was not verified."
    )
    keypoints: int | None = Field(description="How many could: the keypoints of the frame that has fewer.")
    evidence: float | None = Field(
        description="How surprising these inliers would be of unrelated frames: minus the logarithm of the number "
        "of false alarms, at least 0."
    )


class Match(BaseModel):
    """One of the best places."""

    rank: int
    score: float = Field(
        description="J / V, or the cosine of descriptors that are normalized as a whole. If the encoder has a "
        "second stage (`agreement` in its definition), this is weighted by 1 - `share`, and `share` times the "
        "agreement of cells is added to the scores of the best `candidates`. Where candidates were verified, geometry "
        "changes it (see `parts`). Without soft parameters the matches are in the order of their scores."
    )
    parts: ScoreParts | None = Field(default=None, description="Null where several frames were judged as one.")
    weight: float | None = Field(
        default=None,
        description="The weight of the priors, over 0 and at most 1: the odds of the match are multiplied by it, and "
        "the matches are ordered by the result. Null without soft parameters.",
    )
    place: PlaceView


class VerificationView(BaseModel):
    """Whether the geometry of the best candidates was verified."""

    state: VerificationState = Field(
        description="verified; not-needed: with `auto`, the scores settle the answer; no-keypoints: the best "
        "match by the scores has none, or the frame too few to say anything, so the scores decide alone; never: it was "
        "not requested."
    )
    candidates: int = Field(description="How many places were verified.")
    keypoints: int | None = Field(description="Keypoints of the frame; null if they were not needed.")


POSE_EXAMPLE: dict[str, Any] = {
    "x": 1.62,
    "y": 2.0,
    "heading": 91.5,
    "spread": 0.36,
    "heading_spread": 2.3,
    "places": 2,
    "heading_offset": 1.5,
    "offset_spread": 0.9,
    "source": "intrinsics",
    "covariance": [
        *(0.09, 0.01, 0.0, 0.0, 0.0, 0.001),
        *(0.01, 0.04, 0.0, 0.0, 0.0, 0.002),
        *(0.0, 0.0, 1e6, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 3.29, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, 3.29, 0.0),
        *(0.001, 0.002, 0.0, 0.0, 0.0, 0.0016),
    ],
}


class EstimatedPose(BaseModel):
    """Where the frame was taken, from the poses of the best match and of the matches within its `same_place_radius`,
    and from how the camera stood to theirs where places were verified."""

    model_config = ConfigDict(json_schema_extra={"examples": [POSE_EXAMPLE]})

    x: float | None = Field(default=None, description="Metres in the map's frame, as is y.")
    y: float | None = None
    z: float | None = Field(
        default=None,
        description="Metres: in the map's frame beside x and y; beside a latitude that of the best match, above the "
        "ellipsoid of WGS 84. Left out if the best match has none.",
    )
    latitude: float | None = Field(default=None, description="Degrees, WGS 84, as is longitude.")
    longitude: float | None = None
    heading: float | None = Field(default=None, description="Degrees, counted as the places' headings are.")
    spread: float = Field(
        description="Standard deviation of the position in metres. With the source `places`: of the poses that it is "
        "the mean of, and half the distance from the best match to its neighbour in its traverse: at most 8 m, or half "
        "of `same_place_radius` if that is more."
    )
    heading_spread: float | None = Field(
        description="Degrees: the standard deviation of the heading. With the source `places`: of the headings of "
        "places, null where fewer than two have one."
    )
    places: int = Field(description="How many places the estimate rests on.")
    heading_offset: float | None = Field(
        default=None,
        description="Degrees by which the camera was turned from where that of the best match looked, counted as "
        "headings are; left out if the best match was not verified.",
    )
    offset_spread: float | None = Field(default=None, description="Degrees: the standard deviation of the offset.")
    source: PoseSource = Field(
        default="places",
        description="The basis of the covariance: the poses of `places` alone, or also the turn and the shift between "
        "the pictures by the cameras' `intrinsics` or, where one has none, the turn alone, by an assumed range of "
        "`field-of-view`.",
    )
    note: str | None = Field(
        default=None, description="Why the intrinsics of the frame's camera were not used; left out if they were."
    )
    covariance: list[float] = Field(
        min_length=36,
        max_length=36,
        description="6 x 6, row by row, as in ROS: of errors in x, y, z (metres) and of rotations about x, y and z "
        "(radians), in the map's frame or, beside latitude and longitude, in that of east, north and up. The rotation "
        "about z is counter-clockwise, also where headings are clockwise. An unknown value has a large variance.",
    )

    @model_serializer(mode="wrap")
    def _one_frame(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the coordinates that are not given: a pose is either metric or geographic."""
        shown: dict[str, Any] = handler(self)
        return {name: value for name, value in shown.items() if value is not None or name == "heading_spread"}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The schema of the fields, which the serializer above would hide."""
        fields: Any = {name: value for name, value in core_schema.items() if name != "serialization"}
        return handler(fields)


class RivalGroup(BaseModel):
    """Places that prevent the recognition of an answer, as one."""

    places: list[str] = Field(description="Ids, best first; of each place and its neighbours the best.")
    score: float = Field(description="Score of the first.")
    same_place: bool = Field(
        description="Whether they show the place of the best match, such as another traverse's view of it. Otherwise "
        "it is another place that looks like the frame."
    )


Reason = Literal["no-regions", "few-values", "empty-map", "no-place-allowed"]
NO_MATCHES = (
    "Why there are no matches, if so. `few-values`: the frame has 16 bits, of which it uses so few values that its "
    "upper 8 bits show nothing; its camera in the map needs a `value_range`."
)

CHANGE_EXAMPLE: dict[str, Any] = {"verdict": "known", "known": 0.93, "changed": 0.06, "new": 0.01}


class ChangeView(BaseModel):
    """Whether a frame shows the map as it is, as it was, or something that the map does not have."""

    model_config = ConfigDict(json_schema_extra={"examples": [CHANGE_EXAMPLE]})

    verdict: ChangeVerdict = Field(
        description="`new` where its probability is 0.5 at least; else the more probable of `known` and `changed`."
    )
    known: float = Field(description="The probability that it shows a place of the map as one of its looks does.")
    changed: float = Field(description="The probability that it shows one that looks different from all of them.")
    new: float = Field(description="The probability that it shows no place of the map. The three sum to 1.")

    @classmethod
    def of(cls, found: WorldChange | None) -> ChangeView | None:
        """The JSON view of a change."""
        if found is None:
            return None
        return cls(verdict=found.verdict, known=found.known, changed=found.changed, new=found.new)


class QueryAnswer(BaseModel):
    """Where a frame was taken, or that this is not known."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "verdict": "recognized",
                    "place": PLACE_EXAMPLE,
                    "probability": 0.99,
                    "change": CHANGE_EXAMPLE,
                    "pose": POSE_EXAMPLE,
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
        description="The probability that the best match is right, calibrated on frames with known truth; null if "
        "there is no match, or if the calibration gives no probabilities."
    )
    change: ChangeView | None = Field(
        default=None,
        description="Whether the frame shows the map as it is; its place, if it is known or changed, is the best "
        "match, as surely as `probability` says. Null where `probability` is, and for a rig.",
    )
    pose: EstimatedPose | None = Field(description="Null unless recognized, or if the place has no pose.")
    score: float | None = Field(description="Score of the best match (see its `score`); null if there is none.")
    margin: float | None = Field(description="Best score minus that of the best rival; null without a rival.")
    decision: float | None = Field(
        description="By how much the best match stands out from the rest of the map: the geometric mean of its score "
        "by the first two stages and its lead in it; less than 0 where it is behind the expectation for a small map."
    )
    threshold: float = Field(
        description="The least decision value at which the best match can be recognized. A match that was verified is "
        "recognized by its probability instead."
    )
    reason: Reason | None = Field(default=None, description=NO_MATCHES)
    note: str | None = Field(
        default=None,
        exclude_if=lambda note: note is None,
        description="That the frame shows a narrower or a wider view than the map: by 1.25 or more times, by the "
        "intrinsics of both cameras, or because it fits the map so. Left out where that is not so, or not known.",
    )
    matches: list[Match]
    rivals: list[RivalGroup] = Field(
        default_factory=list, description="Why the answer is ambiguous; empty for other verdicts."
    )
    verification: VerificationView | None = Field(
        default=None, description="Whether the geometry of the best candidates was verified; null without matches."
    )
    revision: int | None = Field(default=None, description="The map's revision.")
    explanation: MatchExplanation | None = Field(
        default=None, description="With `explain`: the explanation of the best match's score."
    )
    encoder: str
    milliseconds: Milliseconds


class ClosureAnswer(QueryAnswer):
    """Where a frame was taken, and the new place if it was unknown."""

    enrolment: Literal["created", "unchanged"] | None = Field(
        description="created: the frame was enrolled; unchanged: an earlier, equal request had enrolled it; null: it "
        "was not enrolled."
    )
    enrolled: PlaceView | None = Field(description="The frame's own place; null if the frame was not enrolled.")


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


class MapMatch(BaseModel):
    """One of the best places of all maps."""

    rank: int
    map: str = Field(description="The map of the place.")
    probability: float | None = Field(
        description="The probability that the match is right, by its map's calibration and before the maps are weighed "
        "against each other; the matches are ordered by it. Null if the map's calibration gives no probabilities: such "
        "matches are ranked by how far their decision value exceeds the threshold."
    )
    score: float = Field(description="The score by the map's encoder; scores of different maps cannot be compared.")
    weight: float | None = Field(default=None, description="See the answer of a single map.")
    place: PlaceView


class MapAnswer(BaseModel):
    """The answer of one map: its own verdict, or the problem that prevented it."""

    map: str
    status: int = Field(description="The status that a query of this map alone would have had.")
    verdict: Verdict | None = Field(default=None, description="The map's own verdict, regardless of the other maps.")
    probability: float | None = None
    change: ChangeView | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float | None = None
    reason: Reason | None = Field(default=None, description=NO_MATCHES)
    verification: VerificationView | None = None
    rivals: list[RivalGroup] = Field(default_factory=list, description="Why the map's own verdict is `ambiguous`.")
    revision: int | None = None
    encoder: str | None = None
    problem: Problem | None = None


class FrameReport(BaseModel):
    """The status of one frame."""

    frame: str = Field(description="Name of the form's part; `image` for a raw body.")
    camera: str | None = Field(description="The camera whose mask was applied.")
    status: int = Field(description="200, or the status of the frame's problem.")
    regions: int | None = Field(
        default=None, description="How many regions of interest the frame has; a blank frame has 0 and is ignored."
    )
    problem: Problem | None = None


class SeveralAnswer(BaseModel):
    """Where the frames were taken, and in which map, or that this is not known."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "verdict": "recognized",
                    "map": "lab",
                    "place": PLACE_EXAMPLE,
                    "probability": 0.98,
                    "pose": POSE_EXAMPLE,
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
        description="The probability that the best match is right, given the best matches of the other maps, of which "
        "at most one can be right."
    )
    pose: EstimatedPose | None = Field(description="In the frame of the map; null unless recognized.")
    matches: list[MapMatch]
    maps: list[MapAnswer] = Field(description="In the order in which the maps were named, or by id.")
    frames: list[FrameReport]
    milliseconds: Milliseconds
