"""Counts of the answers of a map, as they are added up and shown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from core.judgement.verdict import Verdict
from core.places import Timestamp
from core.upkeep.drift import Week
from core.upkeep.histories import PlacePeriod


class VerdictCounts(BaseModel):
    """How many answers had each verdict."""

    model_config = ConfigDict(frozen=True)

    recognized: int = 0
    ambiguous: int = 0
    unknown: int = 0

    @classmethod
    def of(cls, counts: Mapping[Verdict, int]) -> VerdictCounts:
        """The counts of some answers."""
        return VerdictCounts(
            recognized=counts.get("recognized", 0),
            ambiguous=counts.get("ambiguous", 0),
            unknown=counts.get("unknown", 0),
        )

    def __add__(self, other: VerdictCounts) -> VerdictCounts:
        return VerdictCounts(
            recognized=self.recognized + other.recognized,
            ambiguous=self.ambiguous + other.ambiguous,
            unknown=self.unknown + other.unknown,
        )


class HourCount(VerdictCounts):
    """How many answers had each verdict within an hour."""

    hour: Timestamp = Field(description="When the hour began.")


@dataclass(frozen=True)
class PlaceCount:
    """The counts of one place.

    best: how often it was the best match.
    recognized: how often it was recognized.
    last: when it was last the best match, ISO 8601 in UTC.
    """

    best: int = 0
    recognized: int = 0
    last: str = ""

    def __add__(self, other: PlaceCount) -> PlaceCount:
        return PlaceCount(self.best + other.best, self.recognized + other.recognized, max(self.last, other.last))


class PassedBy(NamedTuple):
    """The place that a run was sure to be at with a frame, and whether the frame alone was not recognized."""

    place: str
    missed: bool


@dataclass(frozen=True)
class Statistics:
    """The statistics of a map.

    since: when the counting began; None if nothing was counted yet.
    places: the counts of the places that ever were the best match, by id.
    weeks: the weeks with at least one query, in order.
    """

    since: datetime | None = None
    places: Mapping[str, PlaceCount] = field(default_factory=dict)
    weeks: tuple[Week, ...] = ()


@dataclass
class AnswerCounts:
    """The counts of one map that are not written yet.

    periods: how places answered, by their id and the day.
    """

    since: str
    places: dict[str, PlaceCount] = field(default_factory=dict)
    weeks: dict[date, Week] = field(default_factory=dict)
    hours: dict[int, Counter[Verdict]] = field(default_factory=dict)
    periods: dict[tuple[str, date], PlacePeriod] = field(default_factory=dict)

    @property
    def waiting(self) -> int:
        """How many places have counts."""
        return len(self.places.keys() | {place for place, _ in self.periods})

    def add(self, other: AnswerCounts) -> None:
        for place, count in other.places.items():
            self.places[place] = self.places.get(place, PlaceCount()) + count
        for monday, week in other.weeks.items():
            self.weeks[monday] = self.weeks.get(monday, Week(monday)) + week
        for hour, verdicts in other.hours.items():
            self.hours.setdefault(hour, Counter()).update(verdicts)
        for (place, day), period in other.periods.items():
            self.add_period(place, day, period)

    def add_period(self, place: str, day: date, period: PlacePeriod) -> None:
        """Add to how a place answered on a day."""
        self.periods[place, day] = self.periods.get((place, day), PlacePeriod()) + period


def monday_of(day: date) -> date:
    """The Monday of a day's week."""
    return day - timedelta(days=day.weekday())


def hour_of(moment: datetime) -> int:
    """The hour of a moment, counted since 1970 in UTC."""
    return int(moment.timestamp()) // 3600
