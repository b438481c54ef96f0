"""Trends of a map, by the histories of its places: places that get worse or have changed, and stretches left alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime

from core.maps import AlarmName, MapRecord
from core.store import Map
from core.upkeep.histories import (
    QUIET,
    RECENT,
    Histories,
    PassedPlace,
    QuietStretch,
    WorsePlace,
    changed_places,
    quiet_stretches,
    worse_places,
)
from service.queries.counts import PlaceCount
from service.upkeep.schemas import ChangedPlaceView, QuietStretchView, RaisedAlarm, TrendsView, WorsePlaceView

SEQUENCE_PAGE = 1000


@dataclass(frozen=True)
class PlaceTrends:
    """The trends of a map.

    quiet: with the sequence of each stretch, and the ids of its first and last place.
    """

    worse: Sequence[WorsePlace]
    changed: Sequence[PassedPlace]
    quiet: Sequence[tuple[QuietStretch, str, str, str]]

    def places(self, alarm: AlarmName) -> list[str]:
        """The places of one trend; of stretches the first place of each."""
        if alarm == "quiet_stretches":
            return [first for _, _, first, _ in self.quiet]
        return [one.place for one in (self.worse if alarm == "worse_places" else self.changed)]


def trends_of(map_: Map, histories: Histories, counts: Mapping[str, PlaceCount]) -> PlaceTrends:
    """The trends of a map; places that it no longer has do not count.

    Args:
        counts: of the places that were the best match, by id.

    Raises:
        MapQuarantined, StorageFailure, UnknownMap: the map cannot be read.
    """
    today = datetime.now(UTC).date()
    outline = list(map_.transfer.outline())
    present = {place.id for place in outline}
    living = {place: history for place, history in histories.items() if place in present}
    seen = {place: _last_seen(place, living, counts) for place in present}
    latest = max((day for day in seen.values() if day is not None), default=None)
    walks: dict[str, dict[int, list[str]]] = {}
    for place in outline:
        if place.sequence is not None:
            walks.setdefault(place.sequence, {}).setdefault(place.ordinal, []).append(place.id)
    quiet = []
    for sequence, views in walks.items():  # frames of one view are one place of the way
        ids = [views[ordinal] for ordinal in sorted(views)]
        when = [max((day for one in view if (day := seen[one]) is not None), default=None) for view in ids]
        stretches = quiet_stretches(when, latest, today)
        quiet += [(one, sequence, ids[one.first][0], ids[one.last][-1]) for one in stretches]
    quiet.sort(key=lambda one: (one[0].since, one[1]))
    return PlaceTrends(worse_places(living, today), changed_places(living, today), quiet)


def _last_seen(place: str, histories: Histories, counts: Mapping[str, PlaceCount]) -> date | None:
    """When a robot was last at a place; None if it never was, or longer ago than is known."""
    count = counts.get(place)
    days = [] if count is None or not count.last else [datetime.fromisoformat(count.last).date()]
    if place in histories and (last := histories[place].last_seen) is not None:
        days.append(last)
    return max(days, default=None)


def trends_view(
    record: MapRecord, found: PlaceTrends, alarms: Sequence[tuple[AlarmName, int, datetime]], limit: int
) -> TrendsView:
    """The JSON view of trends.

    Args:
        alarms: that are raised, as :meth:`~service.queries.statistics.QueryStatistics.alarms` gives them.
        limit: how many of each are listed at most.
    """
    return TrendsView(
        worse=[_worse(one) for one in found.worse[:limit]],
        worse_count=len(found.worse),
        changed=[_changed(one) for one in found.changed[:limit]],
        changed_count=len(found.changed),
        quiet=[_quiet(*one) for one in found.quiet[:limit]],
        quiet_count=len(found.quiet),
        advice={name: advice(record, name) for name in _SENTENCES if found.places(name)},
        alarms=[RaisedAlarm(alarm=name, count=count, since=since) for name, count, since in alarms],
    )


def _worse(one: WorsePlace) -> WorsePlaceView:
    recent, before = one.recent, one.before
    return WorsePlaceView(
        place=one.place,
        days=recent.days,
        good_days=recent.good,
        days_before=before.days,
        good_days_before=before.good,
        chance=one.chance,
        sentence=f"{one.place} gets worse: of the {_days(recent.days)} of the last week on which robots were there, it "
        f"was recognized in most frames on {recent.good}; before, on {before.good} of {before.days}.",
    )


def _changed(one: PassedPlace) -> ChangedPlaceView:
    recent = one.recent
    inliers = recent.inliers / recent.verified if recent.verified else None
    return ChangedPlaceView(
        place=one.place,
        passed=recent.passed,
        missed=recent.missed,
        inliers=inliers,
        usual_inliers=one.usual_inliers,
        sentence=f"{one.place} has changed: robots that were sure to be there passed it with {recent.passed} frames in "
        f"the last {_days(RECENT.days)}, and {recent.missed} of them were not recognized.",
    )


def _quiet(stretch: QuietStretch, sequence: str, first: str, last: str) -> QuietStretchView:
    return QuietStretchView(
        sequence=sequence,
        first=first,
        last=last,
        places=stretch.last - stretch.first + 1,
        since=stretch.since,
        sentence=f"Nobody drives from {first} to {last} any more: the last robot was there on {stretch.since}.",
    )


def _days(count: int) -> str:
    return "1 day" if count == 1 else f"{count} days"


_SENTENCES: dict[AlarmName, str] = {
    "worse_places": "{count} places get worse.",
    "changed_places": "{count} places have changed.",
    "quiet_stretches": f"Nobody has driven {{count}} stretches for {QUIET.days} days.",
}


def cleared(count: int) -> str:
    """A sentence that says that an alarm is cleared."""
    return f"The alarm is cleared: {count} {'is' if count == 1 else 'are'} left."


def sentence(record: MapRecord, alarm: AlarmName, count: int) -> str:
    """A sentence that says what has happened to a map, and what to do about it."""
    said = _SENTENCES[alarm].format(count=count)
    if count == 1:
        for many, one in (("places get", "place gets"), ("places have", "place has"), ("stretches", "stretch")):
            said = said.replace(many, one)
    return f"{said} {advice(record, alarm)}"


def advice(record: MapRecord, alarm: AlarmName) -> str:
    """A sentence that says what to do about a trend."""
    if alarm == "quiet_stretches":
        return "If the way is closed, delete these places; if it is open, drive it before the map is out of date."
    add = "Add a look of each place as it is now"
    if record.learning.mode == "off":
        return f"{add}, or set the map's learning to propose, so that runs propose such looks."
    if record.learning.mode == "propose":
        return f"{add}, or accept the looks that runs have proposed: they wait for review."
    return f"{add} if the map does not learn it from its runs in the next days."
