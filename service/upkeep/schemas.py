"""JSON of re-encoding, pruning and merging maps, and of the report on their health."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.maps import AlarmName
from core.names import words
from core.places import Sequence, Timestamp
from core.upkeep.coverage import Measure
from core.upkeep.revisits import Reason
from service.http.schemas import Milliseconds
from service.places.filters import MOST_DELETED, PlaceConditions

Share = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)]


class Erasing(BaseModel):
    """Which frames are erased; without any, what places that were deleted before have left."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"filter": {"sequence": "monday"}}, {"ids": ["p7"]}, {"session": "S1"}, {}]},
    )

    ids: list[Annotated[str, Field(max_length=145)]] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_DELETED,
        description="Places of these ids, with their looks; `p7/8f3a0c52d41b9e07` is one look of `p7`.",
    )
    filter: PlaceConditions | None = Field(
        default=None,
        description="Places that fulfil these conditions, at least one. With a time or a camera, and no traverse or "
        "metadata, also looks, frames for review, answers and notes of runs of that time and camera.",
    )
    session: str | None = Field(
        default=None,
        max_length=128,
        description="Frames for review, answers and notes of this session, which ends, and the looks that the map has "
        "learnt from it; also if it ended long ago.",
    )
    bags: bool = Field(
        default=False,
        strict=True,
        description="Also remove the bags of the map that wait to be enrolled, whatever they have. Otherwise, and "
        "where a job or an upload uses one, the result names them as `waiting_bags`: what they have is not looked at.",
    )

    @model_validator(mode="after")
    def _says_which(self) -> Erasing:
        if self.ids is not None and self.filter is not None:
            raise ValueError("give either ids or a filter")
        return self


class Reencoding(BaseModel):
    """Which new map is made from a map, and for which encoder."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"to": "lab-2", "encoder": "m-region-vlad"}]}
    )

    to: str = Field(max_length=256, description="Id of the new map.")
    encoder: str | None = Field(
        default=None,
        max_length=256,
        description="Name or full identity of the encoder; the default encoder if left out.",
    )


class Pruning(BaseModel):
    """Which places are removed because their neighbours can stand in for them."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"max_recall_loss": 0.01}]})

    dry_run: bool = Field(
        strict=True,
        default=True,
        description="Only report which places would be removed, and how much recall would be lost.",
    )
    max_recall_loss: Share = Field(default=0.01, description="How much recall may be lost, as a share of the queries.")
    similarity: float | None = Field(
        strict=True,
        default=None,
        allow_inf_nan=False,
        description="How alike two frames of one place must look (score of the first stage) for one to stand in for "
        "the other. If left out, it is chosen by the loss of recall; if given, `max_recall_loss` is ignored.",
    )
    sequence: Sequence | None = Field(default=None, description="Only places of this traverse may be removed.")
    queries: Sequence | None = Field(
        default=None,
        description="The traverse whose frames are the queries; it is neither searched nor pruned. If left out, every "
        "frame is a query for which the map is searched without that frame. This overestimates recall, since the "
        "neighbouring frames were taken with it.",
    )
    sample: int = Field(strict=True, default=500, ge=10, le=10_000, description="The largest number of queries.")


class Aligning(BaseModel):
    """Which traverse is aligned with which others."""

    model_config = ConfigDict(
        extra="forbid",
        populate_by_name=True,
        json_schema_extra={"examples": [{"sequence": "tuesday"}, {"sequence": "tuesday", "with": ["monday"]}]},
    )

    sequence: Sequence = Field(description="The traverse to align.")
    others: list[Sequence] | None = Field(
        alias="with",
        default=None,
        max_length=1000,
        description="The traverses to align it with; all others if left out. The result of an "
        "earlier alignment of the traverse is replaced. With an empty list it is only forgotten, with the poses that "
        "were handed over.",
    )
    poses: bool = Field(
        strict=True,
        default=True,
        description="Give each frame without a pose that of its counterpart; the place then says so in `pose_of`.",
    )
    dry_run: bool = Field(strict=True, default=False, description="Only report what would be stored.")


class Merging(BaseModel):
    """Which map is merged into this one, and how conflicts are solved."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True, json_schema_extra={"examples": [{"from": "hall"}]})

    source: str = Field(alias="from", max_length=256, description="Id of the other map, which is not changed.")
    dry_run: bool = Field(
        strict=True, default=True, description="Only report what would be copied, and how far the maps overlap."
    )
    on_conflict: Literal["refuse", "rename", "skip"] = Field(
        default="refuse",
        description="The action if an id belongs to another frame here, both maps have a sequence of the same name, or "
        "a camera has another mask: `refuse` the merge; `rename` what is copied, with `prefix`; `skip` such places, "
        "and append places of a sequence to the sequence of the same name.",
    )
    prefix: Annotated[str, words("a prefix", 64)] | None = Field(
        default=None,
        description="Put before names on conflict; if left out, the other map's id and a hyphen.",
    )
    sample: int = Field(
        strict=True,
        default=200,
        ge=0,
        le=10_000,
        description="How many places the overlap is measured with at most; 0: it is not measured.",
    )


class WeekView(BaseModel):
    """The answers of one week."""

    monday: date
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    blank: int = Field(description="How many of the unknown frames had nothing to compare.")
    unknown_rate: float | None
    mean_score: float | None
    mean_decision: float | None
    scores: list[int] = Field(description="How many best scores lay in each twentieth of the range from 0 to 1.")


class TrendView(BaseModel):
    """A straight line fitted to the weeks."""

    per_week: float
    error: float = Field(description="Standard error of `per_week`.")
    weeks: int
    significant: bool = Field(description="Whether the slope is larger than three standard errors.")


class AnswersView(BaseModel):
    """The map's answers since the counting began."""

    since: Timestamp | None
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    weeks: list[WeekView]
    score_trend: TrendView | None = Field(description="Null unless at least four weeks have twenty queries each.")
    unknown_trend: TrendView | None


class SilentPlaces(BaseModel):
    """Places that were never the best match."""

    count: int
    by_chance: float = Field(
        description="How many would be expected if the queries were spread evenly over all places."
    )
    queries: int = Field(description="How many queries were compared with the places.")
    wanted: int = Field(description="The number of queries from which on silence means something: three a place.")
    enough: bool = Field(description="Whether there were so many. Before, no stretch is listed for its silence.")
    places: list[str] = Field(description="Some of them, in the order of enrolment.")


class HubView(BaseModel):
    """A place that is a match unusually often."""

    place: str
    count: int
    expected: float = Field(description="The count that would be expected if all places were alike.")


class AliasView(BaseModel):
    """A place that looks more like another place than like its own neighbours; each pair is listed once."""

    place: str
    other: str
    score: float
    own: float | None = Field(
        description="The best score of another frame of the same place; null if none is among the 400 best matches."
    )


class AliasingView(BaseModel):
    """Places that look like other places."""

    examined: int = Field(description="How many places were compared with the map; the frames of a stop count once.")
    of: int = Field(description="How many places the map has; the frames of a stop count once.")
    neighbours: int = Field(description="How many of the most alike other places were counted for each place.")
    skewness: float = Field(
        description="Skewness of the counts: 0 if all are alike; over 2 if a few are neighbours of most."
    )
    hubs: list[HubView] = Field(description="The places that are among the most alike of unusually many others.")
    hub_count: int
    aliases: list[AliasView] = Field(
        description="Places that look more like another place than like their own; the most alike come first."
    )
    alias_count: int = Field(description="How many pairs there are.")
    unsure: list[HubView] = Field(
        description="The places that are unusually often the best match of queries that were not recognized."
    )
    unsure_count: int


class GapView(BaseModel):
    """Two successive frames that are farther apart than is usual in their sequence."""

    sequence: str
    before: str
    after: str
    measure: Measure = Field(
        description="Distance in metres, time in seconds, or similarity (score of the first stage)."
    )
    value: float
    median: float = Field(description="The median over all steps of the sequence.")
    severity: float = Field(
        description="How many times larger than the median the value is; for similarity, how many times smaller."
    )


class StopView(BaseModel):
    """Frames of one view, as where the robot stood while it mapped; pruning removes most of them."""

    sequence: str
    place: str = Field(description="The first of them.")
    frames: int = Field(description="How many frames of the sequence show this view.")


class SharedRouteView(BaseModel):
    """Two traverses that seem to follow one route, which neither poses nor an alignment say: align them."""

    sequence: str
    other: str
    frames: int = Field(
        description="How many of their frames look more like one of the other traverse than like their own neighbours; "
        "they do not count as places that look alike."
    )


class StretchView(BaseModel):
    """A stretch of a sequence that should be recorded again."""

    sequence: str
    first: str
    last: str
    reasons: list[Reason]
    weight: float = Field(description="How strong the reasons are; stretches are listed in this order.")


class WorsePlaceView(BaseModel):
    """A place that gets worse: a day is good if at least half of its frames were recognized there."""

    place: str
    days: int = Field(description="The days of the last seven on which robots were there.")
    good_days: int
    days_before: int
    good_days_before: int
    chance: float = Field(description="The probability of so few good days, or fewer, if nothing has changed.")
    sentence: str


class ChangedPlaceView(BaseModel):
    """A place that has changed: runs pass it surely, while single frames fail and geometry finds little."""

    place: str
    passed: int = Field(description="Frames of the last seven days of runs that were sure to be there.")
    missed: int = Field(description="How many of them were not recognized alone.")
    inliers: float | None = Field(description="Mean of the best matches with it; null if none was verified.")
    usual_inliers: float | None = Field(description="The mean of all places of the map.")
    sentence: str


class QuietStretchView(BaseModel):
    """A stretch of a sequence that nobody drives any more."""

    sequence: str
    first: str
    last: str
    places: int
    since: date = Field(description="When a robot was last there.")
    sentence: str


class RaisedAlarm(BaseModel):
    """An alarm of the map that is raised."""

    alarm: AlarmName
    count: int = Field(description="How many places or stretches there were when it was raised.")
    since: Timestamp


class TrendsView(BaseModel):
    """Trends of the map's places over time, by all answers and the runs of robots."""

    worse: list[WorsePlaceView] = Field(description="Places that get worse; those that chance explains least first.")
    worse_count: int
    changed: list[ChangedPlaceView] = Field(description="Places that have changed; those missed most often first.")
    changed_count: int
    quiet: list[QuietStretchView] = Field(description="Stretches that nobody drives any more, the longest ago first.")
    quiet_count: int
    advice: dict[AlarmName, str] = Field(description="What to do about each trend of which there is something.")
    alarms: list[RaisedAlarm] = Field(description="The alarms that are raised; see the map's setting `alarms`.")


TRENDS_EXAMPLE: dict[str, Any] = {
    "worse": [],
    "worse_count": 0,
    "changed": [
        {
            "place": "p12",
            "passed": 31,
            "missed": 27,
            "inliers": 4.5,
            "usual_inliers": 61.0,
            "sentence": "p12 has changed: robots that were sure to be there passed it with 31 frames in the last 7 "
            "days, and 27 of them were not recognized.",
        }
    ],
    "changed_count": 1,
    "quiet": [],
    "quiet_count": 0,
    "advice": {
        "changed_places": "Add a look of each place as it is now, or set the map's learning to propose, so that runs "
        "propose such looks."
    },
    "alarms": [{"alarm": "changed_places", "count": 1, "since": "2026-11-24T06:10:00Z"}],
}

HEALTH_EXAMPLE: dict[str, Any] = {
    "map": "lab",
    "places": 111,
    "complete": True,
    "calibration_doubt": None,
    "answers": {
        "since": "2026-11-01T08:00:00Z",
        "queries": 5120,
        "recognized": 4703,
        "ambiguous": 96,
        "unknown": 321,
        "weeks": [],
        "score_trend": None,
        "unknown_trend": None,
    },
    "never_matched": {
        "count": 2,
        "by_chance": 0.0,
        "queries": 5102,
        "wanted": 333,
        "enough": True,
        "places": ["p40", "p41"],
    },
    "aliasing": {
        "examined": 111,
        "of": 111,
        "neighbours": 10,
        "skewness": 1.1,
        "hubs": [{"place": "p12", "count": 48, "expected": 10.0}],
        "hub_count": 1,
        "aliases": [{"place": "p12", "other": "p90", "score": 0.31, "own": 0.22}],
        "alias_count": 1,
        "unsure": [],
        "unsure_count": 0,
    },
    "gaps": [
        {
            "sequence": "monday",
            "before": "p39",
            "after": "p42",
            "measure": "distance",
            "value": 9.5,
            "median": 1.0,
            "severity": 9.5,
        }
    ],
    "gap_count": 1,
    "gap_counts": {"distance": 1, "time": 0, "similarity": 0},
    "stops": [{"sequence": "monday", "place": "p57", "frames": 127}],
    "stop_count": 1,
    "retraverse": [{"sequence": "monday", "first": "p39", "last": "p42", "reasons": ["distance-gap"], "weight": 3.0}],
    "retraverse_count": 1,
    "trends": TRENDS_EXAMPLE,
    "shared_routes": [{"sequence": "tuesday", "other": "monday", "frames": 42}],
    "poses": [{"sequence": "monday", "metres": 0.4, "degrees": 1.2, "turned": 0.0, "pairs": 34, "remark": None}],
}


class PoseHealth(BaseModel):
    """How exact the poses of one traverse are, by what pictures of places beside one another say of them."""

    sequence: str
    metres: float | None = Field(
        description="Standard deviation of each coordinate; null: the pictures do not tell it, or it is small."
    )
    degrees: float | None = Field(description="Standard deviation of headings; null: intrinsics are not known.")
    turned: float = Field(description="Degrees by which cameras look to the left of the headings; 0: as they say.")
    pairs: int = Field(description="How many pairs of pictures `turned` rests on.")
    remark: str | None = Field(description="What is to be done about headings that are turned; null: nothing.")


class MapHealth(BaseModel):
    """The health of a map, judged by its own frames and by its answers."""

    model_config = ConfigDict(json_schema_extra={"examples": [HEALTH_EXAMPLE]})

    map: str
    places: int
    complete: bool = Field(description="False if the time was up before all of the map was examined.")
    calibration_doubt: str | None = Field(
        description="Why the map's own calibration is not to be trusted; null: nothing is known against it."
    )
    answers: AnswersView
    never_matched: SilentPlaces | None = Field(description="Null as long as the map has not been queried.")
    aliasing: AliasingView
    gaps: list[GapView] = Field(description="The most severe gaps come first.")
    gap_count: int
    gap_counts: dict[Measure, int] = Field(description="How many of each measure; the plan has those of distance.")
    stops: list[StopView] = Field(description="Views of ten frames or more; those of most frames come first.")
    stop_count: int
    retraverse: list[StretchView] = Field(description="Stretches that should be recorded again, the most urgent first.")
    retraverse_count: int
    trends: TrendsView
    shared_routes: list[SharedRouteView] = Field(description="Traverses to align; those of most frames come first.")
    poses: list[PoseHealth] = Field(
        description="Of the traverses whose pictures tell how exact their poses are, by name; headings that are turned "
        "come first."
    )


class ComparedTraverse(BaseModel):
    """A traverse of a comparison."""

    sequence: str
    places: list[str] = Field(description="Ids of its places, in the order of the traverse.")


class SimilarityScale(BaseModel):
    """The meaning of the 8-bit values of the matrix: a score is `low` + value / 255 · (`high` - `low`)."""

    low: float
    high: float


class SharedPath(BaseModel):
    """A stretch that two traverses share, as sequence matching finds it."""

    gain: float = Field(description="The mean gain of its pairs, in standard deviations; longer and higher is surer.")
    query: list[int] = Field(description="Rows of the matrix, rising by one at a time.")
    reference: list[int] = Field(description="The column that each of them shows.")


class SimilarityView(BaseModel):
    """How alike two traverses of a map are: about the matrix of their scores."""

    map: str
    encoder: str
    query: ComparedTraverse = Field(description="The traverse of the rows.")
    reference: ComparedTraverse = Field(description="The traverse of the columns.")
    rows: int
    columns: int
    scale: SimilarityScale
    stretches: list[SharedPath] = Field(
        description="The shared stretches, the surest first; empty if there are none, or one has fewer than ten frames."
    )
    truth: list[int | None] | None = Field(
        description="For each row the column that is nearest by the poses, null if none is within `radius`; null as a "
        "whole if the traverses have no poses to compare."
    )
    radius: float = Field(description="Metres: the map's `same_place_radius`.")
    aligned: bool = Field(description="Whether an alignment has stored which of their frames correspond.")
    counterparts: list[int | None] | None = Field(
        description="For each row the column at the same station, as alignment stored it; null if it has stored none."
    )
    milliseconds: Milliseconds
