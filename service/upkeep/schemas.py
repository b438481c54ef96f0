"""Upkeep: what is asked of a map besides answering, and what is said of its health."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from core.places import Sequence, Timestamp
from core.upkeep.coverage import Measure
from core.upkeep.revisits import Reason

Share = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)]


class Reencoding(BaseModel):
    """A map to be made anew for another encoder."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"to": "lab-2", "encoder": "m-region-vlad"}]}
    )

    to: str = Field(max_length=256, description="Id of the new map.")
    encoder: str | None = Field(
        default=None, max_length=256, description="Name or full identity; the default encoder if left out."
    )


class Pruning(BaseModel):
    """Places to be forgotten because their neighbours stand in for them."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"max_recall_loss": 0.01}]})

    dry_run: bool = Field(strict=True, default=True, description="Only report what would go, and what it would cost.")
    max_recall_loss: Share = Field(default=0.01, description="What it may cost: share of the queries asked.")
    similarity: float | None = Field(
        strict=True,
        default=None,
        allow_inf_nan=False,
        description="How alike two frames of one place must look (score by the first stage) for one to stand in for "
        "the other. Left out, it is chosen by what it costs; given, `max_recall_loss` does not count.",
    )
    sequence: Sequence | None = Field(default=None, description="Only places of this traverse may go.")
    queries: Sequence | None = Field(
        default=None,
        description="Measure the cost with the frames of this traverse, which is then neither searched nor pruned. "
        "Left out, each frame is asked for without itself, which flatters: its neighbours were taken with it.",
    )
    sample: int = Field(strict=True, default=500, ge=10, le=10_000, description="Most frames to ask.")


class Merging(BaseModel):
    """Another map whose places are to come into this one."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True, json_schema_extra={"examples": [{"from": "hall"}]})

    source: str = Field(alias="from", max_length=256, description="Id of the other map; it stays as it is.")
    dry_run: bool = Field(
        strict=True, default=True, description="Only report what would come, and how far the maps overlap."
    )
    on_conflict: Literal["refuse", "rename", "skip"] = Field(
        default="refuse",
        description="Where an id means another frame here, both maps have a sequence of one name, or a camera has "
        "another mask: `refuse` the merge; `rename` what comes, by `prefix`; `skip` such places, and put those of the "
        "same sequence behind the ones here.",
    )
    prefix: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._~-]{0,63}$",
        description="Put before names on conflict; the other map's id and a hyphen if left out.",
    )
    sample: int = Field(
        strict=True, default=200, ge=0, le=10_000, description="Most places by which the overlap is measured."
    )


class WeekView(BaseModel):
    """The answers of one week."""

    monday: date
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    blank: int = Field(description="Of the unknown: nothing could be compared.")
    unknown_rate: float | None
    mean_score: float | None
    mean_decision: float | None
    scores: list[int] = Field(description="How many best scores lay in each twentieth of 0 to 1.")


class TrendView(BaseModel):
    """A straight line through the weeks."""

    per_week: float
    error: float = Field(description="Standard error of `per_week`.")
    weeks: int
    significant: bool = Field(description="More than chance makes likely: the slope is over three standard errors.")


class AnswersView(BaseModel):
    """What the map answered since the counting began."""

    since: Timestamp | None
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    weeks: list[WeekView]
    score_trend: TrendView | None = Field(description="Null with fewer than four weeks of twenty queries.")
    unknown_trend: TrendView | None


class SilentPlaces(BaseModel):
    """Places that were never the best match."""

    count: int
    by_chance: float = Field(description="How many there would be had the queries been for all places alike.")
    places: list[str] = Field(description="Some of them, in the order of enrolment.")


class HubView(BaseModel):
    """A place that stands out among the best matches of others."""

    place: str
    count: int
    expected: float = Field(description="What it would be if all places were alike.")


class AliasView(BaseModel):
    """A place that looks more like another place than like its own neighbours."""

    place: str
    other: str
    score: float
    own: float | None = Field(
        description="Best score of a frame of the same place; null if none is among the 400 most alike."
    )


class AliasingView(BaseModel):
    """Places that match everything."""

    examined: int = Field(description="So many places were held against the map, …")
    of: int = Field(description="… of so many.")
    neighbours: int = Field(description="Of each the so many most alike others were counted.")
    skewness: float = Field(description="Of the counts: 0 if all places are alike; over 2 a few draw all.")
    hubs: list[HubView] = Field(description="Among the map's own frames.")
    aliases: list[AliasView] = Field(description="The most alike first.")
    alias_count: int
    unsure: list[HubView] = Field(description="Best matches of queries that were not recognized, where they pile up.")


class GapView(BaseModel):
    """Two frames that follow each other, and are farther apart than is ordinary for their sequence."""

    sequence: str
    before: str
    after: str
    measure: Measure = Field(description="Metres, seconds, or how alike they look (score by the first stage).")
    value: float
    median: float = Field(description="Of all steps of the sequence.")
    severity: float = Field(description="How many times the median, or the median how many times it.")


class StretchView(BaseModel):
    """Where somebody should go again."""

    sequence: str
    first: str
    last: str
    reasons: list[Reason]
    weight: float = Field(description="How much speaks for it; they are in this order.")


HEALTH_EXAMPLE: dict[str, Any] = {
    "map": "lab",
    "places": 111,
    "complete": True,
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
    "never_matched": {"count": 2, "by_chance": 0.0, "places": ["p40", "p41"]},
    "aliasing": {
        "examined": 111,
        "of": 111,
        "neighbours": 10,
        "skewness": 1.1,
        "hubs": [{"place": "p12", "count": 48, "expected": 10.0}],
        "aliases": [{"place": "p12", "other": "p90", "score": 0.31, "own": 0.22}],
        "alias_count": 1,
        "unsure": [],
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
    "retraverse": [{"sequence": "monday", "first": "p39", "last": "p42", "reasons": ["distance-gap"], "weight": 3.0}],
}


class MapHealth(BaseModel):
    """How a map does, by its own frames and by what it answered."""

    model_config = ConfigDict(json_schema_extra={"examples": [HEALTH_EXAMPLE]})

    map: str
    places: int
    complete: bool = Field(description="False: the time was up before all of the map was looked at.")
    answers: AnswersView
    never_matched: SilentPlaces | None = Field(description="Null as long as nobody has asked.")
    aliasing: AliasingView
    gaps: list[GapView] = Field(description="The most severe first.")
    gap_count: int
    retraverse: list[StretchView] = Field(description="Stretches to go again, what is most needed first.")
