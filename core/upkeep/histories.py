"""Histories of places, and what they tell: places that get worse or have changed, and stretches left alone.

A frame is little evidence by itself, and a robot that stands sends thousands of one view.  So days are counted: a day
is *good* for a place if at least half of its frames were recognized there.  Frames of runs that know where they are
count if there are any, for they pass a place whether it is recognized or not; else those whose best match the place is.

A place gets *worse* if the share of good days was higher before the last RECENT days than in them, by more than chance
explains: the one-sided test of Fisher, where of all places that are tested the expected share of false alarms is at
most FALSE (Benjamini and Hochberg, Controlling the false discovery rate, 1995).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import date, timedelta
from itertools import groupby

RECENT = timedelta(days=7)
"""The last days, which are compared with those before."""

FALSE = 0.05
"""Of the places that are said to get worse, at most this share is expected to do so by chance."""

LEAST_LOSS = 0.25
"""A place gets worse if the share of its good days falls by this, at least."""

FEWEST_DAYS, FEWEST_PASSES = 2, 4
"""A place has changed if on at least so many days, and in so many frames in all, runs have passed it."""

MISSED = 0.5
"""A place has changed if at least this share of the frames with which runs have passed it were not recognized."""

LITTLE = 0.5
"""Geometry finds little if it finds at most this share of the inliers that it usually finds in the map."""

QUIET = timedelta(days=28)
"""Nobody drives a stretch any more if no robot was there for so long, though robots were elsewhere."""

LONGEST_PAUSE = timedelta(days=7)
"""As long as no place of the map was seen in so many days, no stretch is said to be left alone."""

FEWEST_QUIET = 3
"""At least this many places in a row make a stretch."""


@dataclass(frozen=True)
class PlacePeriod:
    """The answers of a place in some time; sums, which add up.

    best, recognized: frames whose best match it was, and those of them that were recognized.
    probability: the sum of the probabilities of these best matches.
    score: the sum of the scores of the recognized ones, by the first two stages.
    verified, inliers: how many of the best matches were verified, and the sum of their inliers.
    passed, missed: frames of runs that were sure to be there, and those of them that were not recognized alone.
    days, good: days before the last ones, which are counted one by one no more, and the good ones of them.
    """

    best: int = 0
    recognized: int = 0
    probability: float = 0.0
    score: float = 0.0
    verified: int = 0
    inliers: int = 0
    passed: int = 0
    missed: int = 0
    days: int = 0
    good: int = 0

    def __add__(self, other: PlacePeriod) -> PlacePeriod:
        return PlacePeriod(*(getattr(self, one) + getattr(other, one) for one in _NAMES))

    @property
    def is_good(self) -> bool:
        """Whether a single day is good."""
        if self.passed:
            return 2 * (self.passed - self.missed) >= self.passed
        return 2 * self.recognized >= self.best


_NAMES = tuple(one.name for one in fields(PlacePeriod))


@dataclass(frozen=True)
class AnswerHistory:
    """The answers of a place over time: of the last days each, and what came before.

    days: by day, of which the caller chooses how many.
    weeks: by the Monday of a week, before those days.
    earlier: before those weeks.
    """

    days: Mapping[date, PlacePeriod] = field(default_factory=dict)
    weeks: Mapping[date, PlacePeriod] = field(default_factory=dict)
    earlier: PlacePeriod = PlacePeriod()

    @property
    def last_seen(self) -> date | None:
        """The last day, or the end of the last week, in which the place answered; None if that is longer ago."""
        if self.days:
            return max(self.days)
        return max(self.weeks) + timedelta(days=6) if self.weeks else None

    def since(self, first: date) -> PlacePeriod:
        """The sum from a day on, with its days counted."""
        return self._sum(day for day in self.days if day >= first)

    def before(self, first: date) -> PlacePeriod:
        """The sum of what came before a day, with its days counted."""
        return sum(self.weeks.values(), self.earlier) + self._sum(day for day in self.days if day < first)

    def _sum(self, days: Iterable[date]) -> PlacePeriod:
        found = PlacePeriod()
        for day in days:
            one = self.days[day]
            found = found + one + PlacePeriod(days=1, good=int(one.is_good))
        return found


Histories = Mapping[str, AnswerHistory]
"""The histories of places, by id."""


@dataclass(frozen=True)
class WorsePlace:
    """A place that gets worse.

    recent, before: of the last days, and of the time before.
    chance: the probability that chance explains it, if nothing has changed.
    """

    place: str
    recent: PlacePeriod
    before: PlacePeriod
    chance: float


@dataclass(frozen=True)
class PassedPlace:
    """A place that has changed: runs pass it surely, while single frames fail and geometry finds little.

    recent: of the last days.
    usual_inliers: the mean in the whole map; None if nothing was verified.
    """

    place: str
    recent: PlacePeriod
    usual_inliers: float | None


@dataclass(frozen=True)
class QuietStretch:
    """Places from ``first`` to ``last`` of a sequence that nobody drives any more (positions in it).

    since: when a robot was last at one of them.
    """

    first: int
    last: int
    since: date


def worse_places(histories: Histories, today: date) -> list[WorsePlace]:
    """The places that get worse, those first that chance explains least."""
    first = today - RECENT + timedelta(days=1)
    tested = []
    for place, history in histories.items():
        recent, before = history.since(first), history.before(first)
        if recent.days and before.days:
            chance = by_chance(recent.good, recent.days, before.good, before.days)
            tested.append(WorsePlace(place, recent, before, chance))
    tested.sort(key=lambda one: (one.chance, one.place))
    ranks = [rank for rank, one in enumerate(tested, start=1) if one.chance <= FALSE * rank / len(tested)]
    return [one for one in tested[: max(ranks, default=0)] if _loss(one) >= LEAST_LOSS]


def _loss(place: WorsePlace) -> float:
    return place.before.good / place.before.days - place.recent.good / place.recent.days


def by_chance(good: int, days: int, good_before: int, days_before: int) -> float:
    """The probability that no more of some days are good if all days are alike (hypergeometric)."""
    every, all_days = good + good_before, days + days_before
    ways = sum(
        math.comb(every, some) * math.comb(all_days - every, days - some)
        for some in range(max(0, days - (all_days - every)), good + 1)
    )
    return ways / math.comb(all_days, days)


def changed_places(histories: Histories, today: date) -> list[PassedPlace]:
    """The places that have changed, those first that runs have passed most often without being recognized."""
    first = today - RECENT + timedelta(days=1)
    whole = [history.since(first) + history.before(first) for history in histories.values()]
    verified = sum(one.verified for one in whole)
    usual = sum(one.inliers for one in whole) / verified if verified else None
    found = []
    for place, history in histories.items():
        recent = history.since(first)
        days = sum(day >= first and one.passed > 0 for day, one in history.days.items())
        if days < FEWEST_DAYS or recent.passed < FEWEST_PASSES or recent.missed < MISSED * recent.passed:
            continue
        if usual is None or not recent.verified or recent.inliers / recent.verified <= LITTLE * usual:
            found.append(PassedPlace(place, recent, usual))
    return sorted(found, key=lambda one: (-one.recent.missed, one.place))


def quiet_stretches(last_seen: Sequence[date | None], latest: date | None, today: date) -> list[QuietStretch]:
    """The stretches of a sequence that nobody drives any more, though robots drive elsewhere.

    Places that were never seen belong to a stretch only beside others that were.

    Args:
        last_seen: of the places of the sequence in order, when a robot was last there; None: never.
        latest: when a robot was last anywhere in the map; None: never.
    """
    if latest is None or today - latest > LONGEST_PAUSE:
        return []
    found, position = [], 0
    for quiet, run in groupby(last_seen, key=lambda seen: seen is None or today - seen > QUIET):
        seen = list(run)
        days = [day for day in seen if day is not None]
        if quiet and days and len(seen) >= FEWEST_QUIET:
            found.append(QuietStretch(position, position + len(seen) - 1, max(days)))
        position += len(seen)
    return found
